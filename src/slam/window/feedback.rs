//! The window's corrections of the map: new poses, units and depth.

use std::collections::BTreeMap;

use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::slam::keyframe_pose_covariance::{
    KeyframePoseCovariance, KeyframePoseMatrix, UncertainPose,
};
use crate::slam::map::{Correction, KeyframeCorrection, LogPlane, Map};
use crate::slam::modes::ModeCovariance;
use crate::slam::window::holders::Holder;
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::marginals::Marginal;
use crate::slam::window::plane::{Correspondence, fit, relief_left};
use crate::slam::window::view::ObserverView;
use crate::slam::window::{Window, selection};

/// Covariances derived from a marginal: of the modes of a keyframe's depth, and of its place relative to the keyframes
/// that held it.
pub type MarginalCovariances = (ModeCovariance, Option<KeyframePoseCovariance>);

/// The same, and that of its place in the map.
struct EstimatedCovariances {
    modes: ModeCovariance,
    relative_place: Option<KeyframePoseCovariance>,
    place: Option<KeyframePoseCovariance>,
}

impl Window {
    /// The correction of the map by the last adjustment: the keyframes that were free move, and their depth is moved to
    /// where their points are. `covariances_of` derives a keyframe's covariances from its marginal.
    pub fn correction(
        &self,
        map: &Map,
        covariances_of: impl Fn(&Marginal) -> MarginalCovariances,
    ) -> Correction {
        let covariances = self.covariances(map, covariances_of);
        let mut keyframes: Vec<KeyframeCorrection> = Vec::new();
        for &id in &self.moved {
            let Some(keyframe) = map.get(id) else { continue };
            keyframes.extend(self.keyframe_correction(keyframe, covariances.get(&id)));
        }
        let followers = self.followers(map, &keyframes);
        keyframes.extend(followers);
        Correction { keyframes, ..Correction::default() }
    }

    /// The covariances of each estimated keyframe. That of an estimate is relative to the keyframes that held it, whose
    /// own errors move it along: of these it gets the mean, as large as if all errors were the same. Where no older one
    /// held it, its place covariance stays what it was.
    fn covariances(
        &self,
        map: &Map,
        covariances_of: impl Fn(&Marginal) -> MarginalCovariances,
    ) -> BTreeMap<u64, EstimatedCovariances> {
        let mut known: BTreeMap<u64, EstimatedCovariances> = BTreeMap::new();
        // In the order of the estimates: later ones may be held by keyframes of earlier ones.
        for marginal in &self.marginals {
            let (modes, relative_place) = covariances_of(marginal);
            let place = relative_place.zip(self.get(marginal.keyframe_id)).map(|(relative, of)| {
                let position = of.camera_from_map.inverse().translation;
                let of_holder = |holder: &Holder| {
                    let estimated = known.get(&holder.keyframe_id).and_then(|of| of.place);
                    let holding = self.holding(holder, map, estimated)?;
                    Some(holding.covariance_at(&position) * holder.share)
                };
                let held: Option<Vec<_>> = marginal.held_by.iter().map(of_holder).collect();
                let held = held.filter(|held| !held.is_empty())?;
                let held = held.into_iter().sum::<KeyframePoseMatrix>();
                Some(KeyframePoseCovariance::bounded(&(relative.matrix() + held)))
            });
            let place = place.flatten();
            let covariances = EstimatedCovariances { modes, relative_place, place };
            known.insert(marginal.keyframe_id, covariances);
        }
        known
    }

    /// A keyframe that held others, with the covariance that the same estimates gave it, if any.
    fn holding(
        &self,
        holder: &Holder,
        map: &Map,
        estimated: Option<KeyframePoseCovariance>,
    ) -> Option<UncertainPose> {
        let in_map = map.get(holder.keyframe_id)?.uncertain_pose();
        let known = self.get(holder.keyframe_id)?;
        let rigid = known.camera_from_map.inverse();
        Some(UncertainPose {
            map_from_keyframe: Sim3::new(rigid, in_map.map_from_keyframe.scale),
            covariance: estimated.unwrap_or(in_map.covariance),
        })
    }

