//! Lenses: projection from a point in camera coordinates to a raw pixel, and from the pixel back to its ray.
//!
//! A new lens is one variant of [`Distortion`]; the round-trip and Jacobian tests run over all variants.

use nalgebra::{Matrix2, Vector2, Vector3};

use crate::slam::geometry::intrinsics::Intrinsics;

/// How a lens deviates from the pinhole.
///
/// Radial-tangential ("radtan", Brown–Conrady, in OpenCV's convention) maps the point `(x, y) = (X/Z, Y/Z)`,
/// with `r² = x² + y²`, to
///
/// `x' = x·g + 2·p1·x·y + p2·(r² + 2x²)`, `y' = y·g + p1·(r² + 2y²) + 2·p2·x·y`,
///
/// `g = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)`.
///
/// Equidistant (Kannala and Brandt, PAMI 2006; OpenCV's `fisheye`) maps the angle `θ` between ray and optical axis to
/// `θ_d = θ·(1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`, the distance from the principal point in focal lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Distortion {
    /// A pinhole.
    None,
    /// `k1 k2 p1 p2`.
    RadTan4([f64; 4]),
    /// `k1 k2 p1 p2 k3`.
    RadTan5([f64; 5]),
    /// `k1 k2 p1 p2 k3 k4 k5 k6`.
    RadTan8([f64; 8]),
    /// `k1 k2 k3 k4`.
    Equidistant([f64; 4]),
}

impl Distortion {
    /// The radtan lens with these coefficients in OpenCV's order: 0, 4, 5 or 8 of them;
    /// `None` for any other count.
    pub fn try_radtan(coefficients: &[f64]) -> Option<Self> {
        match coefficients.len() {
            0 => Some(Self::None),
            4 => coefficients.try_into().ok().map(Self::RadTan4),
            5 => coefficients.try_into().ok().map(Self::RadTan5),
            8 => coefficients.try_into().ok().map(Self::RadTan8),
            _ => None,
        }
    }

    /// The equidistant lens with these four coefficients; `None` for any other count.
    pub fn try_equidistant(coefficients: &[f64]) -> Option<Self> {
        coefficients.try_into().ok().map(Self::Equidistant)
    }

    /// The coefficients, in the order of the variant.
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Self::None => &[],
            Self::RadTan4(k) | Self::Equidistant(k) => k,
            Self::RadTan5(k) => k,
            Self::RadTan8(k) => k,
        }
    }

    /// Whether this lens is a pinhole: no distortion, or radtan with all coefficients zero.
    pub fn is_pinhole(&self) -> bool {
        !matches!(self, Self::Equidistant(_)) && self.coefficients().iter().all(|&k| k == 0.0)
    }

    /// `[k1 k2 p1 p2 k3 k4 k5 k6]`, zeros where the variant has fewer; `None` if not radtan.
    fn radtan(&self) -> Option<[f64; 8]> {
        if matches!(self, Self::Equidistant(_)) {
            return None;
        }
        let mut all = [0.0; 8];
        for (slot, &k) in all.iter_mut().zip(self.coefficients()) {
            *slot = k;
        }
        Some(all)
    }
}

/// Rays at a larger angle to the optical axis than this are outside every radtan lens: `tan` grows without bound there
/// and no calibration covers them.
const STEEPEST_RADTAN_RAD: f64 = 1.5;

/// Samples of the radius in the search for the end of the rising part of a lens polynomial.
const LIMIT_SAMPLES: usize = 3000;

/// Halvings that shrink an interval to the rounding of f64.
const BISECTIONS: usize = 60;

/// Maximum number of Newton steps in the inverse of the radtan lens; it converges in four or five.
const NEWTON_STEPS: usize = 20;

/// Residual, in focal lengths, below which an inverse counts as found: far below any pixel.
const INVERSE_TOLERANCE: f64 = 1e-11;

/// Distance from the optical axis, relative to z, below which `θ_d / radius` is its limit `1/z`: the next term is
/// smaller by the square of this, beyond f64.
const ON_AXIS_RATIO: f64 = 1e-8;

