//! The residual of a point, its variance and its Jacobian, and their sums over a level.
//!
//! With the keyframe's ray x = (x, y, 1), inverse depth d, its variance V and its error c common to neighbours, and
//! everything scaled by d so that distant points stay finite (`spec` letters):
//! ```text
//! X̃  = R x + t d = (x̃, ỹ, z̃)          p' = π(X̃)        n = (x̃, ỹ)/z̃
//! r   = I(p') − (eᵃ I_k + b)            a_x = g_x f_x     a_y = g_y f_y     m = a_x n_x + a_y n_y
//! J_t = d/z̃ (a_x, a_y, −m)             J_r = (−a_y − n_y m, a_x + n_x m, n_x a_y − n_y a_x)
//! ∂r/∂d = (a_x t_x + a_y t_y − m t_z)/z̃
//! σ_r² = (1 + e²ᵃ) σ_I² + (∂r/∂d)² (V + c² d²)
//! ```
//! g, the gradient of the new image at p', is taken from the keyframe, which shows the same surface: eᵃ W⁻ᵀ g_k, with W
//! the derivative of the warp at constant d. A gradient sampled from the new image between the pixels that give I(p')
//! shares their noise with the residual, and the product does not average out: where texture is weak, it pushes the
//! pose away from integer pixels (0.3 px at noise of 2 grey levels). The keyframe's central difference shares no pixel
//! with either term of r, is computed once per keyframe, and halves the reads per point.

use nalgebra::Vector3;

use crate::slam::alignment::normal_equations::{NormalEquations, UNKNOWNS};
use crate::slam::alignment::params::AlignmentParams;
use crate::slam::alignment::points::{LANES, LevelPoints, Point};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::image::sums::grey_per_sum;
use crate::slam::pose::Brightness;

/// Unused pixels at the border, where rectification and lenses are worst.
pub(crate) const BORDER_PX: f32 = 1.0;

/// A point nearer to the camera than this share of its depth in the keyframe is not used: it is magnified beyond
/// recognition, and division by its depth loses digits.
pub(crate) const NEAREST_DEPTH_RATIO: f32 = 0.1;

/// Lower bound of the determinant by which a tilted surface shrinks its image: the gradient must stay finite.
pub(crate) const SMALLEST_DETERMINANT: f32 = 0.1;

/// Grey levels between which the frame shows the brightness of a point. At the limits of the sensor's range, to
/// rounding, the point is at least as bright or as dark. Black is 1: 0 is [`NO_DATA`](crate::slam::image::NO_DATA).
pub(crate) const UNCLIPPED_GREY: [f32; 2] = [1.5, 254.5];

/// One state on one level, in the form needed by the loop over points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evaluation {
    pub(crate) rotation: [f32; 9],
    pub(crate) translation: [f32; 3],
    pub(crate) variance_translation: [f32; 3],
    pub(crate) focal: [f32; 2],
    pub(crate) centre: [f32; 2],
    pub(crate) upper_bound: [f32; 2],
    pub(crate) grey_per_sum: f32,
    pub(crate) gain: f32,
    pub(crate) offset: f32,
    pub(crate) intensity_variance: f32,
    pub(crate) depth_variance_factor: f32,
    pub(crate) common_variance_factor: f32,
    pub(crate) huber: f32,
    pub(crate) inlier_gate_squared: f32,
}

impl Evaluation {
    /// The evaluation at `current_from_keyframe` (translation in keyframe units) and `brightness` on `level`;
    /// `intrinsics` are those of the level, `params` determine how residuals are weighted. `variance_translation` is
    /// the translation at which (∂r/∂d)² V is evaluated.
    pub fn new(
        intrinsics: &Intrinsics,
        level: usize,
        current_from_keyframe: &SE3,
        brightness: Brightness,
        params: &AlignmentParams,
        variance_translation: &Vector3<f64>,
    ) -> Self {
        let rotation = current_from_keyframe.rotation_matrix();
        let gain = brightness.a.exp() as f32;
        let depth_variance_factor = if params.use_depth_variance { 1.0 } else { 0.0 };
        // The last pixel that has a right and a lower neighbour, less the border.
        let upper = |side: usize| side as f32 - 1.0 - BORDER_PX;
        Self {
            rotation: std::array::from_fn(|i| rotation[(i / 3, i % 3)] as f32),
            translation: std::array::from_fn(|i| current_from_keyframe.translation[i] as f32),
            variance_translation: std::array::from_fn(|i| variance_translation[i] as f32),
            focal: [intrinsics.fx as f32, intrinsics.fy as f32],
            centre: [intrinsics.cx as f32, intrinsics.cy as f32],
            upper_bound: [upper(intrinsics.width), upper(intrinsics.height)],
            grey_per_sum: grey_per_sum(level),
            gain,
            offset: brightness.b as f32,
            intensity_variance: (1.0 + gain * gain) * params.noise.variance(level),
            depth_variance_factor,
            common_variance_factor: depth_variance_factor * params.common_depth_error.powi(2),
            huber: params.huber,
            inlier_gate_squared: params.inlier_gate * params.inlier_gate,
        }
    }