    /// Corrections of keyframes that are not estimated, newer ones and rejected ones: each moves with the last
    /// estimated one before it, if that moves.
    fn followers(&self, map: &Map, moved: &[KeyframeCorrection]) -> Vec<KeyframeCorrection> {
        let follows = |keyframe: &&Keyframe| self.get(keyframe.keyframe_id).is_none();
        let follow = |keyframe: &Keyframe| {
            let of_epoch = |of: &&WindowKeyframe| of.epoch == keyframe.epoch;
            let before =
                self.keyframes.iter().rev().find(|of| of.keyframe_id < keyframe.keyframe_id);
            let id = before.filter(of_epoch)?.keyframe_id;
            let leader = moved.iter().find(|of| of.keyframe_id == id)?;
            let was = map.get(id).filter(|was| was.epoch == keyframe.epoch)?;
            let map_from_keyframe = leader.map_from_keyframe
                * was.map_from_keyframe.inverse()
                * keyframe.map_from_keyframe;
            let place = leader.place.map(|covariance| {
                let is = UncertainPose { map_from_keyframe: leader.map_from_keyframe, covariance };
                keyframe.uncertain_pose().following(&was.uncertain_pose(), &is)
            });
            Some(KeyframeCorrection {
                place,
                ..KeyframeCorrection::of_pose(keyframe.keyframe_id, map_from_keyframe)
            })
        };
        map.keyframes.iter().filter(follows).filter_map(follow).collect()
    }

    fn keyframe_correction(
        &self,
        keyframe: &Keyframe,
        said: Option<&EstimatedCovariances>,
    ) -> Option<KeyframeCorrection> {
        let known = self.get(keyframe.keyframe_id)?;
        let place = known.camera_from_map.inverse();
        let unit = keyframe.map_from_keyframe.scale;
        let better = match known.is_host {
            true => self.own_correspondences(known, keyframe),
            false => {
                let index = self.index_of(keyframe.keyframe_id)?;
                self.projected_correspondences(index, &keyframe.points)
            }
        };
        // Depth in the unit of the map is larger by e^offset, so that the unit is shorter.
        let plane = fit(&better);
        // Depth that was not moved to the points is no more certain than before.
        let is_tilted = plane.is_some_and(|[_, per_x, per_y]| (per_x, per_y) != (0.0, 0.0));
        // The plane leaves the depth's own relief, while the estimate's covariance is that of the points' relief.
        let relief = plane.map_or(0.0, |plane| relief_left(&better, &plane));
        let modes = said.map(|of| of.modes.with_relief_error(relief)).filter(|_| is_tilted);
        // Its unit is that of the points only where they determine it.
        let said = said.filter(|_| plane.is_some());
        let [offset, per_x, per_y] = plane.unwrap_or_default();
        Some(KeyframeCorrection {
            keyframe_id: keyframe.keyframe_id,
            map_from_keyframe: Sim3::new(place, unit * (-offset).exp()),
            depth: LogPlane { offset: 0.0, per_x, per_y },
            modes,
            place: said.and_then(|of| of.place),
            relative_place: said.and_then(|of| of.relative_place),
        })
    }

    /// Correspondences of a keyframe's own points with its depth.
    pub(super) fn own_correspondences(
        &self,
        host: &WindowKeyframe,
        keyframe: &Keyframe,
    ) -> Vec<Correspondence> {
        let unit = keyframe.map_from_keyframe.scale;
        let points = host.points.iter().filter(|point| point.is_alive && point.confirmations > 0);
        points
            .filter_map(|point| {
                let dense = selection::at_pixel(&keyframe.points, point.u, point.v)?;
                let depth = f64::from(dense.inverse_depth) / unit;
                let ray = point.ray.map(f64::from);
                Some(Correspondence {
                    ray,
                    log_ratio: (point.inverse_depth / depth).ln(),
                    log_inverse_depth: depth.ln(),
                })
            })
            .collect()
    }

