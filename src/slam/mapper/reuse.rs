//! A keyframe that the camera has come back to is taken up again instead of making a new one beside it:
//! where the camera goes to and fro the map does not grow.

use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::matching::is_inside;
use crate::slam::depth::propagation::propagate;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::mapper::Mapper;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{Brightness, PoseEstimate};

/// Tuning of the reuse of keyframes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReuseParams {
    /// Largest distance of the camera from a keyframe that is taken up again, where the tracker asks
    /// for a new one at 1: `(w_d ‖t‖ d̄)² + (w_u (1 − usage))²` (LSD14 §3.4). Half of it leaves as much
    /// to go before the next change; 0 makes a new keyframe every time.
    pub max_distance: f64,
    /// w_d of that distance.
    pub distance_weight: f64,
    /// w_u of that distance: usage is the share of the keyframe's points that the camera sees.
    pub usage_weight: f64,
    /// How far the pose measured on the keyframe may be from the one expected, translation in mean
    /// depths plus rotation in radians: 0.02 is 10 px at f = 525. Beyond it the map has drifted, and
    /// taking the keyframe up would make the poses jump.
    pub max_disagreement: f64,
}

impl Default for ReuseParams {
    fn default() -> Self {
        Self { max_distance: 0.5, distance_weight: 3.0, usage_weight: 4.0, max_disagreement: 0.02 }
    }
}

impl ReuseParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("max_distance", self.max_distance, 0.0..=1.0)?;
        check_range("distance_weight", self.distance_weight, 0.0..=1e3)?;
        check_range("usage_weight", self.usage_weight, 0.0..=1e3)?;
        check_range("max_disagreement", self.max_disagreement, 0.0..=1.0)
    }
}

impl Mapper {
    /// Puts the nearest earlier keyframe in force again, if one is near enough, shows the frame and
    /// agrees with its pose. Its depth is what it was left with and what the present keyframe adds.
    pub(super) fn reuse_keyframe(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) -> bool {
        let Some(index) = self.nearest_keyframe(&pose.world_from_camera) else { return false };
        let keyframe = &self.map.keyframes[index];
        let expected = keyframe.world_from_keyframe.locate(&pose.world_from_camera);
        let Some(measured) = self.recovery.locate(keyframe, frame.pixels, &expected) else {
            return false;
        };
        let camera_from_keyframe = measured.state.current_from_keyframe;
        let error = (camera_from_keyframe * expected).log();
        let disagreement = error.fixed_rows::<3>(0).norm() + error.fixed_rows::<3>(3).norm();
        if !(disagreement <= self.params.reuse.max_disagreement) {
            return false;
        }
        let brightness = between(pose.brightness, measured.state.brightness);
        self.take_up(index, brightness);
        true
    }

    /// The keyframe of the epoch with the smallest distance to the camera, if that is small enough.
    fn nearest_keyframe(&self, world_from_camera: &SE3) -> Option<usize> {
        let present = self.keyframe()?;
        let params = &self.params.reuse;
        let mut nearest = None;
        let mut least = params.max_distance;
        for (index, keyframe) in self.map.keyframes.iter().enumerate() {
            let is_eligible = keyframe.keyframe_id != present.keyframe_id
                && keyframe.epoch == present.epoch
                && keyframe.map_state == MapState::Established
                // The oldest of a large map keep only their poses.
                && !keyframe.image.is_empty()
                && !keyframe.points.is_empty();
            if !is_eligible {
                continue;
            }
            let keyframe_from_camera = keyframe.world_from_keyframe.locate(world_from_camera);
            let from_distance =
                (params.distance_weight * keyframe_from_camera.translation.norm()).powi(2);
            if from_distance >= least {
                continue;
            }
            let unused = 1.0 - usage(keyframe, &keyframe_from_camera);
            let distance = from_distance + (params.usage_weight * unused).powi(2);
            if distance < least {
                (nearest, least) = (Some(index), distance);
            }
        }
        nearest
    }

    /// Leaves the present keyframe for that at `index`, whose image is `brightness` of the present one's.
    fn take_up(&mut self, index: usize, brightness: Brightness) {
        self.is_unit_open = false;
        if self.unpublished > 0 {
            self.refine();
        }
        self.publish_depth();
        let Some(present) = self.keyframe().map(|keyframe| keyframe.world_from_keyframe) else {
            return;
        };
        let keyframe = &self.map.keyframes[index];
        let world_from_keyframe = keyframe.world_from_keyframe;
        std::mem::swap(&mut self.depth, &mut self.next_depth);
        self.next_depth.rescale((world_from_keyframe.scale / present.scale) as f32);
        let (min_gradient, max_candidates) = (self.params.min_gradient, self.params.max_candidates);
        self.depth.restart(&keyframe.image, min_gradient, max_candidates);
        propagate(
            &self.next_depth,
            &mut self.depth,
            &self.intrinsics,
            &world_from_keyframe.locate(&present.rigid),
            brightness,
            &self.params.propagation,
        );
        self.restore_points(index);
        self.past.clear();
        self.enter_keyframe(index);
        self.plant_points();
        self.publish_depth();
    }
}

