//! One picture of a trajectory against ground truth, as a file of its own.

use crate::service::results::report::chart::{Chart, svg_file};
use crate::service::results::report::charts::{
    error_chart, error_points, error_series, trajectory_charts,
};
use crate::service::results::report::views::Views;
use crate::slam::evaluation::TrajectoryEvaluation;
use crate::slam::trajectory::StampedPose;

/// Both trajectories from above and from the side and the position error over time, one below the
/// other, as an SVG file with a white ground.
pub fn evaluation_plot(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    evaluation: &TrajectoryEvaluation,
) -> String {
    let (first, last) = (estimate.first(), estimate.last());
    let times = first.map_or(0, |pose| pose.nanos)..=last.map_or(0, |pose| pose.nanos);
    let truth: Vec<StampedPose> =
        truth.iter().filter(|pose| times.contains(&pose.nanos)).copied().collect();
    let secs = |nanos: i64| nanos.saturating_sub(*times.start()) as f64 * 1e-9;
    let errors = error_series(error_points(estimate, evaluation, secs));
    let views = Views::of(if truth.is_empty() { estimate } else { &truth }, None);
    let views = trajectory_charts(estimate, &truth, &evaluation.alignment, "m", &[], &views);
    let charts: Vec<Chart> = views.into_iter().chain([error_chart(vec![errors])]).collect();
    svg_file(&charts, 1)
}
