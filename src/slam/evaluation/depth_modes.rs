//! Errors of depth that are common to a whole keyframe: tilt along columns and rows, and relief.
//!
//! A relative error of depth that is a plane over the image, or grows with depth, looks like camera motion: poses
//! absorb it and images hardly show it. The median error does not show it either, so it is measured separately: the fit
//! `ln(d_true/d) = γ + αX + βY + ρ ln d_true`, X and Y the ray's coordinates.

use nalgebra::{Matrix4, Vector4};
use serde::{Deserialize, Serialize};

use crate::slam::image::buffer::Image;
use crate::slam::keyframe::Keyframe;
use crate::slam::upper_median::upper_median;

/// The common errors of one keyframe's depth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthModes {
    /// Logarithm of estimated over true depth, at the image centre and the geometric mean depth.
    pub scale: f64,
    /// α: relative depth error per unit of X, which is f pixels along a row.
    pub column: f64,
    /// β: relative depth error per unit of Y, along a column.
    pub row: f64,
    /// ρ: relative depth error per unit of ln d; positive where relief is flattened.
    pub relief: f64,
}

/// Fewest points for a fit.
const MIN_POINTS: usize = 50;
/// Iterations, each with the weights from the one before: errors of wrong matches are unbounded.
const ITERATIONS: usize = 10;
/// Residual that gets half the weight, in median absolute residuals.
const HALF_WEIGHT_MEDIANS: f64 = 2.0;
/// Smallest error that gets half the weight: single-precision depth is no better, and the weights keep their scale.
const MIN_HALF_WEIGHT: f64 = 1e-6;
/// Smallest standard deviation that X, Y and ln d have left once the preceding modes are projected out: below it, a
/// mode cannot be told from the others. 1 % of depth, or of the focal length along the image.
const MIN_SPREAD: f64 = 0.01;

impl DepthModes {
    /// The modes of `keyframe`, whose depth in metres is `metres_per_unit / d`; `None` where too few points have true
    /// depth, or where all are at one depth or on one line.
    pub fn of(keyframe: &Keyframe, true_depth: &Image<f32>, metres_per_unit: f64) -> Option<Self> {
        let mut samples = samples(keyframe, true_depth, metres_per_unit);
        if samples.len() < MIN_POINTS {
            return None;
        }
        let mean = samples.iter().map(|(phi, _)| phi[3]).sum::<f64>() / samples.len() as f64;
        samples.iter_mut().for_each(|(phi, _)| phi[3] -= mean);
        let mut modes = Vector4::zeros();
        let mut half_weight = f64::INFINITY;
        for _ in 0..ITERATIONS {
            let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
            for (phi, error) in &samples {
                let weight = 1.0 / (1.0 + ((error - phi.dot(&modes)) / half_weight).powi(2));
                normal += weight * phi * phi.transpose();
                right += weight * *error * phi;
            }
            modes = solve(normal, &right)?;
            let mut residuals: Vec<f64> =
                samples.iter().map(|(phi, error)| (error - phi.dot(&modes)).abs()).collect();
            let median = upper_median(&mut residuals, f64::total_cmp)?;
            half_weight = (HALF_WEIGHT_MEDIANS * median).max(MIN_HALF_WEIGHT);
        }
        let [scale, column, row, relief] = modes.into();
        modes.iter().all(|mode: &f64| mode.is_finite()).then_some(Self {
            scale,
            column,
            row,
            relief,
        })
    }

    /// Standard deviation, over the points of `keyframe` that have true depth, of the relative error that tilt and
    /// relief cause together: where depth is nearly a plane one can stand for the other, and only their sum tells how
    /// wrong the shape is.
    pub fn spread(&self, keyframe: &Keyframe, true_depth: &Image<f32>) -> f64 {
        let modes = Vector4::new(0.0, self.column, self.row, self.relief);
        let errors: Vec<f64> =
            samples(keyframe, true_depth, 1.0).iter().map(|(phi, _)| phi.dot(&modes)).collect();
        let count = errors.len().max(1) as f64;
        let mean = errors.iter().sum::<f64>() / count;
        (errors.iter().map(|error| (error - mean).powi(2)).sum::<f64>() / count).sqrt()
    }

