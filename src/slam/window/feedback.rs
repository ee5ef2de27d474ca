//! The window's corrections of the map: new poses, units and depth.

use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::slam::keyframe_pose_covariance::{KeyframePoseCovariance, UncertainPose};
use crate::slam::map::{Correction, KeyframeCorrection, LogPlane, Map};
use crate::slam::modes::ModeCovariance;
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::marginals::Marginal;
use crate::slam::window::plane::{Correspondence, fit, relief_left};
use crate::slam::window::view::ObserverView;
use crate::slam::window::{Window, selection};

/// Covariances derived from a marginal: of the modes of a keyframe's depth, and of its place.
pub type MarginalCovariances = (ModeCovariance, Option<KeyframePoseCovariance>);

impl Window {
    /// The correction of the map by the last adjustment: the keyframes that were free move, and their depth is moved to
    /// where their points are. `covariances_of` derives a keyframe's covariances from its marginal.
    pub fn correction(
        &self,
        map: &Map,
        covariances_of: impl Fn(&Marginal) -> MarginalCovariances,
    ) -> Correction {
        let mut keyframes: Vec<KeyframeCorrection> = Vec::new();
        for &id in &self.moved {
            let Some(keyframe) = map.get(id) else { continue };
            keyframes.extend(self.keyframe_correction(keyframe, &covariances_of));
        }
        let followers = self.followers(map, &keyframes);
        keyframes.extend(followers);
        Correction { keyframes, ..Correction::default() }
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
        covariances_of: impl Fn(&Marginal) -> MarginalCovariances,
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
        let said = self.marginal_of(keyframe.keyframe_id).map(covariances_of);
        // The plane leaves the depth's own relief, while the estimate's covariance is that of the points' relief.
        let relief = plane.map_or(0.0, |plane| relief_left(&better, &plane));
        let modes = said.map(|(modes, _)| modes.with_relief_error(relief)).filter(|_| is_tilted);
        let [offset, per_x, per_y] = plane.unwrap_or_default();
        Some(KeyframeCorrection {
            keyframe_id: keyframe.keyframe_id,
            map_from_keyframe: Sim3::new(place, unit * (-offset).exp()),
            depth: LogPlane { offset: 0.0, per_x, per_y },
            modes,
            // Its unit is that of the points only where they determine it.
            place: said.and_then(|(_, place)| place).filter(|_| plane.is_some()),
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
