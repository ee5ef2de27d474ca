//! The recipe of a frame: predict, align to the keyframe coarse to fine, judge, report.

pub mod covariance_floor;
pub(crate) mod motion;
mod report;
mod turning;
pub(crate) mod velocity;
pub mod verdict;
mod whereabouts;

use serde::{Deserialize, Serialize};

use crate::slam::alignment::align::{
    Aligner, Alignment, AlignmentParams, Ending, next_finer_level,
};
use crate::slam::alignment::reference::{
    Reference, ReferenceParams, ReferenceScratch, finest_level, num_levels,
};
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::{MIN_CONTRAST, SumPyramid};
use crate::slam::keyframe::{DistanceWeights, MapState};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{Brightness, DegradedReason, LostReason, PoseEstimate, TrackingState};
use crate::slam::tracker::covariance_floor::CovarianceFloorParams;
use crate::slam::tracker::motion::{Motion, hypotheses, rotations_around};
use crate::slam::tracker::turning::{Turning, may_turn};
use crate::slam::tracker::velocity::VelocityMemory;
use crate::slam::tracker::verdict::{VerdictParams, fits_better, is_better, quality_of};
use crate::slam::tracker::whereabouts::Whereabouts;

/// Standard deviations by which a pose may differ from the held one: one of a hundred correct finds is refused.
pub const MAX_POSE_DEVIATIONS: f64 = 3.0;

/// Tuning of the tracker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackerParams {
    /// Selection of a keyframe's points.
    pub reference: ReferenceParams,
    /// Alignment of those points.
    pub alignment: AlignmentParams,
    /// Tracking status.
    pub verdict: VerdictParams,
    /// The part of the published covariance beyond noise and common errors of depth.
    pub covariance_floor: CovarianceFloorParams,
    /// The coarsest level fits badly, and other motions are tried, when its whitened RMSE exceeds the last good one by
    /// this factor. DSO gives a level up at 1.5.
    pub poor_fit_ratio: f64,
    /// Rotation about each axis of the other motions, degrees: half the convergence range of the coarsest level.
    pub hypothesis_rotation_deg: f64,
    /// Rotation about each axis of the views near the keyframe's own that a lost tracker tries, degrees: as far as a
    /// coarse alignment converges, so that the ranges of the views join.
    pub recovery_rotation_deg: f64,
    /// Standard deviation of the translation, in mean depths, up to which a pose is claimed while the known depth is
    /// out of view and the last view with a pose holds the camera; 0 claims none. Beyond it only the rotation is known.
    pub max_turning_deviation: f64,
    /// Standard deviation of the coarsest level, grey levels, below which a frame has no
    /// contrast: covered lens, overexposure, a white wall.
    pub min_contrast: f64,
    /// w_d of the keyframe distance: a keyframe is requested at 1/w_d of the mean depth.
    pub keyframe_distance_weight: f64,
    /// w_u of the keyframe distance: … or when 1/w_u of the points are out of view.
    pub keyframe_usage_weight: f64,
    /// … or when its images are brighter or darker by this factor: depth is matched against the keyframe's own grey
    /// values, which are coarse or saturated there (DSO18 §3.1).
    pub keyframe_brightness_ratio: f64,
}

impl Default for TrackerParams {
    fn default() -> Self {
        Self {
            reference: ReferenceParams::default(),
            alignment: AlignmentParams::default(),
            verdict: VerdictParams::default(),
            covariance_floor: CovarianceFloorParams::default(),
            poor_fit_ratio: 1.5,
            hypothesis_rotation_deg: 3.0,
            recovery_rotation_deg: 6.0,
            max_turning_deviation: 1.0,
            min_contrast: MIN_CONTRAST,
            keyframe_distance_weight: DistanceWeights::default().translation,
            keyframe_usage_weight: DistanceWeights::default().usage,
            keyframe_brightness_ratio: 1.6,
        }
    }
}

