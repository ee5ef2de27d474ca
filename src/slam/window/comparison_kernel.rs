//! One point compared with one keyframe: eight residuals, their derivatives and their sums.
//!
//! `X' = R X + t` with (R, t) = `observer_from_host`, X at the host's pixel and the point's inverse depth d; with the
//! image of the observer I and its gradient g at π(X'):
//!
//! `r_k = I(π(X'_k)) − m h_k`, `h_k` the host's samples over their mean, `m` the mean of the observer's: every pattern
//! has a gain of its own, so that vignette, exposure and response need no model. It costs one degree of freedom of
//! eight. `j = (g_x f_x/z', g_y f_y/z', −(g_x f_x x' + g_y f_y y')/z'²)`, `∂r/∂δ = (j, X'×j)` for the observer's pose
//! (left increment), `∂r/∂d = j·t/d`; then `J_k ← J_k − h_k · mean(J)`. X' is scaled by d throughout, so that points at
//! infinity are finite.
//!
//! The eight samples of the pattern are the lanes. One source for all processors: no operation is fused or reordered,
//! so every version gives the same bits.

use crate::slam::depth::matching::PATTERN;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::quads::QuadImage;
#[cfg(target_arch = "x86_64")]
use crate::slam::image::quads_kernel::Avx2Sampler;
use crate::slam::image::quads_kernel::{PortableSampler, Sampler};

/// Samples of a pattern.
pub const SAMPLES: usize = PATTERN.len();
/// Parameters of a pose.
pub const POSE: usize = 6;
/// Entries of the upper triangle of a pose's normal equations.
pub const TRIANGLE: usize = POSE * (POSE + 1) / 2;
/// Smallest z'/z of a point: nearer than a twentieth of its distance it is not seen as it was.
const MIN_DEPTH_RATIO: f32 = 0.05;
/// Pixels at the border of an observer that are not read.
const BORDER_PX: f32 = 1.0;

type Lanes = [f32; SAMPLES];

/// What a point looks like in its host, at one level.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Look {
    /// Samples over their mean.
    pub shape: Lanes,
    /// Weight by the gradient: sub-pixel errors show there. All 0 where the pattern leaves the image or is dark.
    pub weight: Lanes,
}

impl Look {
    /// Whether there is a pattern at all.
    pub fn is_whole(&self) -> bool {
        self.weight[0] > 0.0
    }
}

/// How residuals count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Robustness {
    /// Residuals beyond grow linearly, grey levels.
    pub huber_grey: f32,
    /// Energy above which a comparison is of something else.
    pub most_energy: f32,
}

/// Where an observer stands from a host, at one level.
#[derive(Debug, Clone, Copy)]
pub struct Pair {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
    /// R times what the pattern's offsets add to the ray.
    offsets: [Lanes; 3],
    focal: [f32; 2],
    centre: [f32; 2],
    /// Largest position that is read.
    last: [f32; 2],
}

/// Sums of a comparison that belong to its point.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PointSums {
    /// Σ w J ∂r/∂d of the observer's pose.
    pub mixed: [f32; POSE],
    /// Σ w (∂r/∂d)².
    pub depth: f32,
    /// Σ w r ∂r/∂d.
    pub depth_right: f32,
}

/// Sums of the comparisons of a host with an observer, by lane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairSums {
    /// Σ w J Jᵀ of the observer's pose, rows of the upper triangle.
    pub pose: [Lanes; TRIANGLE],
    /// Σ w J r.
    pub right: [Lanes; POSE],
}

impl Default for PairSums {
    fn default() -> Self {
        Self { pose: [[0.0; SAMPLES]; TRIANGLE], right: [[0.0; SAMPLES]; POSE] }
    }
}

/// What a comparison came to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Seen {
    /// A sample is outside the image or behind the camera.
    Outside,
    /// Something else is seen: it counts the most that it may.
    Other,
    /// It counts, with this robust cost, grey levels².
    Same(f32, PointSums),
}

