//! Accuracy of an estimate: trajectories against ground truth, depth against true depth.
//!
//! The trajectory figures are those of the Python package `evo` on the same files: nearest stamps without interpolation
//! (`association`), Umeyama alignment ([`mod@umeyama`]), absolute and relative errors ([`trajectory_error`]), per epoch
//! where there are several ([`epochs`]); [`normalized_error`] compares pose errors with their covariance. `windows`
//! adds scale drift, [`depth_error`] the accuracy of the depth maps and their variances, [`depth_modes`] the errors
//! common to a whole depth map, [`start_error`] the error of a start. Without ground truth, [`map_consistency`]
//! compares the keyframes with each other ([`shared_view`], [`patch_misfit`], [`depth_agreement`]), and [`grade`] turns
//! that into a grade.

pub(crate) mod association;
pub mod depth_agreement;
pub mod depth_error;
pub mod depth_modes;
pub mod epochs;
pub mod grade;
pub mod map_consistency;
mod measured;
pub mod normalized_error;
pub mod patch_misfit;
pub mod shared_view;
pub mod start_error;
pub mod statistics;
pub mod surface_error;
pub mod trajectory_error;
pub mod umeyama;
pub mod velocity_error;
pub(crate) mod windows;

use crate::slam::evaluation::measured::Measured;
use crate::slam::evaluation::statistics::ErrorStatistics;
use crate::slam::evaluation::umeyama::{AlignmentError, TrajectoryAlignment};
use crate::slam::geometry::sim3::Sim3;
use crate::slam::trajectory::StampedPose;

/// Largest difference of two stamps that count as the same instant: 0.02 s, less than half a frame at 20 Hz and
/// customary among the field's tools.
pub const MAX_DIFFERENCE_NANOS: i64 = 20_000_000;

/// Why two trajectories cannot be compared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EvaluationError {
    /// A non-finite stamp or pose: a broken file or a diverged estimate.
    #[error("pose {index} of the {which} is not finite: remove it or fix its source")]
    NotFinite {
        /// `estimate` or `ground truth`.
        which: &'static str,
        /// Index in the trajectory, from 0.
        index: usize,
    },
    /// Too few poses have ground truth near their stamps.
    #[error(
        "only {found} of {estimated} poses have ground truth within {max_difference_secs} s (at least {needed} are needed){}: check that both use the same clock and unit, or allow a larger difference",
        next_text(*next_secs)
    )]
    TooFewMatches {
        /// Matches found.
        found: usize,
        /// Poses of the estimate.
        estimated: usize,
        /// Matches needed.
        needed: usize,
        /// Largest difference of stamps that was allowed, seconds.
        max_difference_secs: f64,
        /// From the stamps of the nearest pose that is not matched to those of the other trajectory, seconds; `None`
        /// where there is none.
        next_secs: Option<f64>,
    },
    /// All matches are with the same pose.
    #[error(
        "all {found} matched poses of the {of} are matched with the same pose of the {only}, within {max_difference_secs} s: check that both use the same clock and unit, or allow a smaller one"
    )]
    OneMatch {
        /// Matches found.
        found: usize,
        /// The trajectory with these poses: `estimate` or `ground truth`.
        of: &'static str,
        /// The trajectory with the one pose.
        only: &'static str,
        /// Largest difference of stamps that was allowed, seconds.
        max_difference_secs: f64,
    },
    /// The positions do not determine the alignment.
    #[error(transparent)]
    Alignment(#[from] AlignmentError),
    /// None of several epochs can be compared.
    #[error("none of {epochs} epochs can be compared; epoch {longest}, the longest: {reason}")]
    NoEpoch {
        /// Number of epochs.
        epochs: usize,
        /// The epoch with the most poses.
        longest: u32,
        /// Why that epoch cannot be compared.
        reason: Box<EvaluationError>,
    },
}

fn next_text(next_secs: Option<f64>) -> String {
    next_secs.map_or(String::new(), |secs| format!(", the next is {secs} s away"))
}

