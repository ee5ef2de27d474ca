//! Tuning of the joint estimation.

use serde::{Deserialize, Serialize};

use crate::slam::parameter::{ParameterError, check_range};

/// The filter whose points enter the joint estimation; `docs/depth-filters.md` compares them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PointSource {
    /// The most certain pixels of the keyframe's depth.
    #[default]
    Gaussian,
    /// Pixels chosen when the keyframe is created and traced as intervals through the frames that follow: those that
    /// are mature when the next keyframe arrives (Engel, Koltun, Cremers 2018 §2.2).
    Interval,
}

/// Tuning of the joint estimation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WindowParams {
    /// Newest keyframes whose poses are free.
    pub num_free: usize,
    /// Older keyframes that see the same scene and stay fixed.
    pub num_fixed: usize,
    /// The first keyframes of an epoch, in which all but the first are free.
    pub num_first: usize,
    /// Which filter gives the points.
    pub points_from: PointSource,
    /// Points of a keyframe in a full window.
    pub points: usize,
    /// The same while there are few keyframes: as many in all as `num_first` keyframes have.
    pub max_points: usize,
    /// Smallest gradient of a point, grey levels a pixel.
    pub min_gradient: f64,
    /// Largest standard deviation of a point that is chosen, over its inverse depth.
    pub max_relative_deviation: f64,
    /// The cost of residuals beyond this many grey levels grows linearly (Engel, Koltun, Cremers 2018).
    pub huber_grey: f32,
    /// Gradient of the host, grey levels a pixel, at which a sample weighs one half: sub-pixel errors show there.
    pub half_weight_gradient: f32,
    /// A comparison whose mean energy is above the square of this, grey levels, is left out: something else is seen.
    pub truncation_grey: f32,
    /// Most iterations of a level: at 1, 2, 3, 4, 8 the error of a recording was 0.056, 0.041, 0.036, 0.035, 0.036 m.
    pub max_iterations: u32,
    /// The same among the first keyframes.
    pub max_first_iterations: u32,
    /// Keyframes after its own that a frame waits for until it is aligned again.
    pub frame_lag: usize,
    /// Most frames that wait, one byte a pixel each; the oldest keep the pose that the tracker gave them.
    pub max_waiting_frames: usize,
    /// Keyframes from the start of one pass over all, in spare time, to the start of the next: 10 are more than the
    /// window frees, so that each has settled once before it is freed again. With 0 only a closed loop starts one.
    pub pass_every: usize,
    /// Keyframes that are free together in a pass. A new keyframe waits for at most one piece: 14 and the eight that
    /// hold them take about 90 ms of one core, twice what a keyframe's own estimate takes.
    pub pass_piece: usize,
    /// A level is done when the next step would lower the cost by less than this many mean squared residuals: a step of
    /// one standard deviation in one direction lowers it by about one.
    pub converged_decrement: f64,
    /// In a replay and in lockstep: frames from a keyframe to the entry of its joint estimate, which is waited for, so
    /// that every run gives the same map. 3 are 100 ms at 30 Hz, about what it takes live, where it enters as soon as
    /// it is ready.
    pub delay_frames: usize,
}

impl Default for WindowParams {
    fn default() -> Self {
        Self {
            num_free: 7,
            num_fixed: 8,
            num_first: 8,
            points_from: PointSource::default(),
            points: 300,
            max_points: 1000,
            min_gradient: 8.0,
            max_relative_deviation: 0.3,
            huber_grey: 9.0,
            half_weight_gradient: 50.0,
            truncation_grey: 12.0,
            max_iterations: 4,
            max_first_iterations: 40,
            frame_lag: 1,
            max_waiting_frames: 200,
            pass_every: 30,
            pass_piece: 14,
            converged_decrement: 2.0,
            delay_frames: 3,
        }
    }
}

impl WindowParams {
    /// Whether candidates are traced for it, alongside the depth of the active keyframe.
    pub fn traces_candidates(&self) -> bool {
        self.num_free > 0 && self.points_from == PointSource::Interval
    }

    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("num_free", self.num_free, 0..=50)?;
        check_range("num_fixed", self.num_fixed, 0..=50)?;
        check_range("num_first", self.num_first, 2..=50)?;
        check_range("points", self.points, 50..=5000)?;
        check_range("max_points", self.max_points, 50..=5000)?;
        check_range("min_gradient", self.min_gradient, 0.0..=255.0)?;
        check_range("max_relative_deviation", self.max_relative_deviation, 0.001..=10.0)?;
        check_range("huber_grey", self.huber_grey, 0.1..=255.0)?;
        check_range("half_weight_gradient", self.half_weight_gradient, 1.0..=1e4)?;
        check_range("truncation_grey", self.truncation_grey, 1.0..=255.0)?;
        check_range("max_iterations", self.max_iterations, 1..=1000)?;
        check_range("max_first_iterations", self.max_first_iterations, 1..=1000)?;
        check_range("frame_lag", self.frame_lag, 0..=20)?;
        check_range("max_waiting_frames", self.max_waiting_frames, 0..=10_000)?;
        check_range("pass_every", self.pass_every, 0..=10_000)?;
        check_range("pass_piece", self.pass_piece, 2..=40)?;
        check_range("converged_decrement", self.converged_decrement, 0.0..=1e6)?;
        check_range("delay_frames", self.delay_frames, 0..=30)
    }
}
