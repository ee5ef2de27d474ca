//! Holds the pose while the known depth is out of view: frames are aligned to the last view that had a pose, all of
//! whose pixels are used with an unknown depth.
//!
//! That holds the rotation. The position stays where it was when the known depth was last seen, with an uncertainty
//! that grows at a hand's speed; each new view adds its uncertainty, and no depth is estimated meanwhile. It ends where
//! a keyframe fits again, or where the position is too uncertain.

use nalgebra::{Matrix3, Matrix6};

use crate::slam::alignment::align::{Aligner, Alignment, AlignmentParams, Ending};
use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::unknown_depth::UnknownDepth;
use crate::slam::depth::common_error::rotation_std_dev;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::repeats::Repeats;
use crate::slam::image::sums::SumPyramid;
use crate::slam::pose::{
    Brightness, DegradedReason, LostReason, PoseEstimate, Quality, TrackingState, full_covariance,
    upper_triangle,
};
use crate::slam::tracker::covariance_floor::displacement_covariance;
use crate::slam::tracker::verdict::quality_of;
use crate::slam::tracker::{MAX_POSE_DEVIATIONS, Memory, Tracker};

/// Change of the exposure since the view: of the logarithm of the gain, and of the offset in grey levels. Only a few
/// frames pass; more freedom flattens a view of little contrast until it fits anything.
const GAIN_STD_DEV: f64 = 0.05;
const OFFSET_STD_DEV: f64 = 5.0;

/// Least number of points of the view that a frame must show, at the finest level.
const MIN_POINTS: u32 = 500;

/// Largest standard deviation of the rotation from the view, radians: 3°, as far as the next alignment converges.
const MAX_ROTATION_STD_DEV: f64 = 0.05;

/// Largest logarithm of the gain, either way, with which a frame is held: a blurred frame has that much less contrast
/// than a sharp one.
const MAX_LOG_GAIN: f64 = 0.7;

/// Largest change of the rotation from one frame to the next, radians, once it is held: 9° at 30 Hz are an angular
/// acceleration that hands do not reach.
const MAX_CHANGE_RAD: f64 = 0.15;

/// Least share of the points compared that the rotation must explain by image noise alone.
const MIN_INLIERS: f64 = 0.8;

/// Speed of a hand-held camera, mean depths per second: a standard deviation. Frames are expected at that distance from
/// the view; the images of a rotating camera hardly distinguish a translation from a rotation.
const SPEED: f64 = 0.3;
/// Factor on that in the alignment's prior: a free translation absorbs whatever is not modelled, and with the variance
/// that comes with it explains any image.
const TIGHTNESS: f64 = 0.5;
/// Bounds of the time since the view to which this applies: that of the fastest camera, and the longest after which the
/// camera may be anywhere. Beyond it no view is kept either.
const MIN_SECONDS: f64 = 0.001;
const MAX_SECONDS: f64 = 1.0;

/// Largest displacement of a frame that was cut short, pixels of the finest level: beyond that fewer of its points
/// would be explained by noise.
const CUT_SHORT_PX: f64 = 1.0;

/// How long a view may hold the camera although it has not rotated away from the keyframe, seconds: as long as the blur
/// of a jerk lasts. If it stays hidden for longer this is not a rotation, and the mapper starts to count the loss.
const MAX_IN_VIEW_SECS: f64 = 0.5;

/// Share of the keyframe's points in view below which the view is prepared ahead: a camera that pans at 90°/s loses a
/// twentieth of its image per frame, and from a third to a tenth on there is too little depth.
const AHEAD_IN_VIEW: f64 = 0.5;

/// The view that frames are aligned to, and the previous frame.
#[derive(Debug)]
pub(super) struct Turning {
    pub(super) unknown: UnknownDepth,
    /// Has a prior of about the same exposure.
    aligner: Aligner,
    /// Taken out while a frame is aligned to it.
    view: Option<Box<Reference>>,
    place: Option<ViewPose>,
    /// Whether no frame has been held to it yet: the motion is that from the keyframe's last points.
    is_first: bool,
    /// Fit of the last held frame on the coarsest level.
    coarse_fit: Option<f64>,
    /// The previous frame.
    before: SumPyramid,
    /// Paused while a frame is rehearsed.
    pub(super) repeats: Repeats,
    /// Which frame is in which buffer.
    frames: Frames,
    /// Whether the frame in the tracker's pyramid is to be the view.
    is_due: bool,
}