/// A calibrated camera: intrinsics of the raw image and the lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraModel {
    intrinsics: Intrinsics,
    distortion: Distortion,
    /// Where the radial function stops rising: `tan θ` for radtan, `θ` for equidistant. Beyond it a pixel would have
    /// two rays.
    limit: f64,
}

impl CameraModel {
    /// A camera from the intrinsics of its raw image and its lens; `None` unless the intrinsics are valid and the
    /// coefficients finite.
    pub fn new(intrinsics: Intrinsics, distortion: Distortion) -> Option<Self> {
        let finite = distortion.coefficients().iter().all(|k| k.is_finite());
        (intrinsics.is_valid() && finite).then(|| Self {
            intrinsics,
            distortion,
            limit: rising_limit(&distortion),
        })
    }

    /// A camera without distortion, whose intrinsics are valid.
    pub fn undistorted(intrinsics: Intrinsics) -> Self {
        let distortion = Distortion::None;
        Self { intrinsics, distortion, limit: rising_limit(&distortion) }
    }

    /// Intrinsics of the raw image.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// The lens.
    pub fn distortion(&self) -> &Distortion {
        &self.distortion
    }

    /// The raw pixel that sees `point_in_camera` (any length unit). `None` behind the camera
    /// (radtan, pinhole) or outside the lens' valid region; the pixel may lie outside the image.
    pub fn project(&self, point_in_camera: &Vector3<f64>) -> Option<Vector2<f64>> {
        let bent = match self.distortion.radtan() {
            Some(k) => radtan_bend(&k, &self.pinhole(point_in_camera)?),
            None => point_in_camera.xy() * self.equidistant_scale(point_in_camera)?,
        };
        let Intrinsics { fx, fy, cx, cy, .. } = self.intrinsics;
        let pixel = Vector2::new(fx * bent.x + cx, fy * bent.y + cy);
        pixel.iter().all(|p| p.is_finite()).then_some(pixel)
    }

    /// The unit ray in the camera's optical frame that a raw pixel sees; `None` outside the lens'
    /// valid region. The inverse of [`CameraModel::project`].
    pub fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        let Intrinsics { fx, fy, cx, cy, .. } = self.intrinsics;
        let bent = Vector2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy);
        if !bent.iter().all(|b| b.is_finite()) {
            return None;
        }
        let ray = match self.distortion.radtan() {
            Some(k) => {
                let xy = radtan_straighten(&k, &bent, self.limit)?;
                Vector3::new(xy.x, xy.y, 1.0)
            }
            None => {
                let k = self.distortion.coefficients();
                let bent_radius = bent.norm();
                let theta = invert_rising(|t| equidistant_angle(k, t), bent_radius, self.limit)?;
                let direction = if bent_radius > 0.0 { bent / bent_radius } else { bent };
                let (sin, cos) = theta.sin_cos();
                Vector3::new(direction.x * sin, direction.y * sin, cos)
            }
        };
        Some(ray.normalize())
    }

    /// The point on the plane `z = 1`; `None` outside the valid region of the radtan lens.
    fn pinhole(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        if point.z.is_nan() || point.z <= 0.0 {
            return None;
        }
        let xy = point.xy() / point.z;
        (xy.norm_squared() <= self.limit * self.limit).then_some(xy)
    }

    /// `θ_d / radius`, which maps (X, Y) to the distorted plane; `None` outside the valid region of the equidistant
    /// lens.
    fn equidistant_scale(&self, point: &Vector3<f64>) -> Option<f64> {
        let radius = point.xy().norm();
        let theta = radius.atan2(point.z);
        // The point at the camera itself has no direction.
        let has_direction = radius > 0.0 || point.z > 0.0;
        let is_on_axis = point.z > 0.0 && radius < ON_AXIS_RATIO * point.z;
        (has_direction && theta <= self.limit).then(|| match is_on_axis {
            true => 1.0 / point.z,
            false => equidistant_angle(self.distortion.coefficients(), theta) / radius,
        })
    }
}

