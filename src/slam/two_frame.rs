//! The first depth of a map from two frames: pose, brightness and the depths of the first frame's points are estimated
//! jointly, frame after frame, until parallax is proven (after the idea of Engel, Koltun, Cremers 2018 §3.1).
//!
//! A camera that stands still or only rotates never starts, however noisy its images: see [`evidence`].

mod covariance;
pub(crate) mod earlier_frames;
pub(crate) mod elimination;
pub mod evidence;
pub mod fit;
pub(crate) mod hypothesis;
pub(crate) mod lanes;
mod lead;
mod outcome;
pub(crate) mod points;
mod sampling_kernel;
pub(crate) mod spread;
pub(crate) mod state;
pub(crate) mod system;
mod system_kernel;
mod waypoint;

pub use outcome::{Failure, InitOutcome, InitState, InitialDepth};

use nalgebra::{Matrix6, Vector3};
use serde::{Deserialize, Serialize};

use crate::slam::depth::candidate::CandidateParams;
use crate::slam::depth::gradient_image::GradientImage;
use crate::slam::depth::map::DepthMap;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::image::pyramid::Pyramid;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::Brightness;
use crate::slam::two_frame::covariance::{common_error, depth_variances, pose_covariance};
use crate::slam::two_frame::earlier_frames::EarlierFrames;
use crate::slam::two_frame::evidence::{
    Evidence, EvidenceParams, Waiting, judge, residual_variance,
};
use crate::slam::two_frame::fit::{FitInput, FitParams, FitScratch, Freedom, fit_level};
use crate::slam::two_frame::hypothesis::Hypotheses;
use crate::slam::two_frame::lead::Lead;
use crate::slam::two_frame::points::{Points, num_levels};
use crate::slam::two_frame::spread::spread;
use crate::slam::two_frame::state::State;
use crate::slam::two_frame::waypoint::Waypoint;

/// Tuning of the two-frame start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TwoFrameParams {
    /// Selection of the points of the first frame.
    pub candidates: CandidateParams,
    /// Tuning of the fit.
    pub fit: FitParams,
    /// Thresholds of the proof.
    pub evidence: EvidenceParams,
    /// Least number of points for a start.
    pub min_points: usize,
    /// Consecutive frames that must prove the parallax and agree on the direction: a single one may be chance.
    pub confirming_frames: u32,
    /// Frames after which an unproven start is restarted on a new first frame: 2 s at 30 Hz.
    pub max_frames: u32,
    /// Consecutive frames that may fail to match before it is restarted.
    pub max_mismatches: u32,
    /// Earlier frames kept for choosing between motions: about 1 MB each at 640×480.
    pub max_earlier_frames: usize,
    /// Standard deviation of a match due to interpolation and sampling, pixels.
    pub match_noise_px: f32,
}

impl Default for TwoFrameParams {
    fn default() -> Self {
        Self {
            candidates: CandidateParams { wanted: 1500 },
            fit: FitParams::default(),
            evidence: EvidenceParams::default(),
            min_points: 200,
            confirming_frames: 2,
            max_frames: 60,
            max_mismatches: 3,
            max_earlier_frames: 8,
            match_noise_px: 0.15,
        }
    }
}

impl TwoFrameParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        self.candidates.validate().map_err(|e| e.within("candidates"))?;
        self.fit.validate().map_err(|e| e.within("fit"))?;
        self.evidence.validate().map_err(|e| e.within("evidence"))?;
        check_range("min_points", self.min_points, 20..=100_000)?;
        check_range("confirming_frames", self.confirming_frames, 1..=100)?;
        check_range("max_frames", self.max_frames, 2..=100_000)?;
        check_range("max_mismatches", self.max_mismatches, 1..=1000)?;
        check_range("max_earlier_frames", self.max_earlier_frames, 1..=100)?;
        check_range("match_noise_px", self.match_noise_px, 0.0..=5.0)
    }
}

