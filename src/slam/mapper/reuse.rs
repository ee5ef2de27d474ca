//! Reuse of keyframes: a keyframe that the camera has returned to becomes active again instead of a new one next to it,
//! so that the map does not grow where the camera moves back and forth. A pose on it that differs from the expected one
//! reveals drift: if it is as certain as after a loss, the camera continues from there, and the drift ends.

use serde::{Deserialize, Serialize};

use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::{DistanceWeights, MapState};
use crate::slam::mapper::Mapper;
use crate::slam::mapper::finder::Located;
use crate::slam::mapper::recovery::{Confirmation, MAX_DISAGREEMENT, restore_points};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{Brightness, PoseEstimate};

/// Tuning of the reuse of keyframes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReuseParams {
    /// Largest distance of the camera from a keyframe that becomes active again; the tracker proposes a new one at 1.
    /// Half of that leaves as much distance before the next change; 0 makes a new keyframe every time.
    pub max_distance: f64,
    /// The tracker's weights of that distance, from the tracker's configuration.
    #[serde(skip)]
    pub distance: DistanceWeights,
    /// Largest difference of the pose measured on the keyframe from the expected one, translation in mean depths plus
    /// rotation in radians: 0.02 is 10 px at f = 525. Beyond it the map has drifted, and the keyframe is reused only if
    /// the pose is as certain as after a loss.
    pub max_disagreement: f64,
}

impl Default for ReuseParams {
    fn default() -> Self {
        Self { max_distance: 0.5, distance: DistanceWeights::default(), max_disagreement: 0.02 }
    }
}

impl ReuseParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("max_distance", self.max_distance, 0.0..=1.0)?;
        check_range("max_disagreement", self.max_disagreement, 0.0..=1.0)
    }
}

/// A keyframe near the camera, and the pose measured on it.
pub(super) struct NearKeyframe {
    /// Its index in the map.
    pub(super) index: usize,
    pub(super) keyframe_id: u64,
    pub(super) located: Located,
}

impl Mapper {
    /// Makes the nearest earlier keyframe active again, if it is near enough and shows the frame. Where it agrees with
    /// the frame's pose, it keeps its depth and gains that of the active keyframe; where it yields another pose with
    /// certainty, the active keyframe has drifted and adds nothing.
    pub(super) fn reuse_keyframe(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) -> bool {
        let max_distance = self.params.reuse.max_distance;
        // Exact poses are the world's own: they need no anchor, and do not drift.
        let is_exact = pose.alignment_covariance.iter().all(|entry| *entry == 0.0);
        let agrees = self.params.reuse.max_disagreement;
        let limit = if is_exact { agrees } else { agrees.max(MAX_DISAGREEMENT) };
        let Some(near) = self.near_keyframe(frame, pose, max_distance, limit) else { return false };
        if near.located.disagreement > agrees {
            return self.return_to(&near, frame.pixels);
        }
        if !is_exact {
            self.anchor(near.keyframe_id, &near.located.keyframe_from_camera);
        }
        self.switch_active_keyframe(
            near.index,
            relative_brightness(pose.brightness, near.located.brightness),
        );
        true
    }

    /// Continues from a keyframe on which the camera's pose differs from the expected one, if it is as certain as
    /// required after a loss.
    fn return_to(&mut self, near: &NearKeyframe, pixels: &[u8]) -> bool {
        let at = &near.located.keyframe_from_camera;
        // The active keyframe agrees with the drifted pose. Another one must have the camera nearer to the pose that
        // was found than to the drifted one.
        let by = Confirmation {
            except: self.active.as_ref().map(|active| active.index),
            max_disagreement: MAX_DISAGREEMENT.min(0.5 * near.located.disagreement),
        };
        let is_believed = near.located.is_sure
            && self.is_confirmed(near.index, at, pixels, &by)
            && self.points_agree(near.index, at, pixels);
        if is_believed {
            self.restore_keyframe(near.index, at);
        }
        is_believed
    }

