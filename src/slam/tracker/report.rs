//! Assembles the estimate of a frame: judged, with its covariance, or not claimed; and requests new keyframes.

use nalgebra::Matrix6;

use crate::slam::alignment::align::Alignment;
use crate::slam::alignment::reference::Reference;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::pose::{
    Brightness, LostReason, NO_KEYFRAME, PoseEstimate, Quality, TrackingState, UNKNOWN_VARIANCE,
    upper_triangle,
};
use crate::slam::tracker::Tracker;
use crate::slam::tracker::covariance_floor::displacement_covariance;
use crate::slam::tracker::velocity::PoseErrors;
use crate::slam::tracker::verdict::quality_of;

/// Pose of the camera.
struct CameraPose {
    keyframe_from_camera: SE3,
    world_from_camera: SE3,
    map_from_camera: SE3,
}

impl CameraPose {
    /// The pose found by `alignment`.
    fn of(reference: &Reference, alignment: &Alignment) -> Self {
        let keyframe_from_camera = alignment.state.current_from_keyframe.inverse();
        Self {
            keyframe_from_camera,
            world_from_camera: reference
                .world_from_keyframe()
                .transform_pose(&keyframe_from_camera),
            map_from_camera: reference.map_from_keyframe().transform_pose(&keyframe_from_camera),
        }
    }

    fn is_finite(&self) -> bool {
        self.world_from_camera.is_finite() && self.map_from_camera.is_finite()
    }
}

impl Tracker {
    /// Judges the alignment and puts the estimate together.
    pub(super) fn report(
        &mut self,
        reference: &Reference,
        frame: &FrameView<'_>,
        alignment: &Alignment,
        missing: u64,
    ) -> PoseEstimate {
        let quality = self.quality(alignment);
        let placed = CameraPose::of(reference, alignment);
        let (nanos, world_from_camera) = (frame.capture_nanos, &placed.world_from_camera);
        if self.contradicts_hold(nanos, world_from_camera) {
            return self.lost(frame, reference, LostReason::TooFewInliers, quality);
        }
        let has_jumped = missing == 0 && self.has_jumped(reference, nanos, world_from_camera);
        let must_be_sure = self.memory.was_lost || has_jumped;
        let verdict = self.params.verdict.judge(alignment, &quality, must_be_sure, missing);
        if let TrackingState::Lost(reason) = verdict {
            return self.lost(frame, reference, reason, quality);
        }
        let is_doubtful = quality.inlier_ratio < self.least_inliers_astray();
        if is_doubtful && self.is_astray(reference, nanos, world_from_camera) {
            return self.lost(frame, reference, LostReason::TooFewInliers, quality);
        }
        let covariance = alignment.covariance(&self.params.alignment);
        let Some(covariance) = covariance.filter(|_| placed.is_finite()) else {
            return self.lost(frame, reference, LostReason::TooFewInliers, quality);
        };
        self.memory.motion.observe(nanos, world_from_camera);
        self.memory.brightness = alignment.state.brightness;
        let estimate = self.unclaimed(frame, Some(reference), verdict);
        self.claim(reference, alignment, &placed, &covariance, PoseEstimate { quality, ..estimate })
    }

    /// Whether the camera was lost for so long that it may be anywhere, and this is not where it was: the mapper has not
    /// found it there, and no second keyframe confirms it.
    fn is_astray(&self, reference: &Reference, nanos: i64, world_from_camera: &SE3) -> bool {
        /// Largest distance from there of a camera that stood still, mean depths plus radians.
        const MAX_DISTANCE: f64 = 0.1;
        if !self.memory.was_lost || !self.memory.whereabouts.is_unknown(nanos) {
            return false;
        }
        let mean_depth = reference.mean_depth_in_world();
        let is_there = |last: SE3| {
            let off = last.inverse() * *world_from_camera;
            off.translation.norm() / mean_depth + off.rotation.angle() <= MAX_DISTANCE
        };
        !self.memory.motion.last().is_some_and(is_there)
    }

