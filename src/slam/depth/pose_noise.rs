//! The uncertainty of a pose in pixels: by how much it misplaces an epipolar line.

use crate::slam::geometry::intrinsics::Intrinsics;

/// Unknowns of a pose: translation, rotation.
const UNKNOWNS: usize = 6;

/// Standard deviation of the projection of a point along one axis, pixels: the root mean square over the image and over
/// both axes, for points at inverse depth 1. `covariance`: upper triangle, row-major, of the covariance of the left
/// increment (translation, rotation) of `current_from_keyframe`, in keyframe units, whose mean inverse depth is 1, and
/// radians.
///
/// With the ray (x, y, 1): ∂(u, v)/∂t = f (1, 0, −x; 0, 1, −y) d, ∂(u, v)/∂ω = f (−xy, 1+x², −y; −(1+y²), xy, x).
pub fn pose_noise_px(intrinsics: &Intrinsics, covariance: &[f64; 21]) -> f64 {
    /// Positions along each side: the centres of its thirds.
    const SAMPLE_POSITIONS: [f64; 3] = [1.0 / 6.0, 0.5, 5.0 / 6.0];
    let Intrinsics { fx, fy, cx, cy, width, height } = *intrinsics;
    let mut variance = 0.0;
    for (column, row) in SAMPLE_POSITIONS.iter().flat_map(|c| SAMPLE_POSITIONS.map(|r| (c, r))) {
        let (x, y) = ((column * width as f64 - cx) / fx, (row * height as f64 - cy) / fy);
        let along_u = [1.0, 0.0, -x, -x * y, 1.0 + x * x, -y].map(|j| fx * j);
        let along_v = [0.0, 1.0, -y, -(1.0 + y * y), x * y, x].map(|j| fy * j);
        variance += quadratic_form(covariance, &along_u) + quadratic_form(covariance, &along_v);
    }
    let places = (SAMPLE_POSITIONS.len() * SAMPLE_POSITIONS.len()) as f64;
    // An invalid covariance must not count as an exact pose.
    if variance.is_finite() { (variance / (2.0 * places)).max(0.0).sqrt() } else { f64::INFINITY }
}

/// jᵀ Σ j.
fn quadratic_form(upper_triangle: &[f64; 21], j: &[f64; UNKNOWNS]) -> f64 {
    let mut entries = upper_triangle.iter();
    let mut sum = 0.0;
    for row in 0..UNKNOWNS {
        for column in row..UNKNOWNS {
            let entry = entries.next().copied().unwrap_or_default();
            let times = if row == column { 1.0 } else { 2.0 };
            sum += times * entry * j[row] * j[column];
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix6, Vector6};

    use super::*;
    use crate::slam::alignment::scene::Noise;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::pose::upper_triangle;

    #[test]
    fn pose_noise_matches_the_scatter_of_projected_points() {
        let camera =
            Intrinsics { fx: 400.0, fy: 410.0, cx: 315.0, cy: 243.0, width: 640, height: 480 };
        let mut noise = Noise(3);
        // An arbitrary covariance A Aᵀ with standard deviations of a tenth of a percent.
        let root = Matrix6::from_fn(|_, _| 1e-3 * noise.uniform());
        let matrix = root * root.transpose();
        let covariance = upper_triangle(|row, column| matrix[(row, column)]);
        let (mut squares, mut count) = (0.0, 0.0);
        for _ in 0..4000 {
            let moved = SE3::exp(&(root * Vector6::from_fn(|_, _| noise.normal())));
            let (u, v) = (320.0 + 320.0 * noise.uniform(), 240.0 + 240.0 * noise.uniform());
            let point = camera.ray(u, v);
            let point = moved * point;
            let du = camera.fx * point.x / point.z + camera.cx - u;
            let dv = camera.fy * point.y / point.z + camera.cy - v;
            squares += du * du + dv * dv;
            count += 2.0;
        }
        let (predicted, measured) =
            (pose_noise_px(&camera, &covariance), f64::sqrt(squares / count));
        assert!((predicted / measured - 1.0).abs() < 0.05, "{predicted} {measured}");
        assert_eq!(pose_noise_px(&camera, &[0.0; 21]), 0.0);
    }
}