impl TrackerParams {
    /// The weights of the distance at which a keyframe is requested.
    pub fn keyframe_distance(&self) -> DistanceWeights {
        DistanceWeights {
            translation: self.keyframe_distance_weight,
            usage: self.keyframe_usage_weight,
        }
    }

    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        self.reference.validate().map_err(|error| error.within("reference"))?;
        self.alignment.validate().map_err(|error| error.within("alignment"))?;
        self.verdict.validate().map_err(|error| error.within("verdict"))?;
        self.covariance_floor.validate().map_err(|error| error.within("covariance_floor"))?;
        check_range("poor_fit_ratio", self.poor_fit_ratio, 1.0..=100.0)?;
        check_range("hypothesis_rotation_deg", self.hypothesis_rotation_deg, 0.0..=45.0)?;
        check_range("recovery_rotation_deg", self.recovery_rotation_deg, 0.0..=45.0)?;
        check_range("max_turning_deviation", self.max_turning_deviation, 0.0..=10.0)?;
        check_range("min_contrast", self.min_contrast, 0.0..=255.0)?;
        check_range("keyframe_distance_weight", self.keyframe_distance_weight, 0.0..=1e3)?;
        check_range("keyframe_usage_weight", self.keyframe_usage_weight, 0.0..=1e3)?;
        check_range("keyframe_brightness_ratio", self.keyframe_brightness_ratio, 1.01..=1e6)
    }
}

/// Tracks frames against the active reference.
#[derive(Debug)]
pub struct Tracker {
    params: TrackerParams,
    intrinsics: Intrinsics,
    aligner: Aligner,
    reference: Option<Box<Reference>>,
    pyramid: SumPyramid,
    memory: Memory,
    turning: Turning,
}

/// State of a tracker that carries over from frame to frame.
#[derive(Debug, Clone, Default)]
pub struct Memory {
    motion: Motion,
    velocity: VelocityMemory,
    brightness: Brightness,
    last_sequence: Option<u64>,
    /// Highest id of a keyframe so far: ids ascend over all epochs.
    newest_keyframe_id: u64,
    /// Whether the previous frame was not tracked on a keyframe.
    was_lost: bool,
    whereabouts: Whereabouts,
    /// Covariance of the last estimate.
    covariance: [f64; 21],
    /// Unit of its translations, in world units.
    unit: f64,
    coarse_fit: Option<f64>,
}

impl Tracker {
    /// A tracker for images of `intrinsics`, without a keyframe yet.
    pub fn new(intrinsics: Intrinsics, params: TrackerParams) -> Result<Self, ParameterError> {
        params.validate()?;
        let Intrinsics { width, height, .. } = intrinsics;
        let levels = num_levels(width, height);
        let finest = finest_level(levels, &params.reference);
        let pyramid = SumPyramid::with_size(width, height, levels, finest);
        Ok(Self {
            intrinsics,
            aligner: Aligner::new(params.alignment.clone()),
            reference: None,
            turning: Turning::new(
                Reference::new(params.reference.clone()),
                &intrinsics,
                &pyramid,
                &params.alignment,
            ),
            pyramid,
            memory: Memory::default(),
            params,
        })
    }

    /// Scratch memory for references that are prepared on the tracker's thread.
    pub fn scratch(&mut self) -> &mut ReferenceScratch {
        &mut self.turning.unknown.scratch
    }

    /// Makes a prepared reference the active one and returns the previous one, for its memory. The first one of a new
    /// epoch resets the camera's motion.
    pub fn adopt(&mut self, reference: Box<Reference>) -> Option<Box<Reference>> {
        /// Frames by which a mapper may lag with the first keyframe of an epoch: ten seconds at 30 Hz.
        const MAX_FRAMES_BEHIND: u64 = 300;
        let behind =
            self.memory.last_sequence.and_then(|last| last.checked_sub(reference.sequence()));
        let is_recent = behind.is_some_and(|behind| behind <= MAX_FRAMES_BEHIND);
        let before = self.reference.replace(reference);
        let (old, new) = (before.as_deref(), self.reference.as_deref());
        if let (Some(old), Some(new)) = (old, new) {
            if old.keyframe_id() == new.keyframe_id() {
                let (before, after) = (old.world_from_keyframe(), new.world_from_keyframe());
                self.memory.motion.follow(before, after);
                self.memory.velocity.follow(after.scale / before.scale);
                self.turning.follow(before, after);
            } else {
                self.memory.brightness = Brightness::default();
                self.memory.coarse_fit = None;
                self.memory.whereabouts = Whereabouts::FromNextFrame;
            }
            // A keyframe whose epoch was joined to another has a new epoch number but the same pose, and an epoch that
            // is resumed is placed where the odometry has the camera.
            let newest = self.memory.newest_keyframe_id.max(old.keyframe_id());
            self.memory.newest_keyframe_id = newest.max(new.keyframe_id());
            if old.epoch() < new.epoch() && new.keyframe_id() > newest {
                self.memory.motion = Motion::default();
                self.memory.velocity.forget();
                // On a keyframe that was not created just now, but belongs to a map that the mapper switched to, the
                // camera may be anywhere.
                self.memory.was_lost = !is_recent;
                self.memory.whereabouts = Whereabouts::on_first_keyframe(is_recent);
                self.turning.end();
            }
        } else if let Some(new) = new {
            let is_new = is_recent && !Self::is_found_on(new.keyframe_id());
            self.memory.whereabouts = Whereabouts::on_first_keyframe(is_new);
        }
        before
    }

