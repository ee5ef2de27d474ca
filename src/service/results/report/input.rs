//! What a report is made from.

use crate::service::results::record::RunRecord;
use crate::service::results::summary::Summary;
use crate::slam::evaluation::TrajectoryEvaluation;
use crate::slam::fusion::SurfacePoint;
use crate::slam::trajectory::StampedPose;

/// What a report is made from.
#[derive(Debug, Clone, Copy)]
pub struct ReportInput<'a> {
    /// The run.
    pub record: &'a RunRecord,
    /// Its figures.
    pub summary: &'a Summary,
    /// Final trajectory.
    pub trajectory: &'a [StampedPose],
    /// Trajectory as published.
    pub online: &'a [StampedPose],
    /// The final trajectory against ground truth.
    pub evaluation: Option<&'a TrajectoryEvaluation>,
    /// The published one against ground truth.
    pub online_evaluation: Option<&'a TrajectoryEvaluation>,
    /// The map's surface: any beginning shows all of it.
    pub surface: &'a [SurfacePoint],
    /// Largest σ/d of points that are shown.
    pub max_relative_std_dev: f64,
}