/// The largest radius up to which the radial function of the lens rises.
fn rising_limit(distortion: &Distortion) -> f64 {
    let Some(k) = distortion.radtan() else {
        let k = distortion.coefficients();
        let at = |i: usize| std::f64::consts::PI * i as f64 / LIMIT_SAMPLES as f64;
        return first_failure(at, |theta| equidistant_slope(k, theta) > 0.0);
    };
    // Spaced by angle, so that the samples are dense where lenses bend.
    let at = |i: usize| (STEEPEST_RADTAN_RAD * i as f64 / LIMIT_SAMPLES as f64).tan();
    first_failure(at, |radius| radtan_slope(&k, radius * radius) > 0.0)
}

/// The interval after this many halvings: `holds` is true at its first end and false at its second.
pub(super) fn bisected(
    [mut good, mut bad]: [f64; 2],
    halvings: usize,
    holds: impl Fn(f64) -> bool,
) -> [f64; 2] {
    for _ in 0..halvings {
        let middle = 0.5 * (good + bad);
        if holds(middle) { good = middle } else { bad = middle }
    }
    [good, bad]
}

/// The last value along `at(0..=LIMIT_SAMPLES)` before `holds` first fails, refined by bisection.
fn first_failure(at: impl Fn(usize) -> f64, holds: impl Fn(f64) -> bool) -> f64 {
    let Some(fails) = (1..=LIMIT_SAMPLES).find(|&i| !holds(at(i))) else {
        return at(LIMIT_SAMPLES);
    };
    bisected([at(fails - 1), at(fails)], BISECTIONS, holds)[0]
}

/// Numerator and denominator of the radial factor and their derivatives with respect to r².
fn radtan_factor(k: &[f64; 8], r2: f64) -> (f64, f64, f64, f64) {
    let [k1, k2, _, _, k3, k4, k5, k6] = *k;
    let top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let bottom = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let d_top = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let d_bottom = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
    (top, bottom, d_top, d_bottom)
}

/// Derivative of the distorted radius `r·g(r²)` with respect to `r`; not positive at and beyond a pole of `g`.
fn radtan_slope(k: &[f64; 8], r2: f64) -> f64 {
    let (top, bottom, d_top, d_bottom) = radtan_factor(k, r2);
    if bottom.is_nan() || bottom <= 0.0 {
        return -1.0;
    }
    top / bottom + 2.0 * r2 * (d_top * bottom - top * d_bottom) / (bottom * bottom)
}

fn radtan_bend(k: &[f64; 8], xy: &Vector2<f64>) -> Vector2<f64> {
    let (x, y, r2) = (xy.x, xy.y, xy.norm_squared());
    let (p1, p2) = (k[2], k[3]);
    let (top, bottom, _, _) = radtan_factor(k, r2);
    let g = top / bottom;
    Vector2::new(
        x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )
}

/// Derivative of [`radtan_bend`].
fn radtan_jacobian(k: &[f64; 8], xy: &Vector2<f64>) -> Matrix2<f64> {
    let (x, y, r2) = (xy.x, xy.y, xy.norm_squared());
    let (p1, p2) = (k[2], k[3]);
    let (top, bottom, d_top, d_bottom) = radtan_factor(k, r2);
    let g = top / bottom;
    let d_g = (d_top * bottom - top * d_bottom) / (bottom * bottom);
    let cross = 2.0 * x * y * d_g + 2.0 * p1 * x + 2.0 * p2 * y;
    Matrix2::new(
        g + 2.0 * x * x * d_g + 2.0 * p1 * y + 6.0 * p2 * x,
        cross,
        cross,
        g + 2.0 * y * y * d_g + 6.0 * p1 * y + 2.0 * p2 * x,
    )
}

