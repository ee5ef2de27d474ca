//! Residuals of a point of keyframe i in keyframe j: a difference of brightness and one of inverse depth.
//!
//! The similarity is split into the rigid T = (R, t/s), in units of i, and ln s: p_j = s (T p_i). Images do not depend
//! on s, so the photometric residual is that of the tracker. With q = 1/z of T p_i and the pixel p' of its projection
//! ```text
//! r_d = ln(q/s) − ln d_j(p')     ∂r_d/∂δ = −(0, 0, q, n_y, −n_x, 0) − (∇d_j/d_j) ∂p'/∂δ     ∂r_d/∂ln s = −1
//! σ_d² = V_j/d_j² + (∂r_d/∂ln d_i)² V_i/d_i² + model²
//! ```
//! (Engel, Schöps, Cremers 2014, §3.5, with the ratio of the inverse depths in place of their difference: to first
//! order the same over d_j, but symmetric in the two directions. A difference weighted by variances that come from the
//! noisy depths themselves is biased by some of their squared errors, with opposite signs in the two directions.)
//! d_j(p') is taken from the plane through the pixel with depth nearest to p'.

use nalgebra::SVector;

use super::ConstraintParams;
use super::view::{DepthGrid, KeyframeView};
use crate::slam::alignment::points::Point;
use crate::slam::alignment::residual::{Evaluation, PointTerms, point_terms};
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::pose::Brightness;

/// Unknowns: left increment of T (translation, rotation), ln s, brightness a and b.
pub(super) const UNKNOWNS: usize = 9;
/// Index of ln s among them.
pub(super) const SCALE: usize = 6;

/// A derivative by the unknowns.
pub(super) type Row = SVector<f64, UNKNOWNS>;

/// The state of an alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct State {
    /// T: `j_from_i` in units of i.
    pub(super) rigid: SE3,
    /// ln s.
    pub(super) log_scale: f64,
    /// Brightness of j against i.
    pub(super) brightness: Brightness,
}

impl State {
    pub(super) fn of(j_from_i: &Sim3) -> Self {
        let mut rigid = j_from_i.rigid;
        rigid.translation /= j_from_i.scale;
        Self { rigid, log_scale: j_from_i.scale.ln(), brightness: Brightness::default() }
    }

    pub(super) fn j_from_i(&self) -> Sim3 {
        let (mut rigid, scale) = (self.rigid, self.log_scale.exp());
        rigid.translation *= scale;
        Sim3::new(rigid, scale)
    }

    /// The state after a step of the unknowns.
    pub(super) fn moved(&self, step: &Row) -> Self {
        let Brightness { a, b } = self.brightness;
        Self {
            rigid: SE3::exp(&step.fixed_rows::<6>(0).into_owned()) * self.rigid,
            log_scale: self.log_scale + step[SCALE],
            brightness: Brightness { a: a + step[7], b: b + step[8] },
        }
    }

    pub(super) fn is_finite(&self) -> bool {
        self.j_from_i().is_valid() && self.brightness.a.is_finite() && self.brightness.b.is_finite()
    }
}

/// Residual of the depth of one point, and its derivatives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DepthTerms {
    /// r_d.
    pub(super) residual: f64,
    /// σ_d².
    pub(super) variance: f64,
    /// By the left increment of T and ln s.
    pub(super) jacobian: [f64; 7],
    /// ∂r_d/∂ln d_i.
    pub(super) by_log_depth: f64,
    /// d_j(p').
    pub(super) other_inverse_depth: f64,
}

/// One point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Terms {
    pub(super) point: Point,
    pub(super) photometric: PointTerms,
    pub(super) depth: Option<DepthTerms>,
}

impl Terms {
    /// r_p²/σ_p² + r_d²/σ_d².
    pub(super) fn squared(&self) -> f64 {
        let of_depth = self.depth.map_or(0.0, |depth| depth.residual.powi(2) / depth.variance);
        f64::from(self.photometric.residual).powi(2) / f64::from(self.photometric.variance)
            + of_depth
    }

    /// Derivative of r_p by the unknowns.
    pub(super) fn photometric_row(&self) -> Row {
        let j = self.photometric.jacobian.map(f64::from);
        Row::from([j[0], j[1], j[2], j[3], j[4], j[5], 0.0, j[6], j[7]])
    }
}

