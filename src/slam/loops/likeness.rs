//! Finds keyframes that look like a given one, wherever the map places them.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::slam::keyframe::Keyframe;
use crate::slam::places::{Description, PlaceCandidate, PlaceIndex};

/// Appearance of the keyframes.
#[derive(Debug, Clone, Default)]
pub(super) struct AppearanceIndex {
    index: PlaceIndex,
    /// The newest one offered.
    offered_to: Option<u64>,
    /// To be inserted when there is time: in the thread of the search.
    offered: Vec<(u64, Arc<Description>)>,
    /// Descriptions of the keyframes still to be searched.
    waiting: BTreeMap<u64, Arc<Description>>,
}

impl AppearanceIndex {
    /// Takes the descriptions of new keyframes; one whose image is too small has none. Returns the index of the first
    /// new one.
    pub(super) fn offer(&mut self, keyframes: &[Keyframe]) -> usize {
        let new = keyframes.partition_point(|of| Some(of.keyframe_id) <= self.offered_to);
        for keyframe in &keyframes[new..] {
            self.offered_to = Some(keyframe.keyframe_id);
            let description = keyframe.description.clone();
            self.offered.extend(description.map(|of| (keyframe.keyframe_id, of)));
        }
        new
    }

    /// Inserts the offered descriptions, and removes those no longer in `known`, which is in order.
    pub(super) fn enter(&mut self, known: &[u64]) {
        let is_gone = |id: &u64| known.binary_search(id).is_err();
        let gone: Vec<u64> = self.index.keyframe_ids().filter(is_gone).collect();
        for id in gone {
            self.index.remove(id);
            self.waiting.remove(&id);
        }
        for (keyframe_id, description) in self.offered.drain(..) {
            self.index.insert(keyframe_id, &description);
            self.waiting.insert(keyframe_id, description);
        }
    }

    /// Forgets a keyframe and those before it, as they will not be searched any more.
    pub(super) fn forget(&mut self, keyframe_id: u64) {
        self.waiting = self.waiting.split_off(&keyframe_id.saturating_add(1));
    }

    /// The keyframes of `among`, which is in order, that look most like a given one, with at least `least` features in
    /// common, the most similar first; no two of them adjacent in `among`, as those would show the same.
    pub(super) fn candidates(
        &self,
        of: u64,
        among: &[u64],
        most: usize,
        least: f32,
    ) -> Vec<PlaceCandidate> {
        /// Positions in the list within which two show the same.
        const BESIDE: usize = 3;
        let Some(description) = self.waiting.get(&of) else { return Vec::new() };
        let place = |id: u64| among.binary_search(&id).ok();
        // Enough to drop all that are next to a chosen one.
        let most_found = most * (2 * BESIDE + 1);
        let found = self.index.candidates(description, most_found, |id| place(id).is_none());
        let mut chosen: Vec<(usize, PlaceCandidate)> = Vec::new();
        for candidate in found.into_iter().filter(|of| of.score >= least) {
            let Some(at) = place(candidate.keyframe_id) else { continue };
            if chosen.len() < most && chosen.iter().all(|(other, _)| other.abs_diff(at) > BESIDE) {
                chosen.push((at, candidate));
            }
        }
        chosen.into_iter().map(|(_, candidate)| candidate).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::places::Describer;
    use crate::slam::test_scene::{CAMERA, Scene};
    use nalgebra::Vector6;

    #[test]
    fn a_view_is_found_with_its_rotation() {
        let scene = Scene::new(3);
        let pixels = |pose: &SE3| scene.render(&CAMERA, pose).noisy(2.0, 1);
        let mut likeness = AppearanceIndex::default();
        let turned = SE3::exp(&Vector6::new(0.05, 0.0, 0.0, 0.06, -0.15, 0.4));
        let away = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 2.6, 0.0));
        for (id, pose) in [(1, SE3::identity()), (5, away), (9, turned)] {
            let image = pixels(&pose);
            let description = Describer::default().describe(&image, CAMERA.width, CAMERA.height);
            likeness.offer(&[Keyframe {
                keyframe_id: id,
                description: description.map(Arc::new),
                ..Keyframe::at(Sim3::identity(), CAMERA, Vec::new(), image)
            }]);
        }
        likeness.enter(&[1, 5, 9]);
        let found = likeness.candidates(9, &[1, 5], 3, 10.0);
        assert_eq!(found.iter().map(|of| of.keyframe_id).collect::<Vec<_>>(), [1]);
        let error = found[0].rotation(&CAMERA).angle_to(&turned.rotation);
        assert!(error < 0.12, "{error}");
        likeness.enter(&[5, 9]);
        assert!(likeness.candidates(9, &[1, 5], 3, 10.0).is_empty(), "1 is gone");
        likeness.forget(9);
        assert!(likeness.waiting.is_empty() && likeness.offered.is_empty());
    }
}