/// Share of a keyframe's points that a camera sees; every so many are enough for a share.
fn usage(keyframe: &Keyframe, keyframe_from_camera: &SE3) -> f64 {
    const STRIDE: usize = 16;
    let Intrinsics { width, height, .. } = keyframe.intrinsics;
    let view = TwoView::new(&keyframe.intrinsics, &keyframe_from_camera.inverse());
    let (mut seen, mut all) = (0u32, 0u32);
    for point in keyframe.points.iter().step_by(STRIDE) {
        let at = view.line(f32::from(point.u), f32::from(point.v)).project(point.inverse_depth);
        seen += u32::from(at.is_some_and(|at| is_inside(width, height, at.u, at.v)));
        all += 1;
    }
    f64::from(seen) / f64::from(all.max(1))
}

/// The brightness of image 2 against image 1, from that of one frame against each: with
/// `I = e^a₁ I₁ + b₁ = e^a₂ I₂ + b₂`, `I₂ = e^(a₁ − a₂) I₁ + e^(−a₂) (b₁ − b₂)`.
fn between(against_one: Brightness, against_two: Brightness) -> Brightness {
    Brightness {
        a: against_one.a - against_two.a,
        b: (-against_two.a).exp() * (against_one.b - against_two.b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::mapper::{MapperParams, StepOutcome};
    use crate::slam::pose::TrackingState;
    use crate::slam::test_scene::{CAMERA, Scene};

    /// A camera in front of a scene, with exact depth for its keyframes.
    struct Walk {
        scene: Scene,
        mapper: Mapper,
        sequence: u64,
    }

    impl Walk {
        fn new() -> Self {
            let params = MapperParams { min_keyframe_interval: 1, ..MapperParams::default() };
            let mapper = Mapper::new(CAMERA, params).unwrap();
            Self { scene: Scene::new(3), mapper, sequence: 0 }
        }

        /// A frame taken at `place` metres to the right, said to be at `claimed`; a keyframe is asked for.
        fn step(&mut self, place: f64, claimed: f64) -> StepOutcome {
            let at = |x: f64| SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            let view = self.scene.render(&CAMERA, &at(place));
            let pixels = view.noisy(1.0, self.sequence);
            let mut depth = view.inverse_depth.clone();
            depth.pixels_mut().iter_mut().for_each(|d| *d = 1.0 / *d);
            let frame = FrameView {
                sequence: self.sequence,
                capture_nanos: self.sequence as i64 * 33_333_333,
                exposure_nanos: 0,
                width: CAMERA.width,
                height: CAMERA.height,
                pixels: &pixels,
            };
            self.sequence += 1;
            let keyframe_id = self.mapper.keyframe().map_or(u64::MAX, |k| k.keyframe_id);
            let pose = PoseEstimate {
                state: TrackingState::Tracking,
                keyframe_id,
                world_from_camera: at(claimed),
                proposes_keyframe: true,
                ..PoseEstimate::unknown(&frame)
            };
            self.mapper.step(&frame, &pose, Some(&depth), &mut || {})
        }
    }

    #[test]
    fn a_keyframe_is_taken_up_again_where_the_pose_agrees_and_only_there() {
        let mut walk = Walk::new();
        assert!(walk.step(0.0, 0.0).keyframe_created);
        assert!(walk.step(1.2, 1.2).keyframe_created);
        let left = walk.mapper.map.keyframes[0].points.len();
        let back = walk.step(0.1, 0.1);
        assert!(back.keyframe_restored && back.needs_image() && !back.graph_changed);
        assert_eq!(walk.mapper.map.keyframes.len(), 2);
        let first = walk.mapper.keyframe().unwrap();
        assert_eq!(first.keyframe_id, 0);
        assert!(first.points.len() * 10 >= left * 9, "{} of {left} points", first.points.len());
        // The same way again, but the pose has drifted.
        let mut trusting = Walk::new();
        trusting.mapper.params.reuse.max_disagreement = 1.0;
        for (walk, is_restored) in [(&mut walk, false), (&mut trusting, true)] {
            walk.step(0.0, 0.0);
            walk.step(1.2, 1.2);
            assert_eq!(walk.step(0.1, 0.3).keyframe_restored, is_restored);
        }
    }

    #[test]
    fn zero_makes_a_new_keyframe_every_time() {
        let mut walk = Walk::new();
        walk.mapper.params.reuse.max_distance = 0.0;
        for place in [0.0, 1.2, 0.0, 1.2] {
            assert!(walk.step(place, place).keyframe_created);
        }
    }

    #[test]
    fn brightness_between_two_images_follows_from_a_third() {
        // I = e^0.3 I₁ + 5 and I = e^−0.1 I₂ + 2.
        let (one, two) = (Brightness { a: 0.3, b: 5.0 }, Brightness { a: -0.1, b: 2.0 });
        let frame = 0.3f64.exp() * 100.0 + 5.0;
        let expected = (frame - 2.0) / (-0.1f64).exp();
        let found = between(one, two);
        assert!((found.a.exp() * 100.0 + found.b - expected).abs() < 1e-9);
    }
}