impl Pair {
    /// Of images of `camera`, which is that of the level.
    pub fn new(observer_from_host: &SE3, camera: &Intrinsics) -> Self {
        let of = observer_from_host.rotation_matrix();
        let rotation = [0, 1, 2].map(|row| [0, 1, 2].map(|column| of[(row, column)] as f32));
        let translation = [0, 1, 2].map(|row| observer_from_host.translation[row] as f32);
        let Intrinsics { fx, fy, cx, cy, width, height } = *camera;
        let offsets = [0, 1, 2].map(|row| {
            PATTERN.map(|(du, dv)| {
                (of[(row, 0)] * f64::from(du) / fx + of[(row, 1)] * f64::from(dv) / fy) as f32
            })
        });
        let last = |side: usize| side as f32 - 2.0 - BORDER_PX;
        Self {
            rotation,
            translation,
            offsets,
            focal: [fx as f32, fy as f32],
            centre: [cx as f32, cy as f32],
            last: [last(width), last(height)],
        }
    }
}

/// A version of the comparison: of the image, where the observer stands, the point's look, ray and inverse depth.
pub type Kernel = fn(&QuadImage, &Pair, &Look, [f32; 2], f32, &Robustness, &mut PairSums) -> Seen;

/// The best version for this processor.
pub fn kernel() -> Kernel {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        let has_avx512 = std::arch::is_x86_feature_detected!("avx512f")
            && std::arch::is_x86_feature_detected!("avx512vl")
            && std::arch::is_x86_feature_detected!("avx512bw")
            && std::arch::is_x86_feature_detected!("avx512dq");
        if has_avx512 {
            return |image, pair, look, ray, depth, robustness, sums| {
                // SAFETY: the processor has these, as was just asked.
                unsafe { compare_avx512(image, pair, look, ray, depth, robustness, sums) }
            };
        }
        return |image, pair, look, ray, depth, robustness, sums| {
            // SAFETY: the processor has AVX2, as was just asked.
            unsafe { compare_avx2(image, pair, look, ray, depth, robustness, sums) }
        };
    }
    compare_portable
}