    /// Continues from another tracker of this camera, which claimed this pose at `nanos`. The next frame is searched
    /// around it, and must fit as well as after a loss.
    pub fn resume_at(&mut self, nanos: i64, world_from_camera: &SE3) {
        self.memory.motion.observe(nanos, world_from_camera);
        self.memory.velocity.forget();
        self.memory.was_lost = true;
        self.memory.whereabouts = Whereabouts::known_at(nanos);
    }

    /// Starts on another tracker's map, without a pose of the camera: a pose must fit as well as after a loss, or any
    /// pose near the keyframe's own with which half of the points agree would be claimed.
    pub fn begin_lost(&mut self) {
        self.memory.was_lost = true;
    }

    /// Whether the camera was relocalised on a tracker's first keyframe: that of a new map has id 0 or 1.
    pub fn is_found_on(keyframe_id: u64) -> bool {
        keyframe_id > 1
    }

    /// The active reference.
    pub fn reference(&self) -> Option<&Reference> {
        self.reference.as_deref()
    }

    /// Forgets keyframe and motion.
    pub fn reset(&mut self) {
        self.reference = None;
        self.memory = Memory::default();
        self.turning.end();
    }

    /// Tracks one frame. `budget` is called before each iteration with the pyramid level it would run on and returns
    /// whether there is time for it (always true in lockstep and replay).
    pub fn track(
        &mut self,
        frame: &FrameView<'_>,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> PoseEstimate {
        self.prepare_next();
        let before = self.memory.clone();
        let missing = self.count_missing(frame.sequence);
        let Some(reference) = self.reference.take() else {
            return self.unclaimed(frame, None, TrackingState::Initializing);
        };
        self.memory.whereabouts.observe(frame.capture_nanos);
        let estimate = match self.refusal(&reference, frame) {
            Some(reason) => {
                self.turning.end();
                self.unclaimed(frame, Some(&reference), TrackingState::Lost(reason))
            }
            None => {
                let (alignment, coarse_fit) = self.align(&reference, frame, budget);
                let estimate = self.report(&reference, frame, &alignment, missing);
                // A bar set by a frame that was lost, or cut short, would let the next one pass.
                let is_lost = matches!(estimate.state, TrackingState::Lost(_));
                self.memory.coarse_fit = coarse_fit.filter(|_| !is_lost).or(self.memory.coarse_fit);
                let held = match may_turn(estimate.state) {
                    true => self.turn(&reference, frame, before, budget),
                    false => {
                        self.end_turning();
                        let may_be_next = self.params.max_turning_deviation > 0.0;
                        self.turning.look_ahead(&estimate, may_be_next);
                        None
                    }
                };
                held.unwrap_or(estimate)
            }
        };
        self.memory.was_lost = matches!(
            estimate.state,
            TrackingState::Lost(_) | TrackingState::Degraded(DegradedReason::Turning)
        );
        if self.memory.was_lost {
            self.memory.velocity.forget();
        }
        if estimate.state.is_tracked() {
            self.memory.whereabouts = Whereabouts::known_at(frame.capture_nanos);
        }
        self.memory.covariance = estimate.covariance;
        self.memory.unit = reference.world_from_keyframe().scale;
        self.reference = Some(reference);
        estimate
    }