/// Errors of a trajectory against ground truth. Lengths are in the ground truth's unit.
#[derive(Debug, Clone, PartialEq)]
pub struct TrajectoryEvaluation {
    /// The poses that were compared: (index in the estimate, index in the ground truth), in order of time.
    pub pairs: Vec<(usize, usize)>,
    /// `truth_from_estimate`, by the requested alignment.
    pub alignment: Sim3,
    /// Position errors after alignment, one per match.
    pub absolute: Vec<f64>,
    /// Statistics of [`Self::absolute`]: the ATE.
    pub ate: ErrorStatistics,
    /// Relative translation error from match to match (evo's delta of 1 frame, all pairs).
    pub rpe_translation: ErrorStatistics,
    /// Relative rotation error from match to match, degrees.
    pub rpe_rotation_deg: ErrorStatistics,
    /// Relative translation error over 1 s; `None` where no two matches are 1 s apart.
    pub rpe_translation_1s: Option<ErrorStatistics>,
    /// Relative rotation error over 1 s, degrees.
    pub rpe_rotation_deg_1s: Option<ErrorStatistics>,
    /// Length of the path between the matched ground-truth positions.
    pub path_length: f64,
    /// Scale of each window of 100 matches up to the last match, by the index of its first match.
    pub window_scales: Vec<(usize, f64)>,
    /// Largest over smallest of [`Self::window_scales`]; `None` below two windows.
    pub window_scale_ratio: Option<f64>,
    /// Median position error over windows of 30 matches, each aligned separately.
    pub window_error: Option<f64>,
}

/// Compares `estimate` with `truth`, both in order of their stamps.
pub fn evaluate_trajectory(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    alignment: TrajectoryAlignment,
    max_difference_nanos: i64,
) -> Result<TrajectoryEvaluation, EvaluationError> {
    check_finite(estimate, "estimate")?;
    check_finite(truth, "ground truth")?;
    let (measured, truth_from_estimate) =
        Measured::new(estimate, truth, alignment, max_difference_nanos)?;
    measured.evaluation(truth_from_estimate)
}

