//! Residuals of the points in the current frame, and the normal equations of pose, brightness and
//! inverse depths.
//!
//! With x = K⁻¹p of a sample p of the pattern, q = R x + t d and p' = π(q) (R, t: current_from_first):
//!
//! ```text
//! r = I(p') − (eᵃ I₀(p) + b)
//! (α, β) = (g_u f_x, g_v f_y)/q_z      γ = −(α q_x + β q_y)/q_z      j = (α, β, γ)
//! ∂r/∂δ = (d j, q × j)     ∂r/∂d = j·t     ∂r/∂(a, b) = (−eᵃ I₀, −1)
//! ```
//!
//! δ = (translation, rotation), `current_from_first ← exp(δ) current_from_first`. All of it stays finite
//! at d = 0, a point at infinity.

use nalgebra::{SMatrix, SVector};

use crate::slam::depth::map::GradientImage;
use crate::slam::depth::matching::PATTERN;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::pose::Brightness;
use crate::slam::two_frame::points::LevelPatch;
use crate::slam::two_frame::system_kernel::evaluation_kernel;

/// Translation, rotation, a, b.
pub const NUM_UNKNOWNS: usize = 8;

/// Residuals beyond this many grey levels grow linearly (Engel, Koltun, Cremers 2018).
pub const HUBER_GREY: f32 = 9.0;

/// What is estimated.
#[derive(Debug, Clone)]
pub struct State {
    /// Pose, in the unit of 1/d.
    pub current_from_first: SE3,
    /// Brightness of the current frame against the first.
    pub brightness: Brightness,
    /// Inverse depth of each point.
    pub inverse_depths: Vec<f32>,
}

/// One level of the current frame and of the points.
#[derive(Debug, Clone, Copy)]
pub struct LevelView<'a> {
    /// The current frame.
    pub image: &'a GradientImage,
    /// Its intrinsics.
    pub intrinsics: &'a Intrinsics,
    /// The points.
    pub patches: &'a [LevelPatch],
}

/// The part of the normal equations that belongs to one point.
#[derive(Debug, Clone, Copy)]
pub struct PointSystem {
    /// Σ w ∂r/∂(pose, brightness) ∂r/∂d.
    pub mixed: [f32; NUM_UNKNOWNS],
    /// Σ w (∂r/∂d)².
    pub information: f32,
    /// Σ w r ∂r/∂d.
    pub gradient: f32,
    /// Σ ρ(r), weighted.
    pub energy: f32,
    /// Σ of the weights of the samples, Huber's not included.
    pub weight: f32,
    /// Speed of the projection, pixels of the level a unit of inverse depth, squared.
    pub squared_speed: f32,
    /// Whether the whole pattern falls into the current frame.
    pub visible: bool,
}

/// Normal equations at one state.
#[derive(Debug, Clone)]
pub struct System {
    /// Each point's part.
    pub points: Vec<PointSystem>,
    /// JᵀWJ of pose and brightness.
    pub hessian: SMatrix<f64, NUM_UNKNOWNS, NUM_UNKNOWNS>,
    /// JᵀWr of pose and brightness.
    pub gradient: SVector<f64, NUM_UNKNOWNS>,
    /// Energy of all points; one out of view costs as much as a bad match, so that nothing is gained by
    /// looking away.
    pub energy: f64,
    /// Points in view.
    pub num_visible: usize,
}

impl Default for System {
    fn default() -> Self {
        Self {
            points: Vec::new(),
            hessian: SMatrix::zeros(),
            gradient: SVector::zeros(),
            energy: 0.0,
            num_visible: 0,
        }
    }
}

/// Energy of a point out of view: every sample at the end of Huber's parabola.
const HIDDEN_ENERGY: f32 = PATTERN.len() as f32 * HUBER_GREY * HUBER_GREY;

/// Pose and camera of one evaluation, in f32 for the samples.
struct Geometry {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    gain: f32,
    offset: f32,
}

impl Geometry {
    fn new(intrinsics: &Intrinsics, state: &State) -> Self {
        let rotation = state.current_from_first.rotation_matrix();
        let translation = state.current_from_first.translation;
        Self {
            rotation: [0, 1, 2].map(|r| [0, 1, 2].map(|c| rotation[(r, c)] as f32)),
            translation: [0, 1, 2].map(|r| translation[r] as f32),
            fx: intrinsics.fx as f32,
            fy: intrinsics.fy as f32,
            cx: intrinsics.cx as f32,
            cy: intrinsics.cy as f32,
            gain: state.brightness.a.exp() as f32,
            offset: state.brightness.b as f32,
        }
    }
}

impl System {
    /// Evaluates every point at `state`. Sums go in the order of the points.
    pub fn evaluate(&mut self, level: &LevelView<'_>, state: &State) {
        evaluation_kernel()(self, level, state);
    }

    #[inline(always)]
    pub(super) fn evaluate_points(&mut self, level: &LevelView<'_>, state: &State) {
        let geometry = Geometry::new(level.intrinsics, state);
        self.points.clear();
        self.hessian.fill(0.0);
        self.gradient.fill(0.0);
        self.energy = 0.0;
        self.num_visible = 0;
        for (patch, &d) in level.patches.iter().zip(&state.inverse_depths) {
            let mut pose = PoseSums::default();
            let point = evaluate_point(level.image, &geometry, patch, d, &mut pose);
            self.energy += f64::from(point.energy);
            self.num_visible += usize::from(point.visible);
            if point.visible {
                pose.add_to(&mut self.hessian, &mut self.gradient);
            }
            self.points.push(point);
        }
        self.hessian.fill_upper_triangle_with_lower_triangle();
    }
}