/// Finds the first depth. Reuses its memory; the same frames give the same result.
#[derive(Debug)]
pub struct TwoFrameInitializer {
    params: TwoFrameParams,
    intrinsics: Vec<Intrinsics>,
    pyramid: Pyramid,
    gradients: GradientImage,
    first_pixels: Vec<u8>,
    points: Points,
    joint: Hypotheses,
    earlier_frames: EarlierFrames,
    rotation: State,
    rotation_scratch: FitScratch,
    /// The latest result: pose, brightness, inverse depth of each point and its variance.
    current_from_first: SE3,
    pose_covariance: Matrix6<f64>,
    brightness: Brightness,
    inverse_depths: Vec<f32>,
    variances: Vec<f32>,
    sorted: Vec<f32>,
    /// Significance of the parallax in the latest frame.
    significance: f64,
    /// Least median residual of a frame since the first, grey levels.
    least_residual: f64,
    /// Direction from the first camera to the previous one, in the first frame; after a restart on another frame,
    /// initially the direction in which the camera arrived there.
    heading: Vector3<f64>,
    lead: Lead,
    /// The previous frame, where the next one may need it.
    waypoint: Option<Waypoint>,
    frames: u32,
    confirmed: u32,
    mismatches: u32,
}

/// Shortest side of an image that a map can start on, pixels.
pub const MIN_SIDE_PX: usize = 32;

impl TwoFrameInitializer {
    /// An initialiser for images of `intrinsics`, without a first frame.
    pub fn new(intrinsics: Intrinsics, params: TwoFrameParams) -> Result<Self, ParameterError> {
        params.validate()?;
        check_range("image width", intrinsics.width, MIN_SIDE_PX..=8192)?;
        check_range("image height", intrinsics.height, MIN_SIDE_PX..=8192)?;
        let num_levels = num_levels(&intrinsics);
        let intrinsics: Vec<_> = (0..num_levels).map(|l| intrinsics.at_level(l)).collect();
        let state = State::at_rest(0);
        Ok(Self {
            pyramid: Pyramid::with_size(intrinsics[0].width, intrinsics[0].height, num_levels),
            gradients: GradientImage::with_size(intrinsics[0].width, intrinsics[0].height),
            params,
            intrinsics,
            first_pixels: Vec::new(),
            points: Points::default(),
            joint: Hypotheses::new(&state),
            earlier_frames: EarlierFrames::default(),
            rotation: state,
            rotation_scratch: FitScratch::default(),
            current_from_first: SE3::identity(),
            pose_covariance: Matrix6::zeros(),
            brightness: Brightness::default(),
            inverse_depths: Vec::new(),
            variances: Vec::new(),
            significance: 0.0,
            least_residual: f64::INFINITY,
            sorted: Vec::new(),
            heading: Vector3::zeros(),
            lead: Lead::default(),
            waypoint: None,
            frames: 0,
            confirmed: 0,
            mismatches: 0,
        })
    }

    /// Starts on a first frame; `false` where it has the wrong size or too little texture.
    pub fn begin(&mut self, pixels: &[u8]) -> bool {
        self.first_pixels.clear();
        if pixels.len() != self.intrinsics[0].width * self.intrinsics[0].height {
            return false;
        }
        self.pyramid.fill(pixels);
        self.gradients.fill(pixels);
        let found = self.points.choose(&self.gradients, &self.pyramid, &self.params.candidates);
        if found < self.params.min_points {
            return false;
        }
        self.first_pixels.extend_from_slice(pixels);
        self.rotation = State::at_rest(found);
        self.joint.restart();
        self.earlier_frames.clear();
        self.current_from_first = SE3::identity();
        self.brightness = Brightness::default();
        self.inverse_depths.clear();
        self.variances.clear();
        self.significance = 0.0;
        self.least_residual = f64::INFINITY;
        self.lead = Lead::default();
        self.waypoint = None;
        (self.frames, self.confirmed, self.mismatches) = (0, 0, 0);
        true
    }

