//! Which keyframes look like one, wherever they are thought to be.

use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::places::{Candidate, Describer, Description, PlaceIndex};

/// What keyframes look like.
#[derive(Debug, Clone, Default)]
pub(super) struct Likeness {
    describer: Option<Describer>,
    index: PlaceIndex,
    /// Of those that are still to be looked for.
    waiting: BTreeMap<u64, Description>,
}

/// A keyframe that looks like another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Alike {
    pub(super) keyframe_id: u64,
    /// Features that both show, in the same arrangement.
    pub(super) score: f32,
    /// How it is turned: `candidate_from_keyframe`.
    pub(super) rotation: UnitQuaternion<f64>,
}

impl Likeness {
    /// Enters a keyframe; one whose image is too small to look like anything is left out.
    pub(super) fn insert(&mut self, keyframe_id: u64, pixels: &[u8], width: usize, height: usize) {
        let describer = self.describer.get_or_insert_default();
        let Some(description) = describer.describe(pixels, width, height) else { return };
        self.index.insert(keyframe_id, &description);
        self.waiting.insert(keyframe_id, description);
    }

    /// A keyframe and those before it will not be looked for any more.
    pub(super) fn forget(&mut self, keyframe_id: u64) {
        self.waiting = self.waiting.split_off(&keyframe_id.saturating_add(1));
    }

    /// Of `among`, which is in order, those that look most like a keyframe, with at least so many features in common, the
    /// most alike first; no two beside each other in `among`, which would show the same.
    pub(super) fn candidates(
        &self,
        of: u64,
        among: &[u64],
        most: usize,
        least: f32,
        camera: &Intrinsics,
    ) -> Vec<Alike> {
        /// Places in the list within which two show the same.
        const BESIDE: usize = 3;
        let Some(description) = self.waiting.get(&of) else { return Vec::new() };
        let place = |id: u64| among.binary_search(&id).ok();
        // As many again as can be beside one.
        let most_found = most * (2 * BESIDE + 1);
        let found = self.index.candidates(description, most_found, |id| place(id).is_none());
        let mut chosen: Vec<(usize, Alike)> = Vec::new();
        for candidate in found.into_iter().filter(|of| of.score >= least) {
            let Some(at) = place(candidate.keyframe_id) else { continue };
            if chosen.len() < most && chosen.iter().all(|(other, _)| other.abs_diff(at) > BESIDE) {
                let Candidate { keyframe_id, score, .. } = candidate;
                let rotation = rotation(&candidate, camera);
                chosen.push((at, Alike { keyframe_id, score, rotation }));
            }
        }
        chosen.into_iter().map(|(_, alike)| alike).collect()
    }
}

/// `candidate_from_keyframe` by the pixels that show the same and the turn in the image's plane.
fn rotation(candidate: &Candidate, camera: &Intrinsics) -> UnitQuaternion<f64> {
    let ray = |[u, v]: [f32; 2]| {
        let (x, y) = (f64::from(u) - camera.cx, f64::from(v) - camera.cy);
        Vector3::new(x / camera.fx, y / camera.fy, 1.0)
    };
    let turn = -f64::from(candidate.turn_rad);
    let about_axis = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
    let [ours, theirs] = [about_axis * ray(candidate.pixel), ray(candidate.keyframe_pixel)];
    let between = UnitQuaternion::rotation_between(&ours, &theirs);
    between.unwrap_or_else(UnitQuaternion::identity) * about_axis
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::test_scene::{CAMERA, Scene};
    use nalgebra::Vector6;

    #[test]
    fn a_view_is_found_with_the_rotation_that_it_has() {
        let scene = Scene::new(3);
        let pixels = |pose: &SE3| scene.render(&CAMERA, pose).noisy(2.0, 1);
        let mut likeness = Likeness::default();
        let turned = SE3::exp(&Vector6::new(0.05, 0.0, 0.0, 0.06, -0.15, 0.4));
        let away = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 2.6, 0.0));
        for (id, pose) in [(1, SE3::identity()), (5, away), (9, turned)] {
            likeness.insert(id, &pixels(&pose), CAMERA.width, CAMERA.height);
        }
        let found = likeness.candidates(9, &[1, 5], 3, 10.0, &CAMERA);
        assert_eq!(found.iter().map(|of| of.keyframe_id).collect::<Vec<_>>(), [1]);
        let error = found[0].rotation.angle_to(&turned.rotation);
        assert!(error < 0.12, "{error}");
        likeness.forget(9);
        assert!(likeness.candidates(9, &[1, 5], 3, 10.0, &CAMERA).is_empty());
    }
}