    /// Least share of inliers of such a pose. On redkitchen with blackouts two wrong ones had 0.80 and 0.81, fourteen
    /// right ones 0.90 and more.
    fn least_inliers_astray(&self) -> f64 {
        /// Share of the way from what a lost camera needs to all points: 0.87 by default.
        const FURTHER: f64 = 0.35;
        let verdict = &self.params.verdict;
        let least = (verdict.lost_inliers + verdict.recovery_margin).min(1.0);
        least + FURTHER * (1.0 - least)
    }

    /// An estimate with its pose and the covariance of that: `covariance` is that of the alignment, to which the common
    /// errors of the depth and the displacement of the whole image are added.
    fn claim(
        &mut self,
        reference: &Reference,
        alignment: &Alignment,
        placed: &CameraPose,
        covariance: &Matrix6<f64>,
        unclaimed: PoseEstimate,
    ) -> PoseEstimate {
        let CameraPose { keyframe_from_camera, world_from_camera, map_from_camera } = *placed;
        let PoseEstimate { state, quality, .. } = unclaimed;
        let displacement = displacement_covariance(
            quality.displacement_px,
            &self.intrinsics,
            reference.mean_inverse_depth(),
        );
        let published = covariance
            + alignment.covariance_from_modes(reference).unwrap_or_default()
            + displacement;
        let in_map = reference.uncertain_pose().of_camera(&keyframe_from_camera, &published);
        let errors = PoseErrors {
            keyframe: (reference.keyframe_id(), reference.epoch()),
            unit: reference.world_from_keyframe().scale,
            alignment: *covariance,
            displacement,
            by_mode: alignment.d_pose_d_modes(reference).unwrap_or_default(),
            modes: *reference.mode_covariance(),
        };
        let motion = &self.memory.motion;
        // A repeated image shows none.
        let velocity = match motion.is_repeat() {
            true => None,
            false => self.memory.velocity.observe(errors, motion.last_step()),
        };
        PoseEstimate {
            world_from_camera,
            map_from_camera,
            keyframe_from_camera,
            covariance: upper_triangle(|row, column| published[(row, column)]),
            map_covariance: upper_triangle(|row, column| in_map[(row, column)]),
            alignment_covariance: upper_triangle(|row, column| covariance[(row, column)]),
            velocity: velocity.filter(|_| state.is_tracked()),
            brightness: alignment.state.brightness,
            proposes_keyframe: self.proposes_keyframe(reference, alignment, &quality),
            ..unclaimed
        }
    }

    /// Whether a new keyframe is due: the camera is far from this one, or the light has changed.
    fn proposes_keyframe(
        &self,
        reference: &Reference,
        alignment: &Alignment,
        quality: &Quality,
    ) -> bool {
        let translation = alignment.state.current_from_keyframe.translation.norm();
        let in_mean_depths = translation * reference.mean_inverse_depth();
        self.params.keyframe_distance().distance(in_mean_depths, quality.in_view_ratio) > 1.0
            || self.has_other_light(reference, &alignment.state.brightness)
    }

    /// Whether the keyframe's mean grey value appears brighter or darker in a frame by more than the limit.
    fn has_other_light(&self, reference: &Reference, brightness: &Brightness) -> bool {
        /// Below a few grey levels the ratio is noise.
        const MIN_GREY: f64 = 5.0;
        let in_keyframe = reference.mean_grey().max(MIN_GREY);
        let in_frame = (brightness.a.exp() * in_keyframe + brightness.b).max(MIN_GREY);
        (in_frame / in_keyframe).ln().abs() > self.params.keyframe_brightness_ratio.ln()
    }

    /// The figures of an alignment, with the displacement of the whole image.
    pub(super) fn quality(&self, alignment: &Alignment) -> Quality {
        let displacement_px = self.params.covariance_floor.displacement_px(
            &alignment.scatter.misfit,
            alignment.state.sums.mean_energy(),
            &self.intrinsics,
        );
        Quality { displacement_px, ..quality_of(alignment) }
    }

