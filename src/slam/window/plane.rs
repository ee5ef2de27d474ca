//! A smooth correction of a keyframe's depth from a few points that are more accurate.

use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

use crate::slam::upper_median::upper_median;

/// A point that is more accurate than the keyframe's depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// Its ray at depth 1.
    pub ray: [f64; 2],
    /// Logarithm of the ratio of its inverse depth to the keyframe's there.
    pub log_ratio: f64,
    /// Logarithm of the keyframe's inverse depth there, in the unit of the map.
    pub log_inverse_depth: f64,
}

/// The relief that remains when a plane has been removed: `log_ratio - plane ≈ offset + relief ln d`; 0 where depths do
/// not differ by more than their noise.
pub fn relief_left(points: &[Correspondence], plane: &[f64; 3]) -> f64 {
    /// Variance of depths beyond a plane over that of their noise, above which relief can be determined.
    const MIN_RELIEF_RATIO: f64 = 4.0;
    /// Largest relief: depth flattened by half. More is a wrong fit.
    const MAX_RELIEF: f64 = 0.5;
    let residual = |point: &Correspondence| {
        point.log_ratio - plane[0] - plane[1] * point.ray[0] - plane[2] * point.ray[1]
    };
    let spread = spread(points.iter().map(|point| residual(point).abs()).collect());
    let (mut normal, mut right, mut total) = (Matrix4::zeros(), Vector4::zeros(), 0.0);
    for point in points {
        let residual = residual(point);
        let weight = weight_of(residual.abs() / spread);
        let shape = Vector4::new(1.0, point.ray[0], point.ray[1], point.log_inverse_depth);
        normal += weight * shape * shape.transpose();
        right += weight * residual * shape;
        total += weight;
    }
    // Beyond the plane: variance of ln d and its covariance with the residual.
    let of_plane = normal.fixed_view::<3, 3>(0, 0).into_owned();
    let across = normal.fixed_view::<3, 1>(0, 3).into_owned();
    let Some(inverse) = of_plane.cholesky().map(|of| of.inverse()) else { return 0.0 };
    let taken = inverse * across;
    let variance = (normal[(3, 3)] - taken.dot(&across)) / total;
    let covariance = (right.w - taken.dot(&right.fixed_view::<3, 1>(0, 0))) / total;
    // The keyframe's noise is in both, with opposite signs.
    let noise = spread * spread;
    if !(variance > MIN_RELIEF_RATIO * noise) {
        return 0.0;
    }
    ((covariance + noise) / (variance - noise)).clamp(-MAX_RELIEF, MAX_RELIEF)
}

/// `log_ratio ≈ offset + per_x X + per_y Y` for most of the points: offset and slopes. A single offset where there are
/// too few points for a plane, `None` where there are too few for that.
pub fn fit(points: &[Correspondence]) -> Option<[f64; 3]> {
    /// Points that a plane needs: ten per parameter.
    const MIN_FOR_PLANE: usize = 30;
    /// Points that an offset needs.
    const MIN_FOR_OFFSET: usize = 10;
    /// Iterations: the weights settle long before.
    const ITERATIONS: usize = 15;
    /// Largest slope: over an image 60° wide a factor of three from side to side. More is a wrong fit.
    const STEEPEST: f64 = 1.0;
    if points.len() < MIN_FOR_OFFSET {
        return None;
    }
    let middle = median(points.iter().map(|point| point.log_ratio).collect());
    if points.len() < MIN_FOR_PLANE {
        return Some([middle, 0.0, 0.0]);
    }
    let mut plane = Vector3::new(middle, 0.0, 0.0);
    let shape = |point: &Correspondence| Vector3::new(1.0, point.ray[0], point.ray[1]);
    for _ in 0..ITERATIONS {
        let residual = |point: &Correspondence| point.log_ratio - shape(point).dot(&plane);
        let spread = spread(points.iter().map(|point| residual(point).abs()).collect());
        let (mut normal, mut right) = (Matrix3::identity() * 1e-9, Vector3::zeros());
        for point in points {
            let weight = weight_of(residual(point).abs() / spread);
            let shape = shape(point);
            normal += weight * shape * shape.transpose();
            right += weight * point.log_ratio * shape;
        }
        plane = normal.cholesky()?.solve(&right);
    }
    let [offset, per_x, per_y] = plane.into();
    let is_finite = offset.is_finite() && per_x.is_finite() && per_y.is_finite();
    is_finite.then(|| [offset, per_x.clamp(-STEEPEST, STEEPEST), per_y.clamp(-STEEPEST, STEEPEST)])
}

/// Weight of a residual, standard deviations: full within 1.5, none beyond 4.
fn weight_of(residual: f64) -> f64 {
    match residual {
        r if r <= 1.5 => 1.0,
        r if r <= 4.0 => 1.5 / r,
        _ => 0.0,
    }
}

/// Standard deviation of normal errors with these absolute values.
fn spread(sizes: Vec<f64>) -> f64 {
    const SIGMA_OF_MEDIAN: f64 = 1.4826;
    /// Depth is never known better than to a millionth.
    const MIN_SIGMA: f64 = 1e-6;
    (SIGMA_OF_MEDIAN * median(sizes)).max(MIN_SIGMA)
}

/// The upper median; 0 for no values.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    upper_median(&mut values, f64::total_cmp).unwrap_or(0.0)
}
