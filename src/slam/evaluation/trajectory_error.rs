//! Absolute and relative errors of matched trajectories.

use crate::slam::evaluation::association::nearest;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::trajectory::StampedPose;

/// Errors of the motion between pairs of poses.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RelativeErrors {
    /// Length of the translation error, one per pair, unit of the ground truth.
    pub translation: Vec<f64>,
    /// Angle of the rotation error, one per pair, degrees.
    pub rotation_deg: Vec<f64>,
}

impl RelativeErrors {
    /// Adds the errors of other pairs.
    pub fn append(&mut self, other: &Self) {
        self.translation.extend(&other.translation);
        self.rotation_deg.extend(&other.rotation_deg);
    }
}

/// Distance of each aligned position from its true one.
pub fn absolute_errors(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    truth_from_estimate: &Sim3,
) -> Vec<f64> {
    let error = |(e, t): (&StampedPose, &StampedPose)| {
        let aligned = *truth_from_estimate * e.world_from_camera.translation;
        (aligned - t.world_from_camera.translation).norm()
    };
    estimate.iter().zip(truth).map(error).collect()
}

/// Pairs (i, j), j the pose nearest to `interval_nanos` after i, if it is at most `max_difference_nanos` off.
pub fn timed_pairs(
    poses: &[StampedPose],
    interval_nanos: i64,
    max_difference_nanos: i64,
) -> Vec<(usize, usize)> {
    let partner = |(i, pose): (usize, &StampedPose)| {
        let instant = pose.nanos.checked_add(interval_nanos)?;
        let j = nearest(poses, instant, max_difference_nanos)?;
        (j > i).then_some((i, j))
    };
    poses.iter().enumerate().filter_map(partner).collect()
}

/// Errors of the motions over `pairs`: `E = (T_i⁻¹ T_j)⁻¹ (P_i⁻¹ P_j)` with true poses T and
/// estimated poses P, whose lengths are multiplied by `scale` first (Sturm et al. 2012, §IV).
pub fn relative_errors(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    pairs: &[(usize, usize)],
    scale: f64,
) -> RelativeErrors {
    let mut errors = RelativeErrors::default();
    for &(i, j) in pairs {
        let mut estimated = motion(estimate, i, j);
        estimated.translation *= scale;
        let error = motion(truth, i, j).inverse() * estimated;
        errors.translation.push(error.translation.norm());
        errors.rotation_deg.push(error.rotation.angle().to_degrees());
    }
    errors
}

/// `i_from_j`.
fn motion(poses: &[StampedPose], i: usize, j: usize) -> SE3 {
    poses[i].world_from_camera.inverse() * poses[j].world_from_camera
}

/// Length of the path through the positions.
pub fn path_length(poses: &[StampedPose]) -> f64 {
    let step = |pair: &[StampedPose]| {
        (pair[1].world_from_camera.translation - pair[0].world_from_camera.translation).norm()
    };
    poses.windows(2).map(step).sum()
}