/// Sums of one point for pose and brightness; the lower triangle of the matrix.
#[derive(Default)]
struct PoseSums {
    hessian: [[f32; NUM_UNKNOWNS]; NUM_UNKNOWNS],
    gradient: [f32; NUM_UNKNOWNS],
}

impl PoseSums {
    #[inline(always)]
    fn add(&mut self, jacobian: &[f32; NUM_UNKNOWNS], weight: f32, residual: f32) {
        for r in 0..NUM_UNKNOWNS {
            let weighted = weight * jacobian[r];
            self.gradient[r] += weighted * residual;
            for c in 0..NUM_UNKNOWNS {
                self.hessian[r][c] += weighted * jacobian[c];
            }
        }
    }

    fn add_to(
        &self,
        hessian: &mut SMatrix<f64, NUM_UNKNOWNS, NUM_UNKNOWNS>,
        gradient: &mut SVector<f64, NUM_UNKNOWNS>,
    ) {
        for r in 0..NUM_UNKNOWNS {
            gradient[r] += f64::from(self.gradient[r]);
            for c in 0..=r {
                hessian[(r, c)] += f64::from(self.hessian[r][c]);
            }
        }
    }
}

/// The residuals of one point with their derivatives.
#[inline(always)]
fn evaluate_point(
    image: &GradientImage,
    geometry: &Geometry,
    patch: &LevelPatch,
    d: f32,
    pose: &mut PoseSums,
) -> PointSystem {
    /// Depth ratio below which a point counts as behind the camera.
    const MIN_DEPTH_RATIO: f32 = 0.05;
    let weight_sum: f32 = patch.weights.iter().sum();
    let hidden = PointSystem {
        mixed: [0.0; NUM_UNKNOWNS],
        information: 0.0,
        gradient: 0.0,
        energy: if weight_sum > 0.0 { HIDDEN_ENERGY } else { 0.0 },
        weight: 0.0,
        squared_speed: 0.0,
        visible: false,
    };
    if !(weight_sum > 0.0) {
        return hidden;
    }
    let mut point = PointSystem { energy: 0.0, weight: weight_sum, visible: true, ..hidden };
    let (m, t) = (&geometry.rotation, &geometry.translation);
    for (k, (du, dv)) in PATTERN.iter().enumerate() {
        let x = (patch.u + *du as f32 - geometry.cx) / geometry.fx;
        let y = (patch.v + *dv as f32 - geometry.cy) / geometry.fy;
        let q = [0, 1, 2].map(|r| m[r][0] * x + m[r][1] * y + m[r][2] + t[r] * d);
        if !(q[2] > MIN_DEPTH_RATIO) {
            return hidden;
        }
        let inverse_z = 1.0 / q[2];
        let u = geometry.fx * q[0] * inverse_z + geometry.cx;
        let v = geometry.fy * q[1] * inverse_z + geometry.cy;
        let Some([brightness, gradient_u, gradient_v]) = sample(image, u, v) else { return hidden };
        let residual = brightness - (geometry.gain * patch.intensities[k] + geometry.offset);
        let huber = HUBER_GREY / residual.abs().max(HUBER_GREY);
        let cost = huber * (2.0 - huber) * residual * residual;
        let alpha = gradient_u * geometry.fx * inverse_z;
        let beta = gradient_v * geometry.fy * inverse_z;
        let gamma = -(alpha * q[0] + beta * q[1]) * inverse_z;
        let jacobian = [
            d * alpha,
            d * beta,
            d * gamma,
            q[1] * gamma - q[2] * beta,
            q[2] * alpha - q[0] * gamma,
            q[0] * beta - q[1] * alpha,
            -geometry.gain * patch.intensities[k],
            -1.0,
        ];
        let by_depth = alpha * t[0] + beta * t[1] + gamma * t[2];
        let weight = huber * patch.weights[k];
        pose.add(&jacobian, weight, residual);
        for (sum, by_pose) in point.mixed.iter_mut().zip(&jacobian) {
            *sum += weight * by_depth * by_pose;
        }
        point.information += weight * by_depth * by_depth;
        point.gradient += weight * by_depth * residual;
        point.energy += patch.weights[k] * cost;
        if (*du, *dv) == (0, 0) {
            let speed_u = geometry.fx * (t[0] - q[0] * inverse_z * t[2]) * inverse_z;
            let speed_v = geometry.fy * (t[1] - q[1] * inverse_z * t[2]) * inverse_z;
            point.squared_speed = speed_u * speed_u + speed_v * speed_v;
        }
    }
    point
}

/// Brightness and gradient between pixels; `None` outside or for NaN.
#[inline(always)]
fn sample(image: &GradientImage, u: f32, v: f32) -> Option<[f32; 3]> {
    let (width, height) = (image.width(), image.height());
    // One pixel inside the border, where the central difference is defined.
    if !(u >= 1.0 && v >= 1.0 && u < (width - 2) as f32 && v < (height - 2) as f32) {
        return None;
    }
    let (column, row) = (u as usize, v as usize);
    let (fu, fv) = (u - column as f32, v - row as f32);
    let i = row * width + column;
    Some([&image.intensity, &image.gradient_u, &image.gradient_v].map(|plane| {
        let (upper, lower) = (&plane.pixels()[i..i + 2], &plane.pixels()[i + width..i + width + 2]);
        let above = upper[0] + fu * (upper[1] - upper[0]);
        let below = lower[0] + fu * (lower[1] - lower[0]);
        above + fv * (below - above)
    }))
}