/// Inverse of [`radtan_bend`] inside the radius `limit`: the inverse of the radial part alone is the initial value,
/// Newton's method in the plane adds the tangential part.
fn radtan_straighten(k: &[f64; 8], bent: &Vector2<f64>, limit: f64) -> Option<Vector2<f64>> {
    let bent_radius = bent.norm();
    let radial = |r: f64| {
        let (top, bottom, _, _) = radtan_factor(k, r * r);
        r * top / bottom
    };
    // The tangential part may bring in a pixel just outside the radial range.
    let reachable = bent_radius.min(radial(limit));
    let radius = invert_rising(radial, reachable, limit)?;
    let mut xy = if bent_radius > 0.0 { bent * (radius / bent_radius) } else { *bent };
    for _ in 0..NEWTON_STEPS {
        let residual = radtan_bend(k, &xy) - bent;
        if residual.norm() < INVERSE_TOLERANCE * (1.0 + bent_radius) {
            return (xy.norm() <= limit).then_some(xy);
        }
        xy -= radtan_jacobian(k, &xy).try_inverse()? * residual;
    }
    None
}

/// The argument in `[0, limit]` at which the rising function `f` with `f(0) = 0` equals `value`.
fn invert_rising(f: impl Fn(f64) -> f64, value: f64, limit: f64) -> Option<f64> {
    if value.is_nan() || value > f(limit) {
        return None;
    }
    let [low, high] = bisected([0.0, limit], BISECTIONS, |middle| f(middle) < value);
    Some(0.5 * (low + high))
}

fn equidistant_angle(k: &[f64], theta: f64) -> f64 {
    let t2 = theta * theta;
    theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
}