    /// Correspondences of a keyframe's depth with the points of other keyframes that it agrees with.
    pub(super) fn projected_correspondences(
        &self,
        index: usize,
        points: &[DepthPoint],
    ) -> Vec<Correspondence> {
        let to = &self.keyframes[index];
        let rows = selection::Rows::of(points, self.camera.height);
        let mut found = Vec::new();
        for of_host in to.agreed.chunk_by(|one, other| one.keyframe_id == other.keyframe_id) {
            let Some(host) = self.get(of_host[0].keyframe_id).filter(|of| of.epoch == to.epoch)
            else {
                continue;
            };
            let sight = ObserverView::new(
                &(to.camera_from_map * host.camera_from_map.inverse()),
                &self.camera,
            );
            let points = of_host.iter().filter_map(|of| host.points.get(of.point));
            for point in points.filter(|point| point.is_alive) {
                let Some(seen) = sight.project(point) else { continue };
                let Some(known) = rows.near(seen.u, seen.v) else { continue };
                let depth = f64::from(known.inverse_depth) / to.unit;
                let deviation = f64::from(known.variance).sqrt() / f64::from(known.inverse_depth);
                if !(deviation <= self.params.max_relative_deviation) {
                    continue;
                }
                found.push(Correspondence {
                    ray: self.camera.ray(seen.u, seen.v).xy().into(),
                    log_ratio: (seen.inverse_depth / depth).ln(),
                    log_inverse_depth: depth.ln(),
                });
            }
        }
        found
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use nalgebra::Matrix3;

    use super::*;
    use crate::slam::test_scene::CAMERA;
    use crate::slam::window::params::WindowParams;
    use crate::slam::window::tests::in_map;

    /// A marginal without numbers.
    pub(in crate::slam::window) fn marginal(keyframe_id: u64, held_by: &[(u64, f64)]) -> Marginal {
        let none = Matrix3::zeros();
        let holder = |&(keyframe_id, share): &(u64, f64)| Holder { keyframe_id, share };
        let held_by = held_by.iter().map(holder).collect();
        Marginal { keyframe_id, modes: none, of_displaced: none, place: None, held_by }
    }

    #[test]
    fn the_errors_of_keyframes_that_hold_others_add_to_those_of_the_others() {
        let mut window = Window::new(CAMERA, WindowParams::default());
        let mut map = Map::default();
        let image: Arc<[u8]> = vec![1; CAMERA.width * CAMERA.height].into();
        for id in 0..4 {
            let image = Arc::clone(&image);
            map.keyframes.push(Keyframe { image, ..in_map(id, 0, id as f64, 1.0) });
            assert!(window.add(&map.keyframes[id as usize]));
        }
        let of_unit = |variance: f64| {
            let mut matrix = KeyframePoseMatrix::zeros();
            matrix[(6, 6)] = variance;
            matrix
        };
        map.keyframes[0].place_covariance = KeyframePoseCovariance::bounded(&of_unit(4e-4));
        map.keyframes[1].place_covariance = KeyframePoseCovariance::bounded(&of_unit(8e-4));
        // The window has moved what the map still has elsewhere.
        map.keyframes.iter_mut().for_each(|of| of.map_from_keyframe.rigid.translation.x *= 3.0);
        // 3 is held by 2, which the same estimates place relative to 0 and 1, one unit to the right of 1; nothing older
        // holds 1.
        let held_by: [&[(u64, f64)]; 3] = [&[], &[(0, 0.25), (1, 0.75)], &[(2, 1.0)]];
        window.marginals.extend((1..).zip(held_by).map(|(id, by)| marginal(id, by)));
        let relative = KeyframePoseCovariance::bounded(&(KeyframePoseMatrix::identity() * 1e-4));
        let found = window.covariances(&map, |_| (ModeCovariance::ZERO, Some(relative)));
        assert_eq!((found[&1].relative_place, found[&1].place), (Some(relative), None));
        let entries = |id: u64| {
            let found = &found[&id];
            assert_eq!(found.relative_place, Some(relative));
            let place = found.place.unwrap().matrix();
            // Along x and y, of the unit, and of x with the unit.
            [(0, 0), (1, 1), (6, 6), (0, 6)].map(|at| place[at] * 1e4)
        };
        let expected = [
            // The unit moves 2 along x by its distance, 2 from 0 and 1 from 1.
            (2, [1.0 + 0.25 * 4.0 * 4.0 + 0.75 * 8.0, 1.0, 8.0, 0.25 * 2.0 * 4.0 + 0.75 * 8.0]),
            // 11, 8 and 8 of 2, with a lever of 1; its own relative one is 1.
            (3, [1.0 + 11.0 + 2.0 * 8.0 + 8.0, 2.0, 9.0, 8.0 + 8.0]),
        ];
        for (id, expected) in expected {
            let found = entries(id);
            let error =
                found.iter().zip(expected).map(|(found, expected)| (found - expected).abs());
            assert!(error.sum::<f64>() < 1e-9, "{id}: {found:?} {expected:?}");
        }
    }
}