    /// Absolute values of the tilt along columns and rows and of the relief.
    pub fn magnitudes(&self) -> [f64; 3] {
        [self.column.abs(), self.row.abs(), self.relief.abs()]
    }
}

/// For each point with true depth: (1, X, Y, ln d_true), and the logarithm of its estimated over its true depth.
fn samples(
    keyframe: &Keyframe,
    true_depth: &Image<f32>,
    metres_per_unit: f64,
) -> Vec<(Vector4<f64>, f64)> {
    let camera = &keyframe.intrinsics;
    let mut samples: Vec<(Vector4<f64>, f64)> = Vec::new();
    for point in &keyframe.points {
        let (u, v) = (usize::from(point.u), usize::from(point.v));
        if u >= true_depth.width() || v >= true_depth.height() {
            continue;
        }
        let (z_true, d) = (f64::from(true_depth.at(u, v)), f64::from(point.inverse_depth));
        if !(z_true > 0.0 && z_true.is_finite() && d > 0.0 && d.is_finite()) {
            continue;
        }
        let ray = camera.ray(u as f64, v as f64);
        let error = (metres_per_unit / (d * z_true)).ln();
        samples.push((Vector4::new(1.0, ray.x, ray.y, -z_true.ln()), error));
    }
    samples
}

/// Solves `normal · modes = right`; `None` where the points cannot tell two of the modes apart.
fn solve(normal: Matrix4<f64>, right: &Vector4<f64>) -> Option<Vector4<f64>> {
    let factors = normal.cholesky()?;
    let pivots = factors.l_dirty().diagonal().map(|pivot| pivot * pivot);
    // The first pivot is the sum of the weights, the others are sums of squares.
    let is_apart = |k: usize| pivots[k] >= MIN_SPREAD * MIN_SPREAD * pivots[0];
    (1..4).all(is_apart).then(|| factors.solve(right))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::DepthPoint;

    const CAMERA: Intrinsics =
        Intrinsics { fx: 100.0, fy: 110.0, cx: 59.5, cy: 39.5, width: 120, height: 80 };

    /// A keyframe of unit 2 m and its true depth, with the given modes in its depth.
    fn keyframe(modes: &DepthModes, wrong_share: f64) -> (Keyframe, Image<f32>) {
        let mut truth = Image::filled(CAMERA.width, CAMERA.height, 0.0f32);
        let mut points = Vec::new();
        for v in 0..CAMERA.height {
            for u in 0..CAMERA.width {
                let k = v * CAMERA.width + u;
                let z = 1.0 + (k * 7919 % 1000) as f64 / 500.0;
                truth.pixels_mut()[k] = z as f32;
                let ray = CAMERA.ray(u as f64, v as f64);
                let exponent =
                    modes.column * ray.x + modes.row * ray.y - modes.relief * (z / 1.89).ln();
                let is_wrong = ((k * 31 % 100) as f64) < 100.0 * wrong_share;
                let wrong = if is_wrong { 3.0 } else { 1.0 };
                let inverse_depth = (2.0 / (z * wrong * (modes.scale + exponent).exp())) as f32;
                points.push(DepthPoint {
                    u: u as u16,
                    v: v as u16,
                    inverse_depth,
                    variance: 0.01,
                    intensity: 0.0,
                });
            }
        }
        let keyframe = Keyframe::at(
            Sim3::new(SE3::identity(), 2.0),
            CAMERA,
            points,
            vec![0; CAMERA.width * CAMERA.height],
        );
        (keyframe, truth)
    }

    #[test]
    fn the_modes_are_recovered_despite_wrong_matches() {
        let put = DepthModes { scale: 0.02, column: 0.1, row: -0.05, relief: 0.2 };
        for wrong_share in [0.0, 0.1] {
            let (keyframe, truth) = keyframe(&put, wrong_share);
            let found = DepthModes::of(&keyframe, &truth, 2.0).unwrap();
            assert!((found.column - put.column).abs() < 0.005, "{found:?}");
            assert!((found.row - put.row).abs() < 0.005, "{found:?}");
            assert!((found.relief - put.relief).abs() < 0.005, "{found:?}");
            assert!((found.scale - put.scale).abs() < 0.01, "{found:?}");
            // Of the columns alone: X is even over 1.2.
            let column = DepthModes { row: 0.0, relief: 0.0, ..put };
            let expected = put.column * 1.2 / 12f64.sqrt();
            let spread = column.spread(&keyframe, &truth);
            assert!((spread - expected).abs() < 1e-3, "{spread}, not {expected}");
        }
    }

    #[test]
    fn depth_that_cannot_be_compared_has_no_modes() {
        let exact = DepthModes { scale: 0.0, column: 0.0, row: 0.0, relief: 0.0 };
        let (mut keyframe, mut truth) = keyframe(&exact, 0.0);
        assert!(DepthModes::of(&keyframe, &Image::filled(1, 1, 2.0), 2.0).is_none());
        // At one depth there is no relief.
        truth.pixels_mut().fill(2.0);
        assert!(DepthModes::of(&keyframe, &truth, 2.0).is_none());
        keyframe.points.truncate(MIN_POINTS - 1);
        assert!(DepthModes::of(&keyframe, &truth, 2.0).is_none());
    }

    /// The points of `keyframe` for which `is_seen` holds, with the errors of real depth, and its true depth at 2.7 m.
    fn wall(is_seen: impl Fn(&DepthPoint) -> bool) -> (Keyframe, Image<f32>) {
        let put = DepthModes { scale: 0.02, column: 0.1, row: -0.05, relief: 0.2 };
        let (mut keyframe, mut truth) = keyframe(&put, 0.1);
        keyframe.points.retain(is_seen);
        truth.pixels_mut().fill(2.7);
        (keyframe, truth)
    }

    #[test]
    fn a_wall_at_one_depth_has_no_relief() {
        let (keyframe, mut truth) = wall(|_| true);
        assert_eq!(DepthModes::of(&keyframe, &truth, 2.0), None);
        // Nor does the last bit of single precision make one.
        truth.pixels_mut().iter_mut().step_by(3).for_each(|z| *z = z.next_up());
        assert_eq!(DepthModes::of(&keyframe, &truth, 2.0), None);
        // A wall that is not flat has some.
        truth.pixels_mut().iter_mut().step_by(3).for_each(|z| *z *= 1.05);
        assert!(DepthModes::of(&keyframe, &truth, 2.0).is_some());
    }

    #[test]
    fn points_in_one_line_have_no_tilt_across_it() {
        for is_seen in [|p: &DepthPoint| p.v == 17, |p: &DepthPoint| p.u == p.v + 20] {
            let (keyframe, _) = wall(is_seen);
            let (_, truth) =
                self::keyframe(&DepthModes { scale: 0.0, column: 0.0, row: 0.0, relief: 0.0 }, 0.0);
            assert!(keyframe.points.len() >= MIN_POINTS);
            assert_eq!(DepthModes::of(&keyframe, &truth, 2.0), None);
        }
    }

    #[test]
    fn exact_depths_weigh_like_any_other() {
        let exact = DepthModes { scale: 0.0, column: 0.0, row: 0.0, relief: 0.0 };
        let (mut keyframe, mut truth) = keyframe(&exact, 0.0);
        // Most depths are exact to the last bit, and equal: the rest must not lose their weight.
        for (k, (point, z)) in keyframe.points.iter_mut().zip(truth.pixels_mut()).enumerate() {
            *z = if k % 4 == 0 { 4.0 } else { 2.0 };
            let error = if k % 8 == 0 { 1e-9 } else { 0.0 };
            point.inverse_depth = (2.0 / (f64::from(*z) * (1.0 + error))) as f32;
        }
        let found = DepthModes::of(&keyframe, &truth, 2.0).expect("two depths have relief");
        assert!(found.magnitudes().iter().all(|&mode| mode < 1e-6), "{found:?}");
    }
}