/// Derivative of [`equidistant_angle`].
fn equidistant_slope(k: &[f64], theta: f64) -> f64 {
    let t2 = theta * theta;
    1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(distortion: Distortion) -> CameraModel {
        let raw =
            Intrinsics { fx: 460.0, fy: 455.0, cx: 321.5, cy: 236.0, width: 640, height: 480 };
        CameraModel::new(raw, distortion).expect("valid camera")
    }

    /// Every variant, with coefficients of real lenses.
    fn all_lenses() -> Vec<Distortion> {
        vec![
            Distortion::None,
            Distortion::RadTan4([-0.2834, 0.0740, 0.00019, 1.76e-5]),
            Distortion::RadTan5([0.262383, -0.953104, -0.005358, 0.002628, 1.163314]),
            Distortion::RadTan8([
                0.4916, -2.6889, 0.0007, -0.00005, 1.5655, 0.3677, -2.5116, 1.4951,
            ]),
            Distortion::Equidistant([0.0034, 0.0007, -0.0020, 0.0002]),
        ]
    }

    fn pixels() -> impl Iterator<Item = Vector2<f64>> {
        let principal = Vector2::new(321.5, 236.0);
        let grid = (0..=16).flat_map(|i| {
            (0..=12).map(move |j| {
                Vector2::new(f64::from(i) * 639.0 / 16.0, f64::from(j) * 479.0 / 12.0)
            })
        });
        grid.chain([principal, principal + Vector2::new(1e-9, 0.0)])
    }

    #[test]
    fn projection_inverts_unprojection_over_the_image() {
        for lens in all_lenses() {
            let camera = camera(lens);
            for pixel in pixels() {
                let ray = camera.unproject(&pixel).unwrap_or_else(|| panic!("{lens:?} {pixel}"));
                assert!((ray.norm() - 1.0).abs() < 1e-12);
                let back = camera.project(&(ray * 3.7)).expect("in front");
                assert!((back - pixel).norm() < 1e-7, "{lens:?}: {pixel} came back as {back}");
            }
        }
    }

    #[test]
    fn jacobian_agrees_with_central_differences() {
        const STEP: f64 = 1e-6;
        for k in all_lenses().iter().filter_map(Distortion::radtan) {
            for pixel in pixels() {
                let xy = Vector2::new((pixel.x - 321.5) / 460.0, (pixel.y - 236.0) / 455.0);
                let jacobian = radtan_jacobian(&k, &xy);
                for axis in 0..2 {
                    let mut step = Vector2::zeros();
                    step[axis] = STEP;
                    let difference = radtan_bend(&k, &(xy + step)) - radtan_bend(&k, &(xy - step));
                    let numeric = difference / (2.0 * STEP);
                    let error = (jacobian.column(axis) - numeric).norm();
                    assert!(error < 1e-7 * (1.0 + numeric.norm()), "{k:?} {pixel} {axis}: {error}");
                }
            }
        }
    }

    #[test]
    fn radtan_agrees_with_a_hand_calculation() {
        // x = 0.5, y = 0.25: r² = 0.3125.
        let lens = Distortion::RadTan5([0.1, -0.2, 0.01, 0.02, 0.3]);
        let g = 1.0 + 0.1 * 0.3125 - 0.2 * 0.3125f64.powi(2) + 0.3 * 0.3125f64.powi(3);
        let x = 0.5 * g + 2.0 * 0.01 * 0.125 + 0.02 * (0.3125 + 0.5);
        let y = 0.25 * g + 0.01 * (0.3125 + 0.125) + 2.0 * 0.02 * 0.125;
        let pixel = camera(lens).project(&Vector3::new(1.0, 0.5, 2.0)).expect("in front");
        let expected = Vector2::new(460.0 * x + 321.5, 455.0 * y + 236.0);
        assert!((pixel - expected).norm() < 1e-9);
    }

    #[test]
    fn outside_the_rising_part_both_directions_give_none() {
        // r·(1 − 0.5 r²) rises up to r = √(2/3), where it is 0.5443.
        let camera = camera(Distortion::RadTan4([-0.5, 0.0, 0.0, 0.0]));
        let edge = (2.0f64 / 3.0).sqrt();
        assert!(camera.project(&Vector3::new(edge * 0.999, 0.0, 1.0)).is_some());
        assert!(camera.project(&Vector3::new(edge * 1.001, 0.0, 1.0)).is_none());
        assert!(camera.unproject(&Vector2::new(321.5 + 460.0 * 0.5442, 236.0)).is_some());
        assert!(camera.unproject(&Vector2::new(321.5 + 460.0 * 0.5444, 236.0)).is_none());
        // The rational lens ends at its pole.
        let pole = self::camera(Distortion::RadTan8([0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0]));
        assert!(pole.project(&Vector3::new(0.99, 0.0, 1.0)).is_some());
        assert!(pole.project(&Vector3::new(1.01, 0.0, 1.0)).is_none());
    }

    #[test]
    fn an_equidistant_lens_sees_points_behind_it_and_a_pinhole_does_not() {
        let sideways = Vector3::new(1.0, 0.0, -0.2);
        let fisheye = camera(Distortion::Equidistant([0.0; 4]));
        let pixel = fisheye.project(&sideways).expect("101° off the axis");
        assert!((pixel.x - (321.5 + 460.0 * 1.0f64.atan2(-0.2))).abs() < 1e-9);
        let ray = fisheye.unproject(&pixel).expect("the same ray");
        assert!((ray - sideways.normalize()).norm() < 1e-9);
        assert!(camera(Distortion::None).project(&sideways).is_none());
    }

    #[test]
    fn invalid_numbers_give_none() {
        let raw = *camera(Distortion::None).intrinsics();
        assert!(CameraModel::new(raw, Distortion::RadTan4([f64::NAN, 0.0, 0.0, 0.0])).is_none());
        assert!(CameraModel::new(Intrinsics { fx: -1.0, ..raw }, Distortion::None).is_none());
        assert!(Distortion::try_radtan(&[0.0; 3]).is_none());
        for lens in all_lenses() {
            let camera = camera(lens);
            assert!(camera.project(&Vector3::new(0.0, 0.0, 0.0)).is_none());
            assert!(camera.project(&Vector3::new(f64::NAN, 0.0, 1.0)).is_none());
            assert!(camera.project(&Vector3::new(0.0, 0.0, f64::NAN)).is_none());
            assert!(camera.unproject(&Vector2::new(f64::NAN, 0.0)).is_none());
            assert!(camera.unproject(&Vector2::new(f64::INFINITY, 0.0)).is_none());
        }
    }
}