    /// X̃ of a point at inverse depth `d`.
    #[inline(always)]
    fn warp(&self, point: &Point, d: f32) -> [f32; 3] {
        let [r0, r1, r2, r3, r4, r5, r6, r7, r8] = self.rotation;
        let [tx, ty, tz] = self.translation;
        let (x, y) = (point.ray_x, point.ray_y);
        [
            r0 * x + r1 * y + r2 + tx * d,
            r3 * x + r4 * y + r5 + ty * d,
            r6 * x + r7 * y + r8 + tz * d,
        ]
    }
}

/// The contribution of one point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointTerms {
    /// Its projection, pixels of the level.
    pub projection: [f32; 2],
    /// r, grey levels.
    pub residual: f32,
    /// Whether the sensor clipped a brightness predicted beyond its range: r then carries no information.
    pub is_clipped: bool,
    /// σ_r², grey levels².
    pub variance: f32,
    /// The same without the error that neighbouring points share: the measure of an inlier.
    pub own_variance: f32,
    /// ∂r/∂d, grey levels · keyframe units.
    pub inverse_depth_derivative: f32,
    /// ∂r/∂(translation, rotation, a, b).
    pub jacobian: [f32; UNKNOWNS],
}

/// The terms of one point; `None` if it is out of view, or where the image has no data.
#[inline(always)]
pub fn point_terms(image: &Image<u16>, at: &Evaluation, point: &Point) -> Option<PointTerms> {
    let [u, v] = projection(at, point)?;
    let value = sample(image, u, v)? * at.grey_per_sum;
    let Surface { a: [ax, ay], n: [nx, ny], inverse_ratio } = Surface::of(at, point);
    let m = ax * nx + ay * ny;
    let along = |[x, y, z]: [f32; 3]| -> f32 { (ax * x + ay * y - m * z) * inverse_ratio };
    let inverse_depth_derivative = along(at.translation);
    let weighing_derivative = along(at.variance_translation);
    let squared_derivative = weighing_derivative * weighing_derivative;
    let from_depth = squared_derivative * point.variance;
    let own_variance = at.intensity_variance + at.depth_variance_factor * from_depth;
    let squared_depth = point.inverse_depth * point.inverse_depth;
    let predicted = at.gain * point.intensity;
    let residual = value - (predicted + at.offset);
    let [darkest, lightest] = UNCLIPPED_GREY;
    let scale = point.surrounding_inverse_depth * inverse_ratio;
    Some(PointTerms {
        projection: [u, v],
        residual,
        is_clipped: (value > lightest && residual < 0.0) || (value < darkest && residual > 0.0),
        variance: own_variance + at.common_variance_factor * (squared_derivative * squared_depth),
        own_variance,
        inverse_depth_derivative,
        jacobian: [
            scale * ax,
            scale * ay,
            -scale * m,
            -(ay + ny * m),
            ax + nx * m,
            nx * ay - ny * ax,
            -predicted,
            -1.0,
        ],
    })
}

/// Projection of a point, pixels of the level; `None` if it is out of view.
#[inline(always)]
fn projection(at: &Evaluation, point: &Point) -> Option<[f32; 2]> {
    let [warped_x, warped_y, depth_ratio] = at.warp(point, point.inverse_depth);
    if !(depth_ratio > NEAREST_DEPTH_RATIO) {
        return None;
    }
    let inverse_ratio = 1.0 / depth_ratio;
    let (nx, ny) = (warped_x * inverse_ratio, warped_y * inverse_ratio);
    let u = at.focal[0] * nx + at.centre[0];
    let v = at.focal[1] * ny + at.centre[1];
    let inside = u >= BORDER_PX && v >= BORDER_PX && u < at.upper_bound[0] && v < at.upper_bound[1];
    inside.then_some([u, v])
}

/// Bilinear sample of the image; `None` if it includes a pixel without data.
#[inline(always)]
fn sample(image: &Image<u16>, u: f32, v: f32) -> Option<f32> {
    let (column, row) = (u as usize, v as usize);
    let (du, dv) = (u - column as f32, v - row as f32);
    let upper = column + row * image.width();
    let pixel = |index: usize| f32::from(image.pixels()[index]);
    let (p00, p10) = (pixel(upper), pixel(upper + 1));
    let (p01, p11) = (pixel(upper + image.width()), pixel(upper + image.width() + 1));
    let (above, below) = (p00 + (p10 - p00) * du, p01 + (p11 - p01) * du);
    (p00 * p10 * (p01 * p11) > 0.0).then_some(above + (below - above) * dv)
}