    /// Prepares what the next frame may need and this pose need not wait for, some milliseconds where known depth is
    /// out of view or nearly: to be called once the pose is published. [`Self::track`] does it first otherwise.
    pub fn prepare_next(&mut self) {
        let Self { turning, intrinsics, pyramid, .. } = self;
        turning.prepare(intrinsics, pyramid);
    }

    /// The state carried over from the frames so far, for [`Self::rehearse`].
    pub fn memory(&self) -> &Memory {
        &self.memory
    }

    /// Result of [`Self::track`] for `frame` with `memory` and another budget. This tracker's own memory stays
    /// unchanged.
    pub fn rehearse(
        &mut self,
        memory: &Memory,
        frame: &FrameView<'_>,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> PoseEstimate {
        self.prepare_next();
        let own = std::mem::replace(&mut self.memory, memory.clone());
        let turning = self.turning.pause();
        let estimate = self.track(frame, budget);
        self.memory = own;
        self.turning.resume(turning, &mut self.pyramid);
        estimate
    }

    /// Number of frames missing between this one and the previous one.
    fn count_missing(&mut self, sequence: u64) -> u64 {
        let before = self.memory.last_sequence.replace(sequence);
        before.map_or(0, |before| sequence.saturating_sub(before).saturating_sub(1))
    }

    /// Why the frame cannot be aligned at all; fills the pyramid otherwise.
    fn refusal(&mut self, reference: &Reference, frame: &FrameView<'_>) -> Option<LostReason> {
        // A pose on it would move the last one, at which the mapper anchors the place where it finds the camera.
        if reference.map_state() == MapState::Rejected {
            self.memory.motion.stop();
            return Some(LostReason::MapRejected);
        }
        let Intrinsics { width, height, .. } = self.intrinsics;
        if !frame.is_consistent() || (frame.width, frame.height) != (width, height) {
            return Some(LostReason::UnusableFrame);
        }
        if *reference.intrinsics() != self.intrinsics {
            return Some(LostReason::NoPoints);
        }
        self.turning.keep(&mut self.pyramid, frame.sequence);
        self.pyramid.fill(frame.pixels);
        self.memory.motion.begin_frame(!self.turning.repeats.observe(&self.pyramid).is_new());
        let flat = self.pyramid.contrast() < self.params.min_contrast;
        flat.then_some(LostReason::UnusableFrame)
    }

    /// Aligns from the predicted pose, and from others where that fits badly. Also returns the whitened RMSE of the
    /// coarsest level, where there was time and a view to solve it.
    fn align(
        &mut self,
        reference: &Reference,
        frame: &FrameView<'_>,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> (Alignment, Option<f64>) {
        let nanos = frame.capture_nanos;
        // Before the first pose the camera is assumed to be where the keyframe was taken.
        let first = reference.world_from_keyframe().transform_pose(&SE3::identity());
        let predicted = self.memory.motion.predict(nanos, 1.0).unwrap_or(first);
        let mut best = self.align_coarsest(reference, &predicted, budget);
        if self.fits_poorly(&best) {
            let rotation = self.params.hypothesis_rotation_deg.to_radians();
            // A lost camera may be where the keyframe was taken: the mapper may have found it there.
            let views = self.params.recovery_rotation_deg.to_radians();
            let at_keyframe =
                self.memory.was_lost.then(|| rotations_around(&first, views)).into_iter().flatten();
            let explain =
                |of: &Alignment| self.aligner.sums_with_exact_depth(reference, &self.pyramid, of);
            let mut explained = explain(&best);
            // A small gain explains any image, and would hide the pose that may be claimed.
            let may_be = |of: &Alignment| !self.memory.was_lost || self.params.verdict.is_near(of);
            // A view of little contrast has inliers anywhere.
            let is_view = reference.translation_information() > 0.0;
            let is_better = if is_view { fits_better } else { is_better };
            for hypothesis in hypotheses(&self.memory.motion, nanos, rotation).chain(at_keyframe) {
                let other = self.align_coarsest(reference, &hypothesis, budget);
                let by_other = explain(&other);
                if may_be(&other) && (!may_be(&best) || is_better(&by_other, &explained)) {
                    (best, explained) = (other, by_other);
                }
            }
        }
        let is_solved = best.ending == Ending::Finished;
        let coarse_fit = is_solved.then(|| quality_of(&best).whitened_rmse);
        if is_solved && !self.memory.was_lost {
            best = self.better_on_next(reference, best, &predicted, budget);
        }
        self.aligner.descend(reference, &self.pyramid, &mut best, budget);
        if best.ending == Ending::OutOfBudget {
            best = self.better_when_cut_short(reference, &best, &predicted);
        }
        (best, coarse_fit)
    }

