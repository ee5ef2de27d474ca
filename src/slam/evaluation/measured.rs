//! The errors behind a trajectory's figures: of poses that were aligned together, or of several epochs, each aligned
//! separately.

use crate::slam::evaluation::association::{associate, differences};
use crate::slam::evaluation::statistics::{ErrorStatistics, largest_over_smallest, median};
use crate::slam::evaluation::trajectory_error::{
    RelativeErrors, absolute_errors, path_length, relative_errors, timed_pairs,
};
use crate::slam::evaluation::umeyama::{AlignmentError, TrajectoryAlignment, umeyama};
use crate::slam::evaluation::windows::{scale_windows, shape_errors};
use crate::slam::evaluation::{EvaluationError, TrajectoryEvaluation};
use crate::slam::geometry::sim3::Sim3;
use crate::slam::trajectory::StampedPose;

/// Interval of the second relative error: long enough for drift to exceed noise.
const INTERVAL_NANOS: i64 = 1_000_000_000;

/// Matches and the errors at them.
#[derive(Debug, Clone, Default)]
pub(super) struct Measured {
    /// (index in the estimate, index in the ground truth).
    pairs: Vec<(usize, usize)>,
    absolute: Vec<f64>,
    frames: RelativeErrors,
    seconds: RelativeErrors,
    path_length: f64,
    window_scales: Vec<(usize, f64)>,
    shape: Vec<f64>,
}

impl Measured {
    /// The errors of `estimate` after alignment, and `truth_from_estimate`.
    pub(super) fn new(
        estimate: &[StampedPose],
        truth: &[StampedPose],
        alignment: TrajectoryAlignment,
        max_difference_nanos: i64,
    ) -> Result<(Self, Sim3), EvaluationError> {
        let pairs = associate(estimate, truth, max_difference_nanos);
        let needed = alignment.poses_needed().max(2);
        if pairs.len() < needed {
            let next = differences(estimate, truth).get(pairs.len()).copied();
            return Err(EvaluationError::TooFewMatches {
                found: pairs.len(),
                estimated: estimate.len(),
                needed,
                max_difference_secs: max_difference_nanos as f64 / 1e9,
                next_secs: next.map(|nanos| nanos as f64 / 1e9),
            });
        }
        let (one_estimated, one_true) = pairs[0];
        let is_one_estimated = pairs.iter().all(|&(e, _)| e == one_estimated);
        if is_one_estimated || pairs.iter().all(|&(_, t)| t == one_true) {
            let (of, only) = match is_one_estimated {
                true => ("ground truth", "estimate"),
                false => ("estimate", "ground truth"),
            };
            let max_difference_secs = max_difference_nanos as f64 / 1e9;
            return Err(EvaluationError::OneMatch {
                found: pairs.len(),
                of,
                only,
                max_difference_secs,
            });
        }
        let (estimated, true_poses): (Vec<_>, Vec<_>) =
            pairs.iter().map(|&(e, t)| (estimate[e], truth[t])).unzip();
        let truth_from_estimate = umeyama(&estimated, &true_poses, alignment)?;
        let relative = |pairs: &[(usize, usize)]| {
            relative_errors(&estimated, &true_poses, pairs, truth_from_estimate.scale)
        };
        let successive: Vec<_> = (1..estimated.len()).map(|j| (j - 1, j)).collect();
        let second_pairs = timed_pairs(&estimated, INTERVAL_NANOS, max_difference_nanos);
        let measured = Self {
            absolute: absolute_errors(&estimated, &true_poses, &truth_from_estimate),
            frames: relative(&successive),
            seconds: relative(&second_pairs),
            path_length: path_length(&true_poses),
            window_scales: scale_windows(&estimated, &true_poses),
            shape: shape_errors(&estimated, &true_poses, alignment),
            pairs,
        };
        Ok((measured, truth_from_estimate))
    }

    /// Adds another epoch, whose poses follow `poses` others. A window's scale becomes relative to that of its epoch,
    /// as the units of two epochs are unrelated.
    pub(super) fn append(&mut self, epoch: &Self, scale: f64, poses: usize) {
        let matches = self.absolute.len();
        self.pairs.extend(epoch.pairs.iter().map(|&(e, t)| (e + poses, t)));
        self.absolute.extend(&epoch.absolute);
        self.frames.append(&epoch.frames);
        self.seconds.append(&epoch.seconds);
        self.path_length += epoch.path_length;
        let windows = epoch.window_scales.iter().map(|&(first, of)| (first + matches, of / scale));
        self.window_scales.extend(windows);
        self.shape.extend(&epoch.shape);
    }

    /// The statistics. `alignment` is the one that brought the estimate to the truth.
    pub(super) fn evaluation(
        self,
        alignment: Sim3,
    ) -> Result<TrajectoryEvaluation, EvaluationError> {
        let of = |errors| ErrorStatistics::of(errors).ok_or(AlignmentError::NotFinite);
        Ok(TrajectoryEvaluation {
            ate: of(&self.absolute)?,
            rpe_translation: of(&self.frames.translation)?,
            rpe_rotation_deg: of(&self.frames.rotation_deg)?,
            rpe_translation_1s: ErrorStatistics::of(&self.seconds.translation),
            rpe_rotation_deg_1s: ErrorStatistics::of(&self.seconds.rotation_deg),
            path_length: self.path_length,
            window_scale_ratio: largest_over_smallest(self.window_scales.iter().map(|of| of.1)),
            window_scales: self.window_scales,
            window_error: median(&self.shape),
            alignment,
            pairs: self.pairs,
            absolute: self.absolute,
        })
    }
}
