//! A trajectory of several epochs against ground truth: each has its own origin and unit, and is aligned separately.

use crate::slam::evaluation::measured::Measured;
use crate::slam::evaluation::umeyama::TrajectoryAlignment;
use crate::slam::evaluation::{EvaluationError, TrajectoryEvaluation, check_finite};
use crate::slam::geometry::sim3::Sim3;
use crate::slam::trajectory::{EpochPose, StampedPose, by_epoch};

/// One epoch against ground truth.
#[derive(Debug, Clone, PartialEq)]
pub struct EpochEvaluation {
    /// The epoch.
    pub epoch: u32,
    /// Number of its poses.
    pub poses: usize,
    /// Its errors, or why it is left out: too few poses with ground truth, or poses that do not determine an alignment.
    pub result: Result<TrajectoryEvaluation, EvaluationError>,
}

/// A trajectory of one or several epochs against ground truth.
#[derive(Debug, Clone, PartialEq)]
pub struct EpochsEvaluation {
    /// Every epoch, in the order of their numbers.
    pub epochs: Vec<EpochEvaluation>,
    /// The poses of the epochs that are not left out, epoch after epoch, each transformed by its own alignment.
    pub placed: Vec<EpochPose>,
    /// Errors of `placed`, whose alignment is the identity, over all matches of all epochs. No relative error and no
    /// window spans two epochs, and window scales are relative to the scale of their epoch.
    pub total: TrajectoryEvaluation,
}

impl EpochsEvaluation {
    /// Epochs that are not left out.
    pub fn evaluated(&self) -> impl Iterator<Item = &TrajectoryEvaluation> {
        self.epochs.iter().filter_map(|of| of.result.as_ref().ok())
    }
}

/// Compares every epoch of `estimate` with `truth`, as [`evaluate_trajectory`](super::evaluate_trajectory) does for a
/// single one. An epoch that cannot be aligned is left out; it is an error if none can.
pub fn evaluate_epochs(
    estimate: &[EpochPose],
    truth: &[StampedPose],
    alignment: TrajectoryAlignment,
    max_difference_nanos: i64,
) -> Result<EpochsEvaluation, EvaluationError> {
    check_finite(estimate.iter().map(|of| &of.pose), "estimate")?;
    check_finite(truth, "ground truth")?;
    let (mut epochs, mut placed, mut all) = (Vec::new(), Vec::new(), Measured::default());
    for (epoch, poses) in by_epoch(estimate) {
        let measured = Measured::new(&poses, truth, alignment, max_difference_nanos);
        let result = measured.and_then(|(measured, truth_from_epoch)| {
            let evaluation = measured.clone().evaluation(truth_from_epoch)?;
            all.append(&measured, truth_from_epoch.scale, placed.len());
            placed.extend(poses.iter().map(|pose| place(epoch, pose, &truth_from_epoch)));
            Ok(evaluation)
        });
        epochs.push(EpochEvaluation { epoch, poses: poses.len(), result });
    }
    if placed.is_empty() {
        return Err(none_aligned(epochs, estimate.len(), max_difference_nanos));
    }
    Ok(EpochsEvaluation { epochs, placed, total: all.evaluation(Sim3::identity())? })
}

fn place(epoch: u32, pose: &StampedPose, truth_from_epoch: &Sim3) -> EpochPose {
    let world_from_camera = truth_from_epoch.transform_pose(&pose.world_from_camera);
    EpochPose { epoch, pose: StampedPose { nanos: pose.nanos, world_from_camera } }
}