    /// Whether a pose deviates from constant motion by more than hands or wheels cause: such a pose must be as certain
    /// as after a loss. The last points at the edge of a view fit nearly anything.
    fn has_jumped(&self, reference: &Reference, nanos: i64, world_from_camera: &SE3) -> bool {
        /// Largest change of the rotation from one frame to the next at 30 Hz, radians: 9°.
        const MAX_ROTATION_RAD: f64 = 0.15;
        /// The same of the translation, in mean depths.
        const MAX_TRANSLATION: f64 = 0.15;
        /// Share of its last step by which a fast camera may brake or turn in one frame.
        const MAX_STEP_CHANGE_RATIO: f64 = 0.5;
        let motion = &self.memory.motion;
        let (Some((intervals, step)), Some(predicted)) =
            (motion.step(nanos), motion.predict(nanos, 1.0))
        else {
            return false;
        };
        let off = predicted.inverse() * *world_from_camera;
        let mean_depth = reference.mean_depth_in_world();
        let most =
            |least: f64, of_step: f64| (least * intervals).max(MAX_STEP_CHANGE_RATIO * of_step);
        off.rotation.angle() > most(MAX_ROTATION_RAD, step.rotation.angle())
            || off.translation.norm() > most(MAX_TRANSLATION * mean_depth, step.translation.norm())
    }

    /// The estimate of a frame that could not be aligned: repeats the last pose, not claimed.
    pub(super) fn lost(
        &mut self,
        frame: &FrameView<'_>,
        reference: &Reference,
        reason: LostReason,
        quality: Quality,
    ) -> PoseEstimate {
        self.memory.motion.stop();
        self.memory.brightness = Brightness::default();
        let quality = if is_finite(&quality) { quality } else { Quality::default() };
        PoseEstimate {
            quality,
            ..self.unclaimed(frame, Some(reference), TrackingState::Lost(reason))
        }
    }

    /// An estimate that claims nothing and repeats the last pose.
    pub(super) fn unclaimed(
        &self,
        frame: &FrameView<'_>,
        reference: Option<&Reference>,
        state: TrackingState,
    ) -> PoseEstimate {
        let world_from_camera = self.memory.motion.last().unwrap_or_else(SE3::identity);
        let located = reference
            .map(|reference| {
                reference.world_from_keyframe().inverse_transform_pose(&world_from_camera)
            })
            // Not finite where the keyframe's unit is absurdly small.
            .filter(SE3::is_finite);
        let keyframe_from_camera = located.unwrap_or_else(SE3::identity);
        let placed = reference
            .map(|reference| reference.map_from_keyframe().transform_pose(&keyframe_from_camera))
            .filter(SE3::is_finite);
        let unknown = upper_triangle(|row, column| match row == column {
            true => UNKNOWN_VARIANCE,
            false => 0.0,
        });
        PoseEstimate {
            sequence: frame.sequence,
            capture_nanos: frame.capture_nanos,
            epoch: reference.map_or(0, Reference::epoch),
            revision: reference.map_or(0, Reference::revision),
            keyframe_id: reference.map_or(NO_KEYFRAME, Reference::keyframe_id),
            state,
            map_revision: reference.map_or(0, Reference::map_revision),
            world_from_camera,
            map_from_camera: placed.unwrap_or(world_from_camera),
            keyframe_from_camera,
            covariance: unknown,
            map_covariance: unknown,
            alignment_covariance: unknown,
            velocity: None,
            brightness: Brightness::default(),
            quality: Quality::default(),
            proposes_keyframe: false,
        }
    }
}

fn is_finite(quality: &Quality) -> bool {
    let Quality { whitened_rmse, residual_rmse, mean_squared_flow, displacement_px, .. } = quality;
    [whitened_rmse, residual_rmse, mean_squared_flow, displacement_px].iter().all(|x| x.is_finite())
}