/// The surface around a point as seen in the frame, at the depth of its surroundings.
struct Surface {
    /// (a_x, a_y): the keyframe's gradient, transformed by the warp.
    a: [f32; 2],
    n: [f32; 2],
    /// 1/z̃.
    inverse_ratio: f32,
}

impl Surface {
    #[inline(always)]
    fn of(at: &Evaluation, point: &Point) -> Self {
        let [r0, r1, _, r3, r4, _, r6, r7, _] = at.rotation;
        let [warped_x, warped_y, depth_ratio] = at.warp(point, point.surrounding_inverse_depth);
        let depth_ratio = depth_ratio.max(NEAREST_DEPTH_RATIO);
        let inverse_ratio = 1.0 / depth_ratio;
        let (nx, ny) = (warped_x * inverse_ratio, warped_y * inverse_ratio);
        // Derivative of the warp: ∂n/∂(x, y) = M/z̃.
        let (m11, m12) = (r0 - nx * r6, r1 - nx * r7);
        let (m21, m22) = (r3 - ny * r6, r4 - ny * r7);
        let determinant = (m11 * m22 - m12 * m21).max(SMALLEST_DETERMINANT);
        let scale = at.gain * depth_ratio / determinant;
        let keyframe_x = point.gradient_x * at.focal[0];
        let keyframe_y = point.gradient_y * at.focal[1];
        let ax = scale * (m22 * keyframe_x - m21 * keyframe_y);
        let ay = scale * (m11 * keyframe_y - m12 * keyframe_x);
        Self { a: [ax, ay], n: [nx, ny], inverse_ratio }
    }
}

/// Sums the normal equations of `points` over `image`; the scalar reference of every fast kernel.
pub fn accumulate_reference(
    points: &LevelPoints,
    image: &Image<u16>,
    at: &Evaluation,
) -> NormalEquations {
    let mut sums = NormalEquations::default();
    for point in points.iter() {
        let Some(terms) = point_terms(image, at, &point) else { continue };
        sums.in_view += 1;
        if terms.is_clipped {
            continue;
        }
        let squared = terms.residual * terms.residual;
        let normalized = squared / terms.variance;
        let huber_weight = (at.huber / normalized.sqrt()).min(1.0);
        let weight = f64::from(huber_weight / terms.variance);
        sums.energy += f64::from(huber_weight * (2.0 - huber_weight) * normalized);
        sums.squared_residual += f64::from(squared);
        sums.compared += 1;
        sums.inliers += u32::from(squared / terms.own_variance < at.inlier_gate_squared);
        let residual = f64::from(terms.residual);
        let jacobian = terms.jacobian.map(f64::from);
        for i in 0..UNKNOWNS {
            sums.gradient[i] += weight * jacobian[i] * residual;
            for j in i..UNKNOWNS {
                sums.information[(i, j)] += weight * jacobian[i] * jacobian[j];
            }
        }
    }
    sums.information.fill_lower_triangle_with_upper_triangle();
    sums
}

/// Mean squared optical flow, pixels² of the level, of every `LANES`-th point from the keyframe to its projection; 0 if
/// none is in view.
pub fn mean_squared_flow(points: &LevelPoints, at: &Evaluation) -> f64 {
    let [r0, r1, r2, r3, r4, r5, r6, r7, r8] = at.rotation;
    let [tx, ty, tz] = at.translation;
    let (mut sum, mut count) = (0.0f64, 0u32);
    for (block, first) in points.blocks().iter().zip((0..points.len()).step_by(LANES)) {
        let lane = (points.len() - first - 1).min(LANES / 2);
        let (x, y, d) = (block.ray_x[lane], block.ray_y[lane], block.inverse_depth[lane]);
        let depth_ratio = r6 * x + r7 * y + r8 + tz * d;
        if !(depth_ratio > NEAREST_DEPTH_RATIO) {
            continue;
        }
        let nx = (r0 * x + r1 * y + r2 + tx * d) / depth_ratio;
        let ny = (r3 * x + r4 * y + r5 + ty * d) / depth_ratio;
        let (u, v) = (at.focal[0] * nx + at.centre[0], at.focal[1] * ny + at.centre[1]);
        if !(u >= 0.0 && v >= 0.0 && u < at.upper_bound[0] && v < at.upper_bound[1]) {
            continue;
        }
        let flow_u = f64::from(at.focal[0] * (nx - x));
        let flow_v = f64::from(at.focal[1] * (ny - y));
        sum += flow_u * flow_u + flow_v * flow_v;
        count += 1;
    }
    if count == 0 { 0.0 } else { sum / f64::from(count) }
}