    /// Of an alignment on the coarsest level and the prediction it started from, the one that explains the next level
    /// better when both are solved there: the few pixels of the coarsest may fit best elsewhere, and the finer levels
    /// do not return from a wrong minimum.
    fn better_on_next(
        &self,
        reference: &Reference,
        mut coarsest: Alignment,
        predicted: &SE3,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> Alignment {
        let (aligner, frame) = (&self.aligner, &self.pyramid);
        let Some(level) = next_finer_level(reference, frame, coarsest.level) else {
            return coarsest;
        };
        let mut direct = coarsest.clone();
        if !aligner.solve_level(reference, frame, level, &mut coarsest, budget) {
            return coarsest;
        }
        // A level takes only pose and brightness from its start.
        direct.state.current_from_keyframe =
            reference.world_from_keyframe().inverse_transform_pose(predicted).inverse();
        direct.state.brightness = self.memory.brightness;
        direct.ending = Ending::NothingInView;
        aligner.solve_level(reference, frame, level, &mut direct, budget);
        let explain = |of: &Alignment| aligner.sums_with_exact_depth(reference, frame, of);
        let is_solved = direct.ending == Ending::Finished;
        match is_solved && fits_better(&explain(&direct), &explain(&coarsest)) {
            true => direct,
            false => coarsest,
        }
    }

    /// Of an alignment that was cut short and the prediction it started from, the one that explains the finest level
    /// better, and one step from there: a coarse level alone is often worse than constant motion.
    fn better_when_cut_short(
        &self,
        reference: &Reference,
        cut_short: &Alignment,
        predicted: &SE3,
    ) -> Alignment {
        let guess = reference.world_from_keyframe().inverse_transform_pose(predicted).inverse();
        let reached = &cut_short.state.current_from_keyframe;
        let brightnesses = [cut_short.state.brightness, self.memory.brightness];
        let [reached, guessed] =
            [(reached, brightnesses[0]), (&guess, brightnesses[1])].map(|(pose, brightness)| {
                let (aligner, frame) = (&self.aligner, &self.pyramid);
                aligner.evaluate_on_finest(reference, frame, cut_short, pose, brightness)
            });
        let explain =
            |of: &Alignment| self.aligner.sums_with_exact_depth(reference, &self.pyramid, of);
        let better = |one: Alignment, other: Alignment| {
            if fits_better(&explain(&one), &explain(&other)) { one } else { other }
        };
        let best = better(guessed, reached);
        // The sums are available: the step costs one evaluation.
        let Some((pose, brightness)) = best.state.after_step() else { return best };
        let (aligner, frame) = (&self.aligner, &self.pyramid);
        better(aligner.evaluate_on_finest(reference, frame, cut_short, &pose, brightness), best)
    }

    /// Solves the coarsest level that has points, from one pose in the world.
    fn align_coarsest(
        &self,
        reference: &Reference,
        world_from_camera: &SE3,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> Alignment {
        let start =
            reference.world_from_keyframe().inverse_transform_pose(world_from_camera).inverse();
        let (aligner, pyramid) = (&self.aligner, &self.pyramid);
        let mut alignment = aligner.start(reference, pyramid, &start, self.memory.brightness);
        let level = alignment.level;
        aligner.solve_level(reference, pyramid, level, &mut alignment, budget);
        alignment
    }

    /// Whether the coarsest level shows that the prediction was wrong.
    fn fits_poorly(&self, alignment: &Alignment) -> bool {
        let quality = quality_of(alignment);
        let bound =
            self.memory.coarse_fit.map_or(f64::INFINITY, |fit| fit * self.params.poor_fit_ratio);
        self.memory.was_lost
            || quality.whitened_rmse > bound
            || quality.inlier_ratio < self.params.verdict.lost_inliers
            || quality.in_view_ratio < self.params.verdict.degraded_in_view
    }
}

#[cfg(test)]
mod arbitrary_input_tests;
#[cfg(test)]
mod astray_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod velocity_tests;