fn check_finite<'a>(
    poses: impl IntoIterator<Item = &'a StampedPose>,
    which: &'static str,
) -> Result<(), EvaluationError> {
    match poses.into_iter().position(|pose| !pose.world_from_camera.is_finite()) {
        Some(index) => Err(EvaluationError::NotFinite { which, index }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector3, Vector6};

    use super::*;
    use crate::slam::geometry::se3::SE3;

    /// A winding path at 30 Hz.
    fn path(frames: usize) -> Vec<StampedPose> {
        let pose = |i: usize| {
            let t = i as f64 / 30.0;
            let position = [t.sin(), 0.4 * (1.7 * t).cos(), 0.3 * t];
            let rotation = [0.2 * t.cos(), 0.1 * t, 0.3 * (0.5 * t).sin()];
            let mut world_from_camera =
                SE3::exp(&Vector6::new(0.0, 0.0, 0.0, rotation[0], rotation[1], rotation[2]));
            world_from_camera.translation = Vector3::from(position);
            StampedPose { nanos: i as i64 * 33_333_333, world_from_camera }
        };
        (0..frames).map(pose).collect()
    }

    fn transformed(poses: &[StampedPose], by: &Sim3) -> Vec<StampedPose> {
        let place = |pose: &StampedPose| StampedPose {
            nanos: pose.nanos,
            world_from_camera: by.transform_pose(&pose.world_from_camera),
        };
        poses.iter().map(place).collect()
    }

    #[test]
    fn a_similar_copy_has_no_error_and_the_inverse_scale() {
        let truth = path(300);
        let similarity = Sim3::new(SE3::exp(&Vector6::new(1.0, -2.0, 0.5, 0.3, 0.9, -1.2)), 0.25);
        let estimate = transformed(&truth, &similarity);
        let result =
            evaluate_trajectory(&estimate, &truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
                .unwrap();
        assert!(result.ate.max < 1e-9);
        assert!((result.alignment.scale - 4.0).abs() < 1e-9);
        assert!(result.rpe_translation.max < 1e-9 && result.rpe_rotation_deg.max < 1e-5);
        assert!(result.rpe_translation_1s.unwrap().max < 1e-9);
        assert!((result.window_scale_ratio.unwrap() - 1.0).abs() < 1e-9);
        assert!(result.window_error.unwrap() < 1e-9);
        let rigid =
            evaluate_trajectory(&estimate, &truth, TrajectoryAlignment::SE3, MAX_DIFFERENCE_NANOS)
                .unwrap();
        assert_eq!(rigid.alignment.scale, 1.0);
        assert!(rigid.ate.rmse > 0.1);
    }

    #[test]
    fn scale_drift_shows_in_the_window_scales_and_not_in_the_window_errors() {
        let truth = path(300);
        let mut estimate = truth.clone();
        for (i, pose) in estimate.iter_mut().enumerate() {
            pose.world_from_camera.translation *= if i < 100 { 1.0 } else { 2.0 };
        }
        let result =
            evaluate_trajectory(&estimate, &truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
                .unwrap();
        assert!((result.window_scale_ratio.unwrap() - 2.0).abs() < 1e-9);
        assert!(result.window_error.unwrap() < 1e-9);
        assert!(result.ate.rmse > 0.05);
    }

    #[test]
    fn matches_with_a_single_pose_are_called_that() {
        let mut truth = path(40);
        // In other units: all stamps are nearest to the last one.
        truth.iter_mut().for_each(|pose| pose.nanos /= 1_000_000);
        let of = |found, of, only| EvaluationError::OneMatch {
            found,
            of,
            only,
            max_difference_secs: 3600.0,
        };
        let estimate = &path(35)[5..];
        for alignment in [TrajectoryAlignment::Sim3, TrajectoryAlignment::None] {
            let evaluate = |a, b| evaluate_trajectory(a, b, alignment, 3_600_000_000_000);
            let error = evaluate(estimate, &truth).unwrap_err();
            assert_eq!(error, of(30, "estimate", "ground truth"));
            let words = "all 30 matched poses of the estimate are matched with the same pose of the ground truth";
            assert!(error.to_string().starts_with(words), "{error}");
            let error = evaluate(&truth, estimate).unwrap_err();
            assert_eq!(error, of(30, "ground truth", "estimate"));
        }
    }

    #[test]
    fn arbitrary_input_is_an_error_and_never_a_panic() {
        let truth = path(40);
        let evaluate = |estimate: &[StampedPose], truth: &[StampedPose]| {
            evaluate_trajectory(estimate, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
        };
        assert!(matches!(evaluate(&[], &truth), Err(EvaluationError::TooFewMatches { .. })));
        assert!(matches!(evaluate(&truth, &[]), Err(EvaluationError::TooFewMatches { .. })));
        assert!(matches!(
            evaluate(&truth[..2], &truth),
            Err(EvaluationError::TooFewMatches { found: 2, needed: 3, .. })
        ));
        let mut late = truth.clone();
        late.iter_mut().for_each(|pose| pose.nanos += 5_020_400_000);
        let error = evaluate(&late, &truth[..30]).unwrap_err().to_string();
        assert!(error.starts_with("only 0 of 40 poses"), "{error}");
        assert!(error.contains(", the next is 4.053733343 s away: "), "{error}");
        assert!(error.ends_with("or allow a larger difference"), "{error}");
        let mut broken = truth.clone();
        broken[7].world_from_camera.translation.x = f64::NAN;
        let error = evaluate(&broken, &truth).unwrap_err();
        assert_eq!(error, EvaluationError::NotFinite { which: "estimate", index: 7 });
        let mut still = truth.clone();
        still.iter_mut().for_each(|p| p.world_from_camera = SE3::identity());
        assert!(matches!(evaluate(&still, &truth), Err(EvaluationError::Alignment(_))));
        assert!(matches!(evaluate(&truth, &still), Err(EvaluationError::Alignment(_))));
        let mut huge = truth.clone();
        huge.iter_mut().for_each(|p| p.world_from_camera.translation *= 1e300);
        assert!(evaluate(&huge, &truth).is_err());
        let far = i64::MAX - 5;
        let ends =
            [StampedPose { nanos: i64::MIN, ..truth[0] }, StampedPose { nanos: far, ..truth[1] }];
        assert!(evaluate(&ends, &truth).is_err());
    }
}
