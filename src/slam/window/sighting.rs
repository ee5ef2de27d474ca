//! Checks whether an image shows the window's points from an assumed camera pose.

use crate::slam::geometry::se3::SE3;
use crate::slam::window::members::MIN_COMMON;
use crate::slam::window::{ALIGNMENT_LEVELS, MAX_ALIGNMENT_ITERATIONS, Window};

/// A camera's pose as determined by the points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// The pose at which they fit best, translation in the unit of the given keyframe.
    pub keyframe_from_camera: SE3,
    /// Share of the points in view that the image agrees with there.
    pub agreeing: f64,
}

impl Window {
    /// Aligns an image to the points of the keyframes that see most of what it shows, from an initial pose on one of
    /// them, translation in that one's unit. `None` where too few points are in view, or the keyframe is unknown. The
    /// window does not change.
    pub fn localise(
        &mut self,
        keyframe_id: u64,
        keyframe_from_camera: &SE3,
        pixels: &[u8],
    ) -> Option<Sighting> {
        let known = self.get(keyframe_id)?;
        let (map_from_known, unit, epoch) =
            (known.camera_from_map.inverse(), known.unit, known.epoch);
        let scaled = |by: f64, pose: &SE3| SE3 {
            translation: pose.translation * by,
            rotation: pose.rotation,
        };
        let map_from_camera = map_from_known * scaled(unit, keyframe_from_camera);
        self.push_camera(epoch, pixels.into(), map_from_camera.inverse(), unit)?;
        let last = self.keyframes.len() - 1;
        let mut members = self.hosts_to_align_to(last);
        let at_rest: Vec<usize> =
            members.iter().copied().filter(|&of| self.keyframes[of].images.len() == 1).collect();
        members.push(last);
        let is_aligned = members.len() > 1
            && self.align_last(&members, &ALIGNMENT_LEVELS, MAX_ALIGNMENT_ITERATIONS);
        for of in at_rest {
            self.keyframes[of].drop_pyramid();
        }
        let placed = self.keyframes.pop()?;
        let system = &self.solver.system;
        let is_seen = is_aligned && system.compared >= MIN_COMMON;
        is_seen.then(|| Sighting {
            keyframe_from_camera: scaled(
                1.0 / unit,
                &(map_from_known.inverse() * placed.camera_from_map.inverse()),
            ),
            agreeing: system.inliers as f64 / system.compared as f64,
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::test_scene::{CAMERA, Scene};
    use crate::slam::window::params::WindowParams;
    use crate::slam::window::tests::room;

    /// A window of the room, and an image that was taken near its second keyframe.
    fn window_and_image() -> (Window, SE3, Vec<u8>) {
        let mut window = Window::new(CAMERA, WindowParams::default());
        window.keyframes = room(|_, _| (1.0, 0.0)).keyframes;
        let map_from_camera = SE3::exp(&Vector6::new(0.15, 0.0, 0.02, 0.02, -0.01, 0.01));
        let pixels = Scene::new(3).render(&CAMERA, &map_from_camera).noisy(2.0, 77);
        let second_from_camera = window.keyframes[1].camera_from_map * map_from_camera;
        (window, second_from_camera, pixels)
    }

    #[test]
    fn the_points_determine_where_an_image_was_taken() {
        let (mut window, truth, pixels) = window_and_image();
        let before = window.keyframes.clone();
        let off = SE3::exp(&Vector6::new(0.01, 0.01, 0.0, 0.005, 0.005, 0.0));
        let found = window.localise(1, &(off * truth), &pixels).unwrap();
        let error = (found.keyframe_from_camera * truth.inverse()).log().norm();
        assert!(error < 0.002 && found.agreeing > 0.9, "{error} {found:?}");
        assert!(window.keyframes == before, "asking changes nothing");
        // On a keyframe with another unit the pose is in that unit.
        window.keyframes[1].unit = 2.0;
        let halved = SE3 { translation: truth.translation * 0.5, ..truth };
        let again = window.localise(1, &halved, &pixels).unwrap();
        let apart = (again.keyframe_from_camera.translation - halved.translation).norm();
        assert!(apart < 0.001, "{apart}");
    }

    #[test]
    fn an_image_of_something_else_does_not_agree() {
        let (mut window, truth, _) = window_and_image();
        let elsewhere = Scene::new(8).render(&CAMERA, &SE3::identity()).noisy(2.0, 5);
        let found = window.localise(1, &truth, &elsewhere).unwrap();
        assert!(found.agreeing < 0.4, "{found:?}");
        assert_eq!(window.localise(99, &truth, &elsewhere), None, "no such keyframe");
        assert_eq!(window.localise(1, &truth, &elsewhere[1..]), None, "not of this camera");
        let turned = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 3.0, 0.0));
        assert_eq!(window.localise(1, &turned, &elsewhere), None, "nothing is in view");
    }
}