/// Sequences of the stored frames: in the tracker's pyramid, before it, and in the view.
#[derive(Debug, Clone, Copy, Default)]
struct Frames {
    filled: Option<u64>,
    before: Option<u64>,
    view: Option<u64>,
}

/// State that is saved while a frame is rehearsed.
pub(super) struct SavedView {
    place: Option<ViewPose>,
    frames: Frames,
}

/// Pose of the view.
#[derive(Debug, Clone, Copy)]
pub(super) struct ViewPose {
    /// In units of the mean depth.
    world_from_view: Sim3,
    /// Time from the last frame tracked on the keyframe to the view, seconds.
    since_secs: f64,
    /// For how long the keyframe's points would have been in view since, seconds.
    in_view_secs: f64,
    /// Stamp of the view.
    nanos: i64,
    /// Possible speed of the camera, mean depths per second.
    speed: f64,
    /// Covariance of the left increment of `view_from_keyframe`, in the same units.
    covariance: Matrix6<f64>,
}

impl ViewPose {
    /// Variance of the camera's distance from here at `since_secs`. It moves evenly: the distance grows with the time,
    /// not with its square root.
    fn distance_variance(&self, since_secs: f64) -> f64 {
        self.speed.powi(2) * (since_secs.powi(2) - self.since_secs.powi(2))
    }
}

impl Turning {
    /// With memory for frames like `pyramid`, of a camera with these intrinsics.
    pub(super) fn new(
        mut view: Reference,
        intrinsics: &Intrinsics,
        pyramid: &SumPyramid,
        params: &AlignmentParams,
    ) -> Self {
        let mut unknown = UnknownDepth::default();
        // A view with a gradient everywhere: no frame needs more memory.
        let pixels = intrinsics.width * intrinsics.height;
        let steep: Vec<u8> = (0..pixels).map(|place| (place * 37 % 256) as u8).collect();
        let mut textured = pyramid.clone();
        textured.fill(&steep);
        unknown.prepare(&mut view, intrinsics, &mut textured);
        let params = AlignmentParams {
            gain_prior_std_dev: GAIN_STD_DEV,
            offset_prior_std_dev: OFFSET_STD_DEV,
            ..params.clone()
        };
        Self {
            unknown,
            aligner: Aligner::new(params),
            view: Some(Box::new(view)),
            place: None,
            is_first: true,
            coarse_fit: None,
            before: pyramid.clone(),
            repeats: Repeats::with_size_of(pyramid),
            frames: Frames::default(),
            is_due: false,
        }
    }

    /// Keeps the frame in `pyramid`, which is about to be overwritten.
    pub(super) fn keep(&mut self, pyramid: &mut SumPyramid, sequence: u64) {
        std::mem::swap(&mut self.before, pyramid);
        self.frames.before = self.frames.filled.replace(sequence);
    }

    /// Makes the frame in `pyramid` the view, if that is due; the contents of the old view are left in its place.
    pub(super) fn prepare(&mut self, intrinsics: &Intrinsics, pyramid: &mut SumPyramid) {
        if !std::mem::take(&mut self.is_due) {
            return;
        }
        let Some(view) = self.view.as_deref_mut() else { return };
        self.unknown.prepare(view, intrinsics, pyramid);
        self.frames.view = self.frames.filled.take();
    }

    /// After a frame with a pose on a keyframe: schedules the view where the next frame may leave the known depth.
    pub(super) fn look_ahead(&mut self, estimate: &PoseEstimate, may_be_next: bool) {
        let is_at_edge = estimate.quality.in_view_ratio < AHEAD_IN_VIEW;
        self.is_due = may_be_next && estimate.state.is_tracked() && is_at_edge;
    }

    /// Saves the state before a frame is rehearsed: nothing is held meanwhile.
    pub(super) fn pause(&mut self) -> SavedView {
        self.repeats.is_paused = true;
        SavedView { place: self.place.take(), frames: std::mem::take(&mut self.frames) }
    }

    /// Restores the state afterwards: `pyramid` was filled once more.
    pub(super) fn resume(&mut self, paused: SavedView, pyramid: &mut SumPyramid) {
        std::mem::swap(&mut self.before, pyramid);
        (self.place, self.frames) = (paused.place, paused.frames);
        (self.is_due, self.repeats.is_paused) = (false, false);
    }

