//! Which points of other keyframes a keyframe agrees with.
//!
//! A point that projects into an image may be occluded: behind a wall the points of the next room project into a
//! keyframe as well, more of them than of its own surroundings if it sees the wall from near.

use crate::slam::window::Window;
use crate::slam::window::keyframe::Agreed;

/// Least share of inliers among the comparisons with a host's points at which some of them are taken as seen: of points
/// behind a wall one in ten to three agrees by chance, more on a wall of little contrast; of visible ones four in five,
/// and of a host seen through a door a share in between.
const MIN_SHARE: f64 = 0.3;

impl Window {
    /// Records, right after an adjustment, the points that members agree with whose own points are still to be chosen:
    /// it is their depth that is compared with others' points.
    pub(super) fn note_agreement(&mut self, members: &[usize]) {
        let most_energy = self.robustness().most_energy;
        let (views, system) = (&self.solver.views, &self.solver.system);
        for (place, &member) in members.iter().enumerate() {
            if self.keyframes[member].is_host {
                continue;
            }
            let mut agreed = std::mem::take(&mut self.keyframes[member].agreed);
            agreed.clear();
            for pair in views.pairs.iter().filter(|pair| pair.observer == place) {
                let inliers = system.inliers_among(pair.places(), most_energy);
                if (inliers as f64) < MIN_SHARE * pair.count as f64 {
                    continue;
                }
                let keyframe_id = self.keyframes[members[pair.host]].keyframe_id;
                let counts = |at: &usize| system.inliers_among(*at..*at + 1, most_energy) > 0;
                let point = |at: usize| views.points[views.slots[at]].point;
                let of_pair = pair.places().filter(counts);
                agreed.extend(of_pair.map(|at| Agreed { keyframe_id, point: point(at) }));
            }
            self.keyframes[member].agreed = agreed;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::image::shared::SharedImage;
    use crate::slam::keyframe::DepthPoint;
    use crate::slam::test_scene::{CAMERA, Random};
    use crate::slam::window::params::WindowParams;
    use crate::slam::window::tests::room;

    #[test]
    fn a_new_keyframe_agrees_with_visible_points_and_not_with_occluded_ones() {
        let mut window = Window::new(CAMERA, WindowParams::default());
        window.keyframes = room(|_, _| (1.0, 0.0)).keyframes;
        let members: Vec<usize> = (0..window.keyframes.len()).collect();
        let last = *members.last().unwrap();
        (window.keyframes[last].is_host, window.keyframes[last].points) = (false, Vec::new());
        assert!(window.align_last(&members, &[0], 0));
        window.note_agreement(&members);
        let seen = window.keyframes[last].agreed.len();
        assert!(seen > 0 && seen <= window.solver.system.inliers, "{seen}");
        assert!(members[..last].iter().all(|&of| window.keyframes[of].agreed.is_empty()));
        let pixels = (8..CAMERA.width).flat_map(|u| (8..CAMERA.height).map(move |v| (u, v)));
        let mut depth: Vec<DepthPoint> = pixels
            .map(|(u, v)| DepthPoint {
                u: u as u16,
                v: v as u16,
                inverse_depth: 1.0,
                variance: 1e-4,
                intensity: 0.0,
            })
            .collect();
        depth.sort_by_key(|point| (point.v, point.u));
        assert!(!window.projected_correspondences(last, &depth).is_empty());
        // Something else occludes all of it.
        let mut random = Random::new(5);
        let mut wall = vec![0u8; CAMERA.width * CAMERA.height];
        wall.fill_with(|| (128.0 + 40.0 * random.normal()).clamp(0.0, 255.0) as u8);
        let wall = SharedImage::try_from_pixels(CAMERA.width, CAMERA.height, wall.into());
        window.keyframes[last].images = vec![wall.unwrap()];
        assert!(window.align_last(&members, &[0], 0));
        window.note_agreement(&members);
        assert_eq!(window.keyframes[last].agreed, []);
        assert!(
            window.projected_correspondences(last, &depth).is_empty(),
            "they say nothing of its depth"
        );
    }
}