    /// Takes the next frame: fits, judges, and restarts where it must.
    pub fn step(&mut self, pixels: &[u8]) -> InitOutcome {
        if pixels.len() != self.intrinsics[0].width * self.intrinsics[0].height {
            return self.outcome(InitState::Failed(Failure::WrongSize), Evidence::default());
        }
        if self.first_pixels.is_empty() {
            let missing = if self.begin(pixels) { Waiting::Translation } else { Waiting::Texture };
            return self.outcome(InitState::Waiting(missing), Evidence::default());
        }
        let waypoint = self.waypoint.take();
        let mut outcome = self.follow(pixels);
        if let Some(waypoint) = waypoint
            && self.confirmed == 0
            && waypoint.is_needed(&outcome, &self.params.evidence)
        {
            outcome = match self.begin_on(&waypoint) {
                true => self.follow(pixels),
                false => self.outcome(InitState::Failed(Failure::Mismatch), outcome.evidence),
            };
        }
        if matches!(outcome.state, InitState::Failed(_)) {
            self.begin(pixels);
            outcome.frames = 0;
        }
        outcome
    }

    /// Fits a frame against the first one and judges the result.
    fn follow(&mut self, pixels: &[u8]) -> InitOutcome {
        self.pyramid.fill(pixels);
        self.frames += 1;
        self.fit_rotation();
        self.fit_jointly();
        if self.needs_slopes() {
            self.free_slopes();
            self.fit_rotation();
            self.fit_jointly();
        }
        let mut evidence = self.judge();
        let would_prove = self.confirmed + 1 >= self.params.confirming_frames;
        if would_prove && evidence.missing(&self.params.evidence).is_none() {
            let before = self.joint.best().0.clone();
            self.refit();
            evidence = self.judge();
            if evidence.missing(&self.params.evidence).is_some() {
                // Without the priors it diverged: the next frame is not fitted from there.
                *self.joint.best().0 = before;
            }
        }
        self.earlier_frames.push(
            self.pyramid.levels(),
            &self.rotation,
            self.params.max_earlier_frames,
        );
        let travelled = self.current_from_first.inverse().translation;
        let heading = travelled / travelled.norm().max(f64::MIN_POSITIVE);
        let excess = evidence.rival.map_or(0.0, |rival| rival.excess);
        let is_ahead = self.lead.observe(&heading, excess);
        let missing = evidence.missing(&self.params.evidence);
        let missing = missing.or((!is_ahead).then_some(Waiting::Rival));
        self.count_confirmation(missing.is_none(), &heading);
        self.mismatches = if missing == Some(Waiting::Match) { self.mismatches + 1 } else { 0 };
        let state = match missing {
            None if self.confirmed >= self.params.confirming_frames => InitState::Proven,
            _ if self.mismatches >= self.params.max_mismatches => {
                InitState::Failed(Failure::Mismatch)
            }
            _ if self.frames >= self.params.max_frames => InitState::Failed(Failure::TooLong),
            missing => InitState::Waiting(missing.unwrap_or(Waiting::Confirmation)),
        };
        let pace = evidence.translation / f64::from(self.frames);
        let is_fast = pace >= self.params.evidence.min_translation && self.mismatches == 0;
        self.waypoint = is_fast.then(|| Waypoint {
            pixels: pixels.to_vec(),
            heading: self.current_from_first.rotation * self.heading,
            confirmed: self.confirmed,
            least_residual: self.least_residual,
        });
        self.outcome(state, evidence)
    }

    /// Restarts on the previous frame; what it proved still counts. `false` where it has too little texture.
    fn begin_on(&mut self, waypoint: &Waypoint) -> bool {
        let has_begun = self.begin(&waypoint.pixels);
        (self.heading, self.confirmed) = (waypoint.heading, waypoint.confirmed);
        self.least_residual = waypoint.least_residual;
        has_begun
    }