/// The explanation of the others.
pub fn compare_portable(
    image: &QuadImage,
    pair: &Pair,
    look: &Look,
    ray: [f32; 2],
    inverse_depth: f32,
    robustness: &Robustness,
    sums: &mut PairSums,
) -> Seen {
    compare(PortableSampler, image, pair, look, ray, inverse_depth, robustness, sums)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn compare_avx2(
    image: &QuadImage,
    pair: &Pair,
    look: &Look,
    ray: [f32; 2],
    inverse_depth: f32,
    robustness: &Robustness,
    sums: &mut PairSums,
) -> Seen {
    // SAFETY: this function asks for AVX2.
    let sampler = unsafe { Avx2Sampler::new() };
    compare(sampler, image, pair, look, ray, inverse_depth, robustness, sums)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512vl,avx512bw,avx512dq")]
fn compare_avx512(
    image: &QuadImage,
    pair: &Pair,
    look: &Look,
    ray: [f32; 2],
    inverse_depth: f32,
    robustness: &Robustness,
    sums: &mut PairSums,
) -> Seen {
    // SAFETY: this function asks for AVX2.
    let sampler = unsafe { Avx2Sampler::new() };
    compare(sampler, image, pair, look, ray, inverse_depth, robustness, sums)
}

/// Compares a point, whose ray at depth 1 and inverse depth in the host these are, and adds to the sums of the pair
/// where it counts.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "one call a pattern; a struct would be made for each")]
fn compare<S: Sampler>(
    sampler: S,
    image: &QuadImage,
    pair: &Pair,
    look: &Look,
    ray: [f32; 2],
    inverse_depth: f32,
    robustness: &Robustness,
    sums: &mut PairSums,
) -> Seen {
    let centre: [f32; 3] = std::array::from_fn(|row| {
        let of = &pair.rotation[row];
        of[0] * ray[0] + of[1] * ray[1] + of[2] + inverse_depth * pair.translation[row]
    });
    // X' d, and where it is seen.
    let scaled: [Lanes; 3] =
        std::array::from_fn(|row| std::array::from_fn(|k| centre[row] + pair.offsets[row][k]));
    let nearness: Lanes = std::array::from_fn(|k| 1.0 / scaled[2][k]);
    let x: Lanes = std::array::from_fn(|k| scaled[0][k] * nearness[k]);
    let y: Lanes = std::array::from_fn(|k| scaled[1][k] * nearness[k]);
    let u: Lanes = std::array::from_fn(|k| pair.focal[0] * x[k] + pair.centre[0]);
    let v: Lanes = std::array::from_fn(|k| pair.focal[1] * y[k] + pair.centre[1]);
    let is_inside = (0..SAMPLES).fold(true, |inside, k| {
        inside
            & (scaled[2][k] >= MIN_DEPTH_RATIO)
            & (u[k] >= BORDER_PX)
            & (u[k] <= pair.last[0])
            & (v[k] >= BORDER_PX)
            & (v[k] <= pair.last[1])
    });
    if !is_inside {
        return Seen::Outside;
    }
    let corners = sampler.corners(image, &u, &v);
    let mut observed = [0.0; SAMPLES];
    let mut gradient = [[0.0; SAMPLES]; 2];
    for k in 0..SAMPLES {
        let upper = corners.upper_right[k] - corners.upper_left[k];
        let lower = corners.lower_right[k] - corners.lower_left[k];
        let top = corners.upper_left[k] + corners.du[k] * upper;
        let bottom = corners.lower_left[k] + corners.du[k] * lower;
        observed[k] = top + corners.dv[k] * (bottom - top);
        gradient[0][k] = upper + corners.dv[k] * (lower - upper);
        gradient[1][k] = bottom - top;
    }
    let observed_mean = mean(&observed);
    let residual: Lanes = std::array::from_fn(|k| observed[k] - observed_mean * look.shape[k]);
    let mut weight = [0.0; SAMPLES];
    let mut cost = [0.0; SAMPLES];
    for k in 0..SAMPLES {
        let huber = (robustness.huber_grey / residual[k].abs().max(robustness.huber_grey)).min(1.0);
        weight[k] = look.weight[k] * huber;
        cost[k] = weight[k] * (2.0 - huber) * residual[k] * residual[k];
    }
    let energy = sum(&cost);
    if !(energy <= robustness.most_energy) {
        return Seen::Other;
    }
    // j/d.
    let along_x: Lanes = std::array::from_fn(|k| gradient[0][k] * pair.focal[0] * nearness[k]);
    let along_y: Lanes = std::array::from_fn(|k| gradient[1][k] * pair.focal[1] * nearness[k]);
    let along_z: Lanes = std::array::from_fn(|k| -(along_x[k] * x[k] + along_y[k] * y[k]));
    let mut jacobian = [[0.0; SAMPLES]; POSE + 1];
    for k in 0..SAMPLES {
        jacobian[0][k] = inverse_depth * along_x[k];
        jacobian[1][k] = inverse_depth * along_y[k];
        jacobian[2][k] = inverse_depth * along_z[k];
        jacobian[3][k] = scaled[1][k] * along_z[k] - scaled[2][k] * along_y[k];
        jacobian[4][k] = scaled[2][k] * along_x[k] - scaled[0][k] * along_z[k];
        jacobian[5][k] = scaled[0][k] * along_y[k] - scaled[1][k] * along_x[k];
        jacobian[6][k] = along_x[k] * pair.translation[0]
            + along_y[k] * pair.translation[1]
            + along_z[k] * pair.translation[2];
    }
    for row in &mut jacobian {
        let common = mean(row);
        for k in 0..SAMPLES {
            row[k] -= look.shape[k] * common;
        }
    }
    let mut entry = 0;
    for a in 0..POSE {
        let weighted: Lanes = std::array::from_fn(|k| weight[k] * jacobian[a][k]);
        for row in &jacobian[a..POSE] {
            for k in 0..SAMPLES {
                sums.pose[entry][k] += weighted[k] * row[k];
            }
            entry += 1;
        }
        for k in 0..SAMPLES {
            sums.right[a][k] += weighted[k] * residual[k];
        }
    }
    let weighted: Lanes = std::array::from_fn(|k| weight[k] * jacobian[POSE][k]);
    let product = |row: &Lanes| sum(&std::array::from_fn(|k| weighted[k] * row[k]));
    let mixed = std::array::from_fn(|a| product(&jacobian[a]));
    let depth = product(&jacobian[POSE]);
    Seen::Same(energy, PointSums { mixed, depth, depth_right: product(&residual) })
}

/// In an order that vectors add in.
#[inline(always)]
pub fn sum(of: &Lanes) -> f32 {
    ((of[0] + of[4]) + (of[2] + of[6])) + ((of[1] + of[5]) + (of[3] + of[7]))
}

#[inline(always)]
fn mean(of: &Lanes) -> f32 {
    sum(of) * (1.0 / SAMPLES as f32)
}
