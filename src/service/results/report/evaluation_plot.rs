//! One picture of a trajectory against ground truth, as a separate file.

use nalgebra::Vector3;

use crate::service::results::report::chart::{Chart, svg_file};
use crate::service::results::report::charts::{
    ERROR, error_chart, error_points, trajectory_charts,
};
use crate::service::results::report::series::{Mark, Series};
use crate::service::results::report::views::Views;
use crate::slam::evaluation::epochs::EpochsEvaluation;
use crate::slam::geometry::se3::SE3;
use crate::slam::trajectory::StampedPose;

/// Both trajectories from above and from the side and the position error over time, one below the other, as an SVG file
/// with a white background. No line connects two epochs.
pub fn evaluation_plot(evaluation: &EpochsEvaluation, truth: &[StampedPose]) -> String {
    let placed: Vec<StampedPose> = evaluation.placed.iter().map(|of| of.pose).collect();
    let first = placed.iter().map(|pose| pose.nanos).min().unwrap_or(0);
    let last = placed.iter().map(|pose| pose.nanos).max().unwrap_or(0);
    let truth: Vec<StampedPose> =
        truth.iter().filter(|pose| (first..=last).contains(&pose.nanos)).copied().collect();
    let secs = |nanos: i64| nanos.saturating_sub(first) as f64 * 1e-9;
    let epoch_of = |pair: &(usize, usize)| evaluation.placed[pair.0].epoch;
    let points = error_points(&placed, &evaluation.total, secs);
    let epochs = evaluation.total.pairs.iter().map(epoch_of);
    let errors = with_gaps(epochs, &points, [f64::NAN; 2]);
    let errors = Series::new("error", ERROR, Mark::Line, errors);
    let views = Views::of(if truth.is_empty() { &placed } else { &truth }, None);
    // A point without a position breaks its line.
    let translation = Vector3::repeat(f64::NAN);
    let nowhere =
        StampedPose { nanos: 0, world_from_camera: SE3 { translation, ..SE3::identity() } };
    let epochs = evaluation.placed.iter().map(|of| of.epoch);
    let drawn = with_gaps(epochs, &placed, nowhere);
    let views = trajectory_charts(&drawn, &truth, &evaluation.total.alignment, "m", &[], &views);
    let charts: Vec<Chart> = views.into_iter().chain([error_chart(vec![errors])]).collect();
    svg_file(&charts, 1)
}

/// The points of a line, with a `gap` wherever the epoch changes.
fn with_gaps<T: Copy>(epochs: impl Iterator<Item = u32>, points: &[T], gap: T) -> Vec<T> {
    let mut last = None;
    let mut line = Vec::with_capacity(points.len());
    for (epoch, point) in epochs.zip(points) {
        let is_other = last.replace(epoch).is_some_and(|last| last != epoch);
        line.extend(is_other.then_some(gap));
        line.push(*point);
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::results::report::charts::ESTIMATE;
    use crate::slam::evaluation::MAX_DIFFERENCE_NANOS;
    use crate::slam::evaluation::epochs::evaluate_epochs;
    use crate::slam::evaluation::umeyama::TrajectoryAlignment;
    use crate::slam::trajectory::EpochPose;

    #[test]
    fn no_line_connects_two_epochs() {
        // More points than a chart draws, so that they are thinned.
        let truth: Vec<StampedPose> = (0..20_000)
            .map(|i| {
                let t = f64::from(i) * 1e-3;
                let translation = Vector3::new(t.sin(), 0.5 * (3.0 * t).cos(), 0.1 * t);
                let world_from_camera = SE3 { translation, ..SE3::identity() };
                StampedPose { nanos: i64::from(i) * 33_333_333, world_from_camera }
            })
            .collect();
        for (epochs, lines) in [(1, 1), (2, 2)] {
            let epoch = |i: usize| if i < 7_001 { 0 } else { epochs - 1 };
            let of = |(i, pose): (usize, &StampedPose)| EpochPose { epoch: epoch(i), pose: *pose };
            let estimate: Vec<EpochPose> = truth.iter().enumerate().map(of).collect();
            let alignment = TrajectoryAlignment::Sim3;
            let evaluation =
                evaluate_epochs(&estimate, &truth, alignment, MAX_DIFFERENCE_NANOS).unwrap();
            let svg = evaluation_plot(&evaluation, &truth);
            let paths = svg.split("<path d=\"").filter(|path| path.contains('L'));
            let begins: Vec<usize> = paths
                .filter(|path| path.contains(ESTIMATE) || path.contains(ERROR))
                .map(|path| path.split('"').next().unwrap().matches('M').count())
                .collect();
            assert_eq!(begins, [lines; 3], "above, from the side, error");
        }
    }
}