    /// The frame that the depths belong to; empty before the start.
    pub fn first_pixels(&self) -> &[u8] {
        &self.first_pixels
    }

    /// The depths of the first frame's points after the latest frame; usable once proven.
    pub fn depths(&self) -> impl Iterator<Item = InitialDepth> {
        /// Largest relative standard deviation of a usable depth.
        const USABLE_STD_DEV_RATIO: f32 = 0.5;
        let depths = self.inverse_depths.iter().zip(&self.variances);
        self.points.pixels.iter().zip(depths).filter_map(
            |(&(u, v), (&inverse_depth, &variance))| {
                let usable =
                    inverse_depth > 0.0 && variance.sqrt() < USABLE_STD_DEV_RATIO * inverse_depth;
                usable.then_some(InitialDepth { u, v, inverse_depth, variance })
            },
        )
    }

    /// Fills a depth map that was restarted on [`TwoFrameInitializer::first_pixels`]: the points, and around them every
    /// candidate pixel with a larger variance.
    pub fn fill(&self, map: &mut DepthMap) {
        let depths: Vec<InitialDepth> = self.depths().collect();
        spread(&depths, map);
    }

    /// Fits only rotation and brightness, coarse to fine, from the previous frame's.
    fn fit_rotation(&mut self) {
        let input = input(self.pyramid.levels(), &self.intrinsics, &self.points);
        for level in (0..self.intrinsics.len()).rev() {
            let (state, scratch) = (&mut self.rotation, &mut self.rotation_scratch);
            fit_level(&input, level, Freedom::Rotation, state, scratch, &self.params.fit);
        }
    }

    /// Fits pose, brightness and depths jointly, coarse to fine, from several starts.
    fn fit_jointly(&mut self) {
        /// Significance of the previous frame from which parallax may show.
        const PARALLAX_SIGNIFICANCE: f64 = 3.0;
        let input = input(self.pyramid.levels(), &self.intrinsics, &self.points);
        // Before the first fit nothing is known: where the camera moves by many pixels the right motion may not be
        // found from rest.
        let with_directions = self.frames == 1 || self.significance > PARALLAX_SIGNIFICANCE;
        self.joint.fit(
            &input,
            &self.rotation,
            with_directions,
            &self.earlier_frames,
            &self.params.fit,
        );
    }

    /// Whether the gain varies over the image, as behind a lens with vignetting when the image moves across it. Where
    /// it does not, free slopes would only weaken the constraint on the modes of depth: the relief error of a start on
    /// a rendered office rose from 0.03 to 0.13.
    fn needs_slopes(&mut self) -> bool {
        /// Share of the energy that slopes must explain: at most 0.03 in recordings with even light, 0.06 in single
        /// blurred frames; up to 0.27 where the corners lose half of their light, once the image has moved.
        const MIN_SHARE: f64 = 0.06;
        if self.rotation.gain_slopes.is_some() {
            return false;
        }
        let input = input(self.pyramid.levels(), &self.intrinsics, &self.points);
        self.joint.predicted_decrease_by_slopes(&input, &self.params.fit) > MIN_SHARE
    }

    /// Lets the gain vary over the image until the end of this start, in the previous frames as well.
    fn free_slopes(&mut self) {
        self.rotation.free_slopes();
        self.joint.free_slopes();
        self.earlier_frames.free_slopes();
    }

    /// Fits the best motion and its depths again, by the images alone. The priors lead to a motion; in the modes that
    /// two frames hardly constrain (tilt, relief) the priors of all points add up and would flatten the scene: by 20 to
    /// 60 % on a rendered office.
    fn refit(&mut self) {
        /// Finest levels that are fitted again: the motion is known.
        const LEVELS: usize = 2;
        let params = self.params.fit.released();
        let input = input(self.pyramid.levels(), &self.intrinsics, &self.points);
        for level in (0..LEVELS.min(self.intrinsics.len())).rev() {
            self.joint.refit(&input, level, &params);
        }
    }