    /// The nearest other keyframe within a distance of the camera, if it shows the frame and the pose measured on it
    /// differs by at most `max_disagreement` from the frame's pose.
    pub(super) fn near_keyframe(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        max_distance: f64,
        max_disagreement: f64,
    ) -> Option<NearKeyframe> {
        let present = self.keyframe()?;
        let map_from_camera = present.map_from_keyframe.transform_pose(&pose.keyframe_from_camera);
        let (index, expected) = self.nearest_keyframe(&map_from_camera, max_distance)?;
        let keyframe = self.map.keyframes.get(index)?;
        let located = self.finder.locate(keyframe, frame.pixels, &expected, max_disagreement)?;
        Some(NearKeyframe { index, keyframe_id: keyframe.keyframe_id, located })
    }

    /// The other keyframe of the epoch with the smallest distance to the camera, if that is small enough, and
    /// the camera's pose on it.
    fn nearest_keyframe(&self, map_from_camera: &SE3, max_distance: f64) -> Option<(usize, SE3)> {
        let present = self.keyframe()?;
        let params = &self.params.reuse;
        let reach = params.distance.reach(max_distance);
        let mut nearest = None;
        let mut least = max_distance;
        for (index, view) in self.map.seen_from(present.epoch, map_from_camera, reach) {
            let keyframe = &self.map.keyframes[index];
            let is_eligible = keyframe.keyframe_id != present.keyframe_id
                && keyframe.map_state == MapState::Established;
            let translation = view.keyframe_from_camera.translation.norm();
            let distance = params.distance.distance(translation, view.usage);
            if is_eligible && distance < least {
                (nearest, least) = (Some((index, view.keyframe_from_camera)), distance);
            }
        }
        nearest
    }

    /// Replaces the active keyframe by that at `index`, whose image has this brightness relative to the active one's.
    fn switch_active_keyframe(&mut self, index: usize, brightness: Brightness) {
        if self.depth.unpublished > 0 {
            self.depth.refine(&self.params);
        }
        self.publish_depth();
        let Some(keyframe) = self.keyframe() else { return };
        let (present_id, present) = (keyframe.keyframe_id, keyframe.map_from_keyframe);
        self.depth.keep_mature_points(present_id, &self.params);
        let present_unit = present.scale * self.depth.unit;
        let keyframe = &self.map.keyframes[index];
        let map_from_keyframe = keyframe.map_from_keyframe;
        self.depth.swap();
        self.depth.spare.rescale((map_from_keyframe.scale / present_unit) as f32);
        self.depth.restart(&keyframe.image, &self.params);
        let (at, propagation) =
            (map_from_keyframe.inverse_transform_pose(&present.rigid), &self.params.propagation);
        self.depth.propagate_spare(&at, brightness, &self.intrinsics, propagation);
        restore_points(&mut self.depth.active, &keyframe.points);
        self.past.clear();
        self.activate_keyframe(index);
    }
}