/// Why nothing can be compared: the reason of the longest epoch.
fn none_aligned(
    epochs: Vec<EpochEvaluation>,
    estimated: usize,
    max_difference_nanos: i64,
) -> EvaluationError {
    let count = epochs.len();
    let longest = epochs.into_iter().max_by_key(|of| of.poses);
    match longest.and_then(|of| Some((of.epoch, of.result.err()?))) {
        Some((_, reason)) if count == 1 => reason,
        Some((longest, reason)) => {
            EvaluationError::NoEpoch { epochs: count, longest, reason: Box::new(reason) }
        }
        None => EvaluationError::TooFewMatches {
            found: 0,
            estimated,
            needed: 2,
            max_difference_secs: max_difference_nanos as f64 / 1e9,
            next_secs: None,
        },
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::evaluation::{MAX_DIFFERENCE_NANOS, evaluate_trajectory};
    use crate::slam::geometry::se3::SE3;

    /// A winding path at 30 Hz, off by up to a millimetre where it is not exact.
    fn path(frames: std::ops::Range<usize>, is_exact: bool) -> Vec<StampedPose> {
        let pose = |i: usize| {
            let t = i as f64 / 30.0;
            let off = if is_exact { 0.0 } else { 1e-3 * (7.0 * i as f64).sin() };
            let twist = Vector6::new(t.sin() + off, (1.7 * t).cos(), 0.3 * t, 0.2, 0.1 * t, 0.3);
            StampedPose { nanos: i as i64 * 33_333_333, world_from_camera: SE3::exp(&twist) }
        };
        frames.map(pose).collect()
    }

    fn of_epoch(epoch: u32, poses: &[StampedPose], scale: f64) -> Vec<EpochPose> {
        let twist = Vector6::new(f64::from(epoch), -2.0, 0.5, 0.3, 0.9, -1.2 * scale);
        let similarity = Sim3::new(SE3::exp(&twist), scale);
        poses.iter().map(|pose| place(epoch, pose, &similarity)).collect()
    }

    fn evaluate(estimate: &[EpochPose]) -> Result<EpochsEvaluation, EvaluationError> {
        let truth = path(0..300, true);
        evaluate_epochs(estimate, &truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
    }

    #[test]
    fn each_epoch_is_aligned_separately_and_the_total_is_over_all_matches() {
        // The first epoch continues after the second.
        let (begin, end) = (path(0..60, false), path(200..280, false));
        let first = of_epoch(0, &[begin, end].concat(), 0.5);
        let second = of_epoch(3, &path(100..180, false), 20.0);
        let estimate = [&first[..60], &second, &first[60..]].concat();
        let result = evaluate(&estimate).unwrap();
        let scales = result.evaluated().map(|of| of.alignment.scale);
        for (found, expected) in scales.zip([2.0, 0.05]) {
            assert!((found / expected - 1.0).abs() < 0.01, "{found}, {expected}");
        }
        let count = |of: &EpochEvaluation| (of.epoch, of.poses);
        assert_eq!(result.epochs.iter().map(count).collect::<Vec<_>>(), [(0, 140), (3, 80)]);
        // Each has the errors that it has alone; the total is the mean of the squares of all matches.
        let alone = |poses: &[EpochPose]| {
            let poses: Vec<StampedPose> = poses.iter().map(|of| of.pose).collect();
            let truth = path(0..300, true);
            evaluate_trajectory(&poses, &truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
                .unwrap()
        };
        let [first, second] = [alone(&first), alone(&second)];
        assert!(result.evaluated().eq([&first, &second]));
        let total = &result.total;
        let squares = 140.0 * first.ate.rmse.powi(2) + 80.0 * second.ate.rmse.powi(2);
        assert!((total.ate.rmse - (squares / 220.0).sqrt()).abs() < 1e-12);
        assert!(total.ate.max < 2e-3 && total.rpe_translation.max < 5e-3, "{total:?}");
        assert_eq!(total.path_length, first.path_length + second.path_length);
        assert_eq!(total.pairs.len(), 220);
        assert!((total.window_error.unwrap() - first.window_error.unwrap()).abs() < 1e-3);
        // Its matches are those of the placed poses.
        for (&(e, t), error) in total.pairs.iter().zip(&total.absolute) {
            let placed = result.placed[e].pose.world_from_camera.translation;
            let truth = path(0..300, true)[t].world_from_camera.translation;
            assert!(((placed - truth).norm() - error).abs() < 1e-9);
        }
    }

    #[test]
    fn an_epoch_that_cannot_be_aligned_is_left_out_and_it_is_an_error_where_all_are() {
        let long = of_epoch(0, &path(0..60, true), 2.0);
        let short = of_epoch(1, &path(100..102, true), 2.0);
        let mut still = of_epoch(2, &path(200..220, true), 2.0);
        still.iter_mut().for_each(|of| of.pose.world_from_camera = SE3::identity());
        let result = evaluate(&[&long[..], &short, &still].concat()).unwrap();
        assert_eq!((result.evaluated().count(), result.placed.len()), (1, 60));
        assert!(result.total.ate.max < 1e-9);
        let reasons = |index: usize| result.epochs[index].result.clone().unwrap_err();
        assert!(matches!(reasons(1), EvaluationError::TooFewMatches { found: 2, .. }));
        assert!(matches!(reasons(2), EvaluationError::Alignment(_)));
        let none = evaluate(&[&short[..], &still].concat()).unwrap_err();
        assert!(matches!(none, EvaluationError::NoEpoch { epochs: 2, longest: 2, .. }), "{none}");
        assert!(matches!(evaluate(&short), Err(EvaluationError::TooFewMatches { found: 2, .. })));
        assert!(matches!(evaluate(&[]), Err(EvaluationError::TooFewMatches { found: 0, .. })));
        let mut broken = [&long[..], &short].concat();
        broken[61].pose.world_from_camera.translation.x = f64::NAN;
        let error = evaluate(&broken).unwrap_err();
        assert_eq!(error, EvaluationError::NotFinite { which: "estimate", index: 61 });
    }
}