    /// Computes variances and figures of the latest fit, then scales to mean inverse depth 1.
    fn judge(&mut self) -> Evidence {
        let (rival, scored_by) = (self.joint.rival, self.joint.scored_by);
        let (state, scratch) = self.joint.best();
        let (joint, rotation) = (&scratch.system, &self.rotation_scratch.system);
        let floor = self.params.fit.noise.pixel_std_dev.powi(2);
        let noise = residual_variance(joint, &mut self.sorted).max(floor);
        let match_variance = self.params.match_noise_px.powi(2);
        let covariance = pose_covariance(state, joint);
        let covariance = covariance.as_ref();
        depth_variances(covariance, joint, noise, match_variance, &mut self.variances);
        let evidence = judge(state, joint, &self.variances, rotation, &mut self.sorted);
        let common_error = common_error(covariance, state, joint, noise);
        self.least_residual = self.least_residual.min(evidence.median_residual);
        let evidence = Evidence {
            rival,
            earlier_frames: scored_by,
            common_error,
            // Noise-free images leave next to no residual while the camera hardly moves.
            least_residual: self.least_residual.max(self.params.fit.noise.pixel_std_dev.into()),
            ..evidence
        };
        let visible = joint.points().zip(&state.inverse_depths).filter(|(p, _)| p.visible);
        let mean =
            visible.map(|(_, d)| f64::from(*d)).sum::<f64>() / joint.num_visible.max(1) as f64;
        /// A smaller mean is not a scale but a failed fit.
        const MIN_MEAN: f64 = 0.05;
        self.pose_covariance = covariance.map_or_else(Matrix6::zeros, |covariance| {
            covariance.fixed_view::<6, 6>(0, 0) * f64::from(noise)
        });
        if mean > MIN_MEAN {
            self.pose_covariance.rows_mut(0, 3).scale_mut(mean);
            self.pose_covariance.columns_mut(0, 3).scale_mut(mean);
            let factor = (1.0 / mean) as f32;
            state.current_from_first.translation *= mean;
            state.inverse_depths.iter_mut().for_each(|d| *d *= factor);
            self.variances.iter_mut().for_each(|v| *v *= factor * factor);
        }
        self.significance = evidence.significance;
        self.inverse_depths.clone_from(&state.inverse_depths);
        self.current_from_first = state.current_from_first;
        self.brightness = state.brightness;
        evidence
    }

    /// Counts the consecutive frames that prove the parallax and agree on the direction of motion.
    fn count_confirmation(&mut self, proves: bool, heading: &Vector3<f64>) {
        /// Cosine of 20°: a hand does not turn its path by more within a frame, a wrong minimum does.
        const MIN_AGREEMENT: f64 = 0.94;
        let agrees = heading.dot(&self.heading) >= MIN_AGREEMENT;
        self.confirmed = match (proves, agrees) {
            (true, true) => self.confirmed + 1,
            (true, false) => 1,
            (false, _) => 0,
        };
        self.heading = *heading;
    }

    fn outcome(&self, state: InitState, evidence: Evidence) -> InitOutcome {
        let rotation_rad = self.rotation.current_from_first.rotation.angle();
        InitOutcome {
            rotation_px: rotation_rad * self.intrinsics[0].fx,
            state,
            evidence,
            frames: self.frames,
            first_from_current: self.current_from_first.inverse(),
            pose_covariance: self.pose_covariance,
            brightness: self.brightness,
        }
    }
}

/// The fit input of a full frame.
fn input<'a>(
    images: &'a [Image<f32>],
    intrinsics: &'a [Intrinsics],
    points: &'a Points,
) -> FitInput<'a> {
    FitInput { images, finest: 0, intrinsics, points }
}

#[cfg(test)]
mod brightness_tests;
#[cfg(test)]
mod fast_tests;
#[cfg(test)]
mod hidden_tests;
#[cfg(test)]
mod tests;