impl DepthTerms {
    /// Whether the depths cannot be of the same surface. Occluders are always nearer: a weight that merely decreases
    /// would bias the scale, in both directions alike.
    pub(super) fn is_hidden(&self) -> bool {
        /// Standard deviations.
        const SAME_SURFACE: f64 = 3.0;
        self.residual.powi(2) > SAME_SURFACE * SAME_SURFACE * self.variance
    }

    /// Derivative of r_d by the unknowns.
    pub(super) fn row(&self) -> Row {
        let j = self.jacobian;
        Row::from([j[0], j[1], j[2], j[3], j[4], j[5], j[6], 0.0, 0.0])
    }
}

/// One state on one level.
pub(super) struct Level<'a> {
    view: &'a KeyframeView,
    image: &'a Image<u16>,
    depths: &'a DepthGrid,
    level: usize,
    at: Evaluation,
    state: State,
    depth_model_ratio: f64,
}

impl<'a> Level<'a> {
    /// For points of `i` in `j`; `weighed_at` is the state at which (∂r/∂d)² V is evaluated.
    pub(super) fn new(
        [i, j]: [&'a KeyframeView; 2],
        level: usize,
        state: &State,
        weighed_at: &State,
        params: &ConstraintParams,
    ) -> Self {
        let depth_model_ratio = match level == i.levels().start {
            true => params.depth_model_ratio,
            false => params.coarse_depth_ratio,
        };
        let intrinsics = i.reference.intrinsics().at_level(level);
        let (t, brightness) = (&weighed_at.rigid.translation, state.brightness);
        let at =
            Evaluation::new(&intrinsics, level, &state.rigid, brightness, &params.alignment, t);
        let (image, depths) = (j.pyramid.level(level), &j.depths[level]);
        Self { view: i, image, depths, level, at, state: *state, depth_model_ratio }
    }

    /// Terms of all points that project into j and are not clipped there, in their order.
    pub(super) fn terms(&self) -> impl Iterator<Item = Terms> {
        self.view.reference.level(self.level).iter().filter_map(|point| {
            let photometric = point_terms(self.image, &self.at, &point)?;
            if photometric.is_clipped {
                return None;
            }
            Some(Terms { point, photometric, depth: self.depth_terms(&point, &photometric) })
        })
    }

    fn depth_terms(&self, point: &Point, photometric: &PointTerms) -> Option<DepthTerms> {
        let [u, v] = photometric.projection;
        let surface = self.depths.at(u, v)?;
        let r = self.at.rotation.map(f64::from);
        let [tx, ty, tz] = self.at.translation.map(f64::from);
        let (x, y) = (f64::from(point.ray_x), f64::from(point.ray_y));
        let d = f64::from(point.inverse_depth);
        // z of T p_i times d, and n = (x, y)/z there.
        let ratio = r[6] * x + r[7] * y + r[8] + tz * d;
        let q = d / ratio;
        let nx = (r[0] * x + r[1] * y + r[2] + tx * d) / ratio;
        let ny = (r[3] * x + r[4] * y + r[5] + ty * d) / ratio;
        let [fu, fv] = self.at.focal.map(f64::from);
        let [gu, gv] = surface.gradient.map(f64::from);
        let from_pixel =
            gu * f64::from(u - surface.pixel[0]) + gv * f64::from(v - surface.pixel[1]);
        let other = f64::from(surface.inverse_depth) + from_pixel;
        if !(other > 0.0) {
            return None;
        }
        // ∇d_j/d_j by n.
        let (gx, gy) = (gu * fu / other, gv * fv / other);
        let m = gx * nx + gy * ny;
        let jacobian = [
            -q * gx,
            -q * gy,
            -q + q * m,
            -ny + gy + ny * m,
            nx - gx - nx * m,
            nx * -gy + ny * gx,
            -1.0,
        ];
        // ∂ln q/∂ln d = 1 − q t_z, ∂n/∂ln d = q (t − n t_z).
        let by_log_depth = 1.0 - q * tz - q * (gx * tx + gy * ty - m * tz);
        let relative = |variance: f32, inverse_depth: f32| {
            f64::from(variance) / f64::from(inverse_depth).powi(2)
        };
        let variance = relative(surface.variance, surface.inverse_depth)
            + by_log_depth.powi(2) * relative(point.variance, point.inverse_depth)
            + self.depth_model_ratio.powi(2);
        Some(DepthTerms {
            residual: q.ln() - self.state.log_scale - other.ln(),
            variance,
            jacobian,
            by_log_depth,
            other_inverse_depth: other,
        })
    }
}