/// Brightness of image 2 relative to image 1, from that of one frame relative to each: with
/// `I = e^a₁ I₁ + b₁ = e^a₂ I₂ + b₂`, `I₂ = e^(a₁ − a₂) I₁ + e^(−a₂) (b₁ − b₂)`.
fn relative_brightness(against_one: Brightness, against_two: Brightness) -> Brightness {
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
        state: TrackingState,
        is_exact: bool,
    }

    impl Walk {
        fn new() -> Self {
            let params = MapperParams { min_keyframe_interval: 1, ..MapperParams::default() };
            let mapper = Mapper::new(CAMERA, params).unwrap();
            let (scene, state) = (Scene::new(3), TrackingState::Tracking);
            Self { scene, mapper, sequence: 0, state, is_exact: true }
        }

        /// Steps with a frame taken at `place` metres to the right, tracked at `claimed`; it proposes a keyframe.
        fn step(&mut self, place: f64, claimed: f64) -> StepOutcome {
            let at = |x: f64| SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            let view = self.scene.render(&CAMERA, &at(place));
            let pixels = view.noisy(1.0, self.sequence);
            let mut depth = view.inverse_depth.clone();
            depth.pixels_mut().iter_mut().for_each(|d| *d = 1.0 / *d);
            let frame =
                FrameView::new(&CAMERA, self.sequence, self.sequence as i64 * 33_333_333, &pixels);
            self.sequence += 1;
            let keyframe_id = self.mapper.keyframe().map_or(u64::MAX, |k| k.keyframe_id);
            let pose = PoseEstimate {
                state: self.state,
                alignment_covariance: [if self.is_exact { 0.0 } else { 1e-9 }; 21],
                keyframe_id,
                world_from_camera: at(claimed),
                keyframe_from_camera: self.mapper.keyframe().map_or(SE3::identity(), |keyframe| {
                    keyframe.world_from_keyframe.inverse_transform_pose(&at(claimed))
                }),
                proposes_keyframe: true,
                ..PoseEstimate::unknown(&frame)
            };
            self.mapper.step(&frame, &pose, Some(&depth), &mut || {})
        }
    }

    #[test]
    fn a_keyframe_is_reused_only_where_the_pose_agrees() {
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
        // The same path again, but the pose has drifted.
        let mut trusting = Walk::new();
        trusting.mapper.params.reuse.max_disagreement = 1.0;
        for (walk, is_restored) in [(&mut walk, false), (&mut trusting, true)] {
            walk.step(0.0, 0.0);
            walk.step(1.2, 1.2);
            assert_eq!(walk.step(0.1, 0.3).keyframe_restored, is_restored);
        }
    }

    #[test]
    fn odometry_does_not_jump_where_an_earlier_keyframe_is_reused_or_found() {
        use crate::slam::pose::LostReason;
        let place = |walk: &Walk, x: f64| {
            let keyframe = walk.mapper.keyframe().unwrap();
            let at = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            // Exact depth: the keyframe's pose in the map is where it was taken.
            keyframe
                .world_from_keyframe
                .transform_pose(&keyframe.map_from_keyframe.inverse_transform_pose(&at))
        };
        let is_tracked_or_lost =
            [TrackingState::Tracking, TrackingState::Lost(LostReason::Diverged)];
        for state in is_tracked_or_lost {
            let mut walk = Walk::new();
            walk.step(0.0, 0.0);
            walk.step(1.2, 1.2);
            // Near the first keyframe, with odometry that has drifted by a centimetre; or found there after a loss,
            // with a tracker that was restarted and has no pose.
            let is_lost = state != TrackingState::Tracking;
            let (claimed, expected) = if is_lost { (0.0, 1.2) } else { (0.11, 0.11) };
            walk.state = state;
            walk.is_exact = false;
            let outcome = walk.step(0.1, claimed);
            assert!(outcome.keyframe_restored, "{state:?}");
            assert_eq!(walk.mapper.keyframe().unwrap().keyframe_id, 0);
            let jump = (place(&walk, 0.1).translation.x - expected).abs();
            assert!(jump < 0.005, "{state:?}: odometry jumps by {jump}");
        }
    }

    #[test]
    fn the_camera_continues_from_a_keyframe_that_disagrees_only_where_that_is_certain() {
        // The camera is at 0.1 by the first keyframe, at 0.2 by the tracker: further apart than `max_disagreement`.
        let drifted = |is_believed: bool| {
            let mut walk = Walk::new();
            if !is_believed {
                // No share of inliers is enough after a loss.
                walk.mapper.finder.verdict.recovery_margin = 1.0;
            }
            walk.step(0.0, 0.0);
            walk.step(1.2, 1.2);
            walk.is_exact = false;
            (walk.step(0.1, 0.2), walk)
        };
        let (outcome, walk) = drifted(true);
        assert!(outcome.keyframe_restored);
        assert_eq!(walk.mapper.keyframe().unwrap().keyframe_id, 0);
        // The map keeps its poses, and the depth of the drifted keyframe is not carried over.
        let depth = &walk.mapper.depth.active;
        let held = walk.mapper.map.keyframes[0].points.len();
        assert!(depth.num_hypotheses() <= held, "{} of {held} points", depth.num_hypotheses());
        let (outcome, walk) = drifted(false);
        assert!(!outcome.keyframe_restored && outcome.keyframe_created);
        assert_eq!(walk.mapper.map.keyframes.len(), 3);
    }

    #[test]
    fn a_largest_distance_of_zero_makes_a_new_keyframe_every_time() {
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
        let found = relative_brightness(one, two);
        assert!((found.a.exp() * 100.0 + found.b - expected).abs() < 1e-9);
    }
}