    /// Makes the frame of `estimate` the next view.
    fn set_view(&mut self, estimate: &PoseEstimate, place: ViewPose) {
        self.is_first = false;
        // Consecutive frames are blurred alike, and show nearly the same.
        self.is_due = true;
        let world_from_view = Sim3::new(estimate.world_from_camera, place.world_from_view.scale);
        self.place = Some(ViewPose { world_from_view, nanos: estimate.capture_nanos, ..place });
    }

    /// Ends the hold as the keyframe fits again, or nothing does; returns whether a view was held.
    pub(super) fn end(&mut self) -> bool {
        self.is_due = false;
        self.place.take().is_some()
    }

    /// Moves the view with the keyframe that poses are relative to.
    pub(super) fn follow(&mut self, before: &Sim3, after: &Sim3) {
        if let Some(place) = self.place.as_mut().filter(|_| before != after) {
            place.world_from_view = *after * before.inverse() * place.world_from_view;
        }
    }
}

impl Tracker {
    /// Holds a frame that was lost on `reference` to the previous view. `before` is the memory before this frame.
    pub(super) fn turn(
        &mut self,
        reference: &Reference,
        frame: &FrameView<'_>,
        mut before: Memory,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> Option<PoseEstimate> {
        before.motion.begin_frame(!self.turning.repeats.shown().is_new());
        if self.turning.place.is_none() {
            self.begin_turning(&before, reference.mean_depth_in_world());
        }
        let place = self.turning.place?;
        let since_view = frame.capture_nanos.saturating_sub(place.nanos) as f64 * 1e-9;
        if since_view > MAX_SECONDS {
            self.end_turning();
            return None;
        }
        let mut view = self.turning.view.take()?;
        let lost = self.restore_memory(&before);
        let step = since_view.max(MIN_SECONDS);
        view.place_view(&place.world_from_view, TIGHTNESS * place.speed * step);
        let mut next = ViewPose { since_secs: place.since_secs + step, ..place };
        let distance_variance = place.distance_variance(next.since_secs);
        std::mem::swap(&mut self.aligner, &mut self.turning.aligner);
        let (alignment, coarse_fit) = self.align(&view, frame, budget);
        std::mem::swap(&mut self.aligner, &mut self.turning.aligner);
        let estimate =
            self.estimate_on_view(reference, &view, frame, &alignment, &next, distance_variance);
        self.turning.view = Some(view);
        let estimate = estimate.filter(|(estimate, _)| {
            let is_seen = self.would_see(reference, estimate);
            next.in_view_secs = if is_seen { place.in_view_secs + step } else { 0.0 };
            next.in_view_secs <= MAX_IN_VIEW_SECS
        });
        let is_cut_short = alignment.ending == Ending::OutOfBudget;
        let Some((estimate, covariance)) = estimate else {
            self.memory = lost;
            if is_cut_short && since_view >= 0.0 {
                // This frame tells nothing: the view waits for the next one, of which the same motion is expected.
                self.memory.motion = before.motion;
            } else {
                self.end_turning();
            }
            return None;
        };
        self.memory.motion.observe(frame.capture_nanos, &estimate.world_from_camera);
        self.memory.brightness = Brightness::default();
        self.memory.coarse_fit = before.coarse_fit;
        // A frame that was cut short does not become the view: its error would persist.
        if !is_cut_short {
            self.turning.coarse_fit = coarse_fit;
            self.turning.set_view(&estimate, ViewPose { covariance, ..next });
        }
        Some(estimate)
    }

    /// Restores the memory before the loss, as needed for the frame on the view; returns that after the loss.
    fn restore_memory(&mut self, before: &Memory) -> Memory {
        let held = Memory {
            last_sequence: self.memory.last_sequence,
            brightness: Brightness::default(),
            coarse_fit: self.turning.coarse_fit,
            // The motion from the keyframe's last points may be anything.
            was_lost: self.turning.is_first,
            ..before.clone()
        };
        std::mem::replace(&mut self.memory, held)
    }

    /// Whether a keyframe's points would be in view from the held pose: then the camera has not rotated away from them,
    /// and something else hides them.
    fn would_see(&self, reference: &Reference, held: &PoseEstimate) -> bool {
        let (aligner, pyramid) = (&self.aligner, &self.pyramid);
        let at = held.keyframe_from_camera.inverse();
        let seen = quality_of(&aligner.start(reference, pyramid, &at, Brightness::default()));
        seen.in_view_ratio >= self.params.verdict.degraded_in_view
    }

    /// Whether a pose found at `nanos` is rotated against the held one by more than the uncertainty and the camera's
    /// rotation meanwhile: it resembles the keyframe's view, but is elsewhere.
    pub(super) fn contradicts_hold(&self, nanos: i64, world_from_camera: &SE3) -> bool {
        /// A frame at 30 Hz, seconds.
        const INTERVAL: f64 = 1.0 / 30.0;
        let (Some(place), Some(predicted)) =
            (&self.turning.place, self.memory.motion.predict(nanos, 1.0))
        else {
            return false;
        };
        let intervals = nanos.saturating_sub(place.nanos) as f64 * 1e-9 / INTERVAL;
        let uncertain = rotation_std_dev(&place.covariance);
        predicted.rotation.angle_to(&world_from_camera.rotation)
            > MAX_CHANGE_RAD * intervals.max(1.0) + MAX_POSE_DEVIATIONS * uncertain
    }

    /// Ends the hold of a view.
    pub(super) fn end_turning(&mut self) {
        if self.turning.end() {
            // The jump from the held pose to the actual one in one frame is no motion of a camera.
            self.memory.motion.stop();
        }
    }

    /// Makes the previous frame the view, if it had a pose.
    fn begin_turning(&mut self, before: &Memory, unit: f64) {
        let Self { turning, intrinsics, .. } = self;
        let Some(last) = before.last_sequence.filter(|_| !before.was_lost) else { return };
        let is_ahead = turning.frames.view == Some(last);
        if !(is_ahead || turning.frames.before == Some(last)) {
            return;
        }
        let (Some((nanos, world_from_camera)), Some(view)) =
            (before.motion.last_seen(), turning.view.as_deref_mut())
        else {
            return;
        };
        if !is_ahead {
            turning.unknown.prepare(view, intrinsics, &mut turning.before);
            (turning.frames.view, turning.frames.before) = (Some(last), None);
        }
        let mut covariance = full_covariance(&before.covariance);
        scale_translation(&mut covariance, before.unit / unit);
        // No slower than it was.
        let speed = before.motion.speed().map_or(SPEED, |speed| SPEED.max(speed / unit));
        let world_from_view = Sim3::new(world_from_camera, unit);
        (turning.is_first, turning.coarse_fit) = (true, None);
        turning.place = Some(ViewPose {
            world_from_view,
            since_secs: 0.0,
            in_view_secs: 0.0,
            nanos,
            speed,
            covariance,
        });
    }

    /// The estimate of a frame aligned to the view, and the covariance in units of the mean depth; `None` where it does
    /// not fit as well as after a loss, or its translation is too uncertain.
    fn estimate_on_view(
        &self,
        reference: &Reference,
        view: &Reference,
        frame: &FrameView<'_>,
        alignment: &Alignment,
        place: &ViewPose,
        distance_variance: f64,
    ) -> Option<(PoseEstimate, Matrix6<f64>)> {
        let quality = self.quality_on_view(view, alignment);
        let predicted = self.memory.motion.predict(frame.capture_nanos, 1.0)?;
        let expected = place.world_from_view.inverse_transform_pose(&predicted).inverse();
        if !self.fits_view(view, alignment, &quality, &expected) {
            return None;
        }
        // Rotation and translation look alike over a step: summed up, translations would drift by a scene in seconds.
        let rotation = alignment.state.current_from_keyframe.rotation;
        let current_from_view = SE3 { rotation, ..SE3::identity() };
        let of_step =
            self.step_covariance(view, alignment, quality.displacement_px, distance_variance)?;
        let adjoint = current_from_view.adjoint();
        let covariance = of_step + adjoint * place.covariance * adjoint.transpose();
        let translation: Matrix3<f64> = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let deviation = translation.symmetric_eigenvalues().max().sqrt();
        // This comparison also rejects NaN.
        if !(deviation <= self.params.max_turning_deviation) {
            return None;
        }
        let world_from_camera = place.world_from_view.transform_pose(&current_from_view.inverse());
        let keyframe_from_camera =
            reference.world_from_keyframe().inverse_transform_pose(&world_from_camera);
        let map_from_camera = reference.map_from_keyframe().transform_pose(&keyframe_from_camera);
        if !(world_from_camera.is_finite() && map_from_camera.is_finite()) {
            return None;
        }
        let unit = reference.world_from_keyframe().scale;
        let mut published = covariance;
        scale_translation(&mut published, place.world_from_view.scale / unit);
        let in_map = reference.uncertain_pose().of_camera(&keyframe_from_camera, &published);
        let state = TrackingState::Degraded(DegradedReason::Turning);
        let published = upper_triangle(|row, column| published[(row, column)]);
        let estimate = PoseEstimate {
            world_from_camera,
            map_from_camera,
            keyframe_from_camera,
            covariance: published,
            map_covariance: upper_triangle(|row, column| in_map[(row, column)]),
            alignment_covariance: published,
            quality,
            ..self.unclaimed(frame, Some(reference), state)
        };
        Some((estimate, covariance))
    }

    /// Quality of an alignment to the view, including the possible error of one that was cut short.
    fn quality_on_view(&self, view: &Reference, alignment: &Alignment) -> Quality {
        let mut quality = self.quality(alignment);
        if alignment.ending == Ending::OutOfBudget {
            let unsolved_px = CUT_SHORT_PX * f64::from(1u32 << view.finest_level());
            quality.displacement_px = quality.displacement_px.hypot(unsolved_px);
        }
        quality
    }

    /// Whether a frame fits the view as well as after a loss, and its rotation is about as `expected`.
    fn fits_view(
        &self,
        view: &Reference,
        alignment: &Alignment,
        quality: &Quality,
        expected: &SE3,
    ) -> bool {
        let fits = self.params.verdict.judge(alignment, quality, false, 0);
        let is_seen = quality.points >= MIN_POINTS
            && matches!(
                fits,
                TrackingState::Tracking
                    | TrackingState::Degraded(DegradedReason::LowOverlap | DegradedReason::Budget)
            );
        // By image noise alone: parallax that the uncertain depth would explain is not a rotation.
        let explained = self.aligner.sums_with_exact_depth(view, &self.pyramid, alignment);
        let inliers = f64::from(explained.inliers) / f64::from(explained.compared.max(1));
        let is_even = alignment.state.brightness.a.abs() <= MAX_LOG_GAIN;
        let change = expected.rotation.angle_to(&alignment.state.current_from_keyframe.rotation);
        let is_smooth = self.turning.is_first || change <= MAX_CHANGE_RAD;
        is_smooth && is_seen && inliers >= MIN_INLIERS && is_even
    }

    /// Covariance of the step from the view, units of the mean depth: of the rotation as measured, of the translation
    /// as far as a hand moves; `None` where the rotation is too uncertain.
    fn step_covariance(
        &self,
        view: &Reference,
        alignment: &Alignment,
        displacement_px: f64,
        distance_variance: f64,
    ) -> Option<Matrix6<f64>> {
        let mut of_step = alignment.covariance(&self.params.alignment)?
            + from_prior(alignment, view.translation_information(), distance_variance)?
            + alignment.covariance_from_modes(view).unwrap_or_default()
            + displacement_covariance(displacement_px, &self.intrinsics, 1.0);
        of_step.fixed_view_mut::<3, 6>(0, 0).fill(0.0);
        of_step.fixed_view_mut::<6, 3>(0, 0).fill(0.0);
        (0..3).for_each(|axis| of_step[(axis, axis)] = distance_variance);
        // This comparison also rejects NaN.
        (rotation_std_dev(&of_step) <= MAX_ROTATION_STD_DEV).then_some(of_step)
    }
}

/// Part of a pose's covariance that is due to the camera's true motion while the prior held it at the view: M⁻¹ Λ Σ Λ
/// M⁻¹, Λ the information of the prior.
fn from_prior(alignment: &Alignment, information: f64, variance: f64) -> Option<Matrix6<f64>> {
    let inverse = alignment.state.sums.information.cholesky()?.inverse();
    let moved = inverse.fixed_view::<6, 3>(0, 0).into_owned() * information;
    Some(moved * moved.transpose() * variance)
}

/// Whether a frame that was lost for this reason may be held to the previous view.
pub(super) fn may_turn(state: TrackingState) -> bool {
    use LostReason::{Diverged, NoPoints, TooFewInliers};
    matches!(state, TrackingState::Lost(Diverged | TooFewInliers | NoPoints))
}

/// Multiplies the translations by `factor`.
fn scale_translation(covariance: &mut Matrix6<f64>, factor: f64) {
    for k in 0..3 {
        covariance.row_mut(k).scale_mut(factor);
        covariance.column_mut(k).scale_mut(factor);
    }
}

#[cfg(test)]
#[path = "turning_tests.rs"]
mod tests;
