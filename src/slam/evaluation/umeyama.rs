//! The similarity that best aligns one set of points with another (Umeyama 1991).

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::trajectory::StampedPose;

/// The transformation fitted before positions are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TrajectoryAlignment {
    /// Rotation, translation and scale: for monocular maps.
    #[default]
    Sim3,
    /// Rotation and translation: where the estimate is in metres.
    SE3,
    /// Nothing: both are in the same coordinate frame already.
    None,
}

impl TrajectoryAlignment {
    /// Fewest matches that determine the alignment.
    pub fn poses_needed(self) -> usize {
        match self {
            Self::Sim3 | Self::SE3 => 3,
            Self::None => 1,
        }
    }
}

/// Why two sets of positions cannot be aligned.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AlignmentError {
    /// All positions of one trajectory are the same, so its scale is undefined.
    #[error("the {0} does not move, so its scale is undefined: align with se3 or none")]
    StandsStill(&'static str),
    /// The best scale is not positive: one is not a similar copy of the other.
    #[error("no positive scale aligns the estimate with the ground truth: align with se3 or none")]
    NoScale,
    /// The positions are so large that their products are not finite.
    #[error("positions too large to compare: check the units of both trajectories")]
    NotFinite,
}

/// Positions that differ by less than this share of their magnitude are the same: the rounding of a file with nine
/// digits.
const STILL_RATIO: f64 = 1e-9;

/// `truth_from_estimate` by least squares on the positions of matched poses: with means μ and the
/// covariance `Σ = 1/n Σ (y − μ_y)(x − μ_x)ᵀ = U D Vᵀ`, `R = U S Vᵀ`, `s = tr(D S)/σ_x²`,
/// `t = μ_y − s R μ_x`, S = diag(1, 1, ±1) so that R is no reflection.
///
/// Positions on a line leave the rotation about it open; any of them gives the same position errors.
pub fn umeyama(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    alignment: TrajectoryAlignment,
) -> Result<Sim3, AlignmentError> {
    if alignment == TrajectoryAlignment::None {
        return Ok(Sim3::identity());
    }
    let (x_mean, y_mean) = (mean_position(estimate), mean_position(truth));
    let count = estimate.len() as f64;
    let mut covariance = Matrix3::zeros();
    let (mut x_variance, mut y_variance) = (0.0, 0.0);
    for (e, t) in estimate.iter().zip(truth) {
        let x = e.world_from_camera.translation - x_mean;
        let y = t.world_from_camera.translation - y_mean;
        covariance += y * x.transpose() / count;
        x_variance += x.norm_squared() / count;
        y_variance += y.norm_squared() / count;
    }
    let finite = covariance.iter().all(|c| c.is_finite()) && (x_variance + y_variance).is_finite();
    if !finite || !(x_mean + y_mean).iter().all(|m| m.is_finite()) {
        return Err(AlignmentError::NotFinite);
    }
    let (rotation, trace) = rotation_and_trace(&covariance)?;
    let scale = match alignment {
        TrajectoryAlignment::Sim3 => {
            check_moves(x_variance, &x_mean, "estimate")?;
            check_moves(y_variance, &y_mean, "ground truth")?;
            trace / x_variance
        }
        TrajectoryAlignment::SE3 | TrajectoryAlignment::None => 1.0,
    };
    if !(scale.is_finite() && scale > 0.0) {
        return Err(AlignmentError::NoScale);
    }
    let translation = y_mean - rotation * x_mean * scale;
    Ok(Sim3::new(SE3 { rotation, translation }, scale))
}

/// `R = U S Vᵀ` and `tr(D S)` of the covariance.
fn rotation_and_trace(
    covariance: &Matrix3<f64>,
) -> Result<(UnitQuaternion<f64>, f64), AlignmentError> {
    const MAX_SWEEPS: usize = 1000;
    let svd = covariance
        .try_svd(true, true, f64::EPSILON, MAX_SWEEPS)
        .ok_or(AlignmentError::NotFinite)?;
    let (Some(u), Some(v_transposed)) = (svd.u, svd.v_t) else {
        return Err(AlignmentError::NotFinite);
    };
    let mut signs = Vector3::new(1.0, 1.0, 1.0);
    if u.determinant() * v_transposed.determinant() < 0.0 {
        signs[svd.singular_values.imin()] = -1.0;
    }
    let rotation = u * Matrix3::from_diagonal(&signs) * v_transposed;
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Ok((rotation, svd.singular_values.dot(&signs)))
}

fn mean_position(poses: &[StampedPose]) -> Vector3<f64> {
    let sum: Vector3<f64> = poses.iter().map(|pose| pose.world_from_camera.translation).sum();
    sum / poses.len() as f64
}

fn check_moves(
    variance: f64,
    mean: &Vector3<f64>,
    which: &'static str,
) -> Result<(), AlignmentError> {
    let still = STILL_RATIO * mean.norm();
    if variance <= still * still || variance < f64::MIN_POSITIVE {
        return Err(AlignmentError::StandsStill(which));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses(positions: &[[f64; 3]]) -> Vec<StampedPose> {
        let pose = |(i, p): (usize, &[f64; 3])| StampedPose {
            nanos: i as i64,
            world_from_camera: SE3 {
                rotation: UnitQuaternion::identity(),
                translation: (*p).into(),
            },
        };
        positions.iter().enumerate().map(pose).collect()
    }

    #[test]
    fn a_mirrored_copy_is_not_aligned_by_a_reflection() {
        let x = poses(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]]);
        let y = poses(&[[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]]);
        let fit = umeyama(&x, &y, TrajectoryAlignment::Sim3).unwrap();
        assert!((fit.rigid.rotation_matrix().determinant() - 1.0).abs() < 1e-12);
        assert!(fit.scale < 1.0);
    }

    #[test]
    fn positions_on_a_line_are_aligned_exactly() {
        let x = poses(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]);
        let y = poses(&[[5.0, 0.0, 0.0], [5.0, 2.0, 0.0], [5.0, 6.0, 0.0]]);
        let fit = umeyama(&x, &y, TrajectoryAlignment::Sim3).unwrap();
        for (a, b) in x.iter().zip(&y) {
            let error = fit * a.world_from_camera.translation - b.world_from_camera.translation;
            assert!(error.norm() < 1e-12);
        }
    }

    #[test]
    fn a_stationary_trajectory_has_a_position_but_no_scale() {
        let x = poses(&[[1e6, 0.0, 0.0], [1e6, 0.0, 0.0], [1e6, 0.0, 0.0]]);
        let y = poses(&[[0.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 3.0, 0.0]]);
        assert_eq!(
            umeyama(&x, &y, TrajectoryAlignment::Sim3),
            Err(AlignmentError::StandsStill("estimate"))
        );
        let place = umeyama(&x, &y, TrajectoryAlignment::SE3).unwrap();
        assert!((place * Vector3::new(1e6, 0.0, 0.0) - Vector3::new(0.0, 2.0, 0.0)).norm() < 1e-6);
    }
}
