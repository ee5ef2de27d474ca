//! Uncertainty of a start: the pose with the length of its translation held, and the depths.

use nalgebra::SVector;

use crate::slam::two_frame::fit::PoseMatrix;
use crate::slam::two_frame::lanes::{FIRST_SLOPE, NUM_UNKNOWNS};
use crate::slam::two_frame::state::State;
use crate::slam::two_frame::system::{PointSystem, System};
use crate::slam::upper_median::upper_median;

/// Variance of each point's inverse depth with the length of the translation held: that of its own residuals, plus the
/// effect of the uncertain pose, by [`pose_covariance`]. `noise` is the variance of a residual, `match_variance_px`
/// that of the misplacement by interpolation and sampling, pixels²; infinite where a point is not visible.
pub fn depth_variances(
    pose_covariance: Option<&PoseMatrix>,
    system: &System,
    noise: f32,
    match_variance_px: f32,
    variances: &mut Vec<f32>,
) {
    variances.clear();
    variances.extend(system.points().map(|point| {
        let Some(pose_covariance) = pose_covariance else { return f32::INFINITY };
        if !point.visible || !(point.information > 0.0) || !(point.squared_speed > 0.0) {
            return f32::INFINITY;
        }
        noise * (1.0 / point.information + from_pose(&point, pose_covariance))
            + match_variance_px / point.squared_speed
    }));
}

/// Effect of the uncertain pose on the variance of a point's inverse depth, for residuals of variance 1.
fn from_pose(point: &PointSystem, pose_covariance: &PoseMatrix) -> f32 {
    let mixed = SVector::from(point.mixed.map(f64::from)) / f64::from(point.information);
    (mixed.transpose() * pose_covariance * mixed)[0] as f32
}

/// Median over the visible points of the relative error that the uncertain pose causes in all depths together, infinite
/// where it is undetermined; `noise` is the variance of a residual.
pub fn common_error(
    pose_covariance: Option<&PoseMatrix>,
    state: &State,
    system: &System,
    noise: f32,
) -> f64 {
    let Some(pose_covariance) = pose_covariance else { return f64::INFINITY };
    let is_placed =
        |(point, d): &(PointSystem, &f32)| point.visible && point.information > 0.0 && **d > 0.0;
    let points = system.points().zip(&state.inverse_depths).filter(is_placed);
    let mut errors: Vec<f32> =
        points.map(|(point, d)| (from_pose(&point, pose_covariance) * noise).sqrt() / d).collect();
    upper_median(&mut errors, f32::total_cmp).map_or(f64::INFINITY, f64::from)
}

/// Inverse of the pose's normal equations after elimination of the depths, with the scale held; `None` where they are
/// not positive definite.
pub fn pose_covariance(state: &State, system: &System) -> Option<PoseMatrix> {
    let mut hessian = system.hessian;
    for point in system.points().filter(|p| p.visible && p.information > 0.0) {
        let mixed = SVector::from(point.mixed.map(f64::from));
        hessian.ger(-1.0 / f64::from(point.information), &mixed, &mixed, 1.0);
    }
    let length = state.current_from_first.translation.norm();
    if length > 0.0 {
        // A weight far above any other holds the length of the translation.
        let weight = 1e3 * system.hessian.diagonal().rows(0, 3).sum();
        let direction = state.current_from_first.translation / length;
        let mut along = SVector::<f64, NUM_UNKNOWNS>::zeros();
        along.fixed_rows_mut::<3>(0).copy_from(&direction);
        hessian.ger(weight, &along, &along, 1.0);
    }
    let mut covariance = PoseMatrix::zeros();
    match system.has_slopes {
        true => covariance = hessian.cholesky()?.inverse(),
        false => {
            let free = hessian.fixed_view::<FIRST_SLOPE, FIRST_SLOPE>(0, 0).into_owned();
            let inverse = free.cholesky()?.inverse();
            covariance.fixed_view_mut::<FIRST_SLOPE, FIRST_SLOPE>(0, 0).copy_from(&inverse);
        }
    }
    Some(covariance)
}
