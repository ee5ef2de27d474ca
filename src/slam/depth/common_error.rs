//! How errors shared by all depth of a keyframe arise from the errors of poses, and how they propagate.
//!
//! A frame's pose error ξ is common to all its pixels. A depth matched in it errs by the amount that cancels the
//! residual, δd/d = −J·ξ/q with q = (∂r/∂d) d, regardless of the pixel's noise (Schmidt–Kalman: ξ is considered, not
//! estimated). The filter adopts the share k of it, so that the common errors m of the keyframe (`slam::modes`) become
//! ```text
//! m⁺ = (I − K) m + C ξ      K = Φ⁻¹ Σ ω k φφᵀ      C = −Φ⁻¹ Σ ω k φ Jᵀ/q      Φ = Σ ω φφᵀ
//! ```
//! On the next keyframe, at a pose with error ξ, with κ = r_z z/z' of the propagation,
//! ```text
//! m' = Φ'⁻¹ Σ ω φ' (κ φᵀm − ξ_tz d' − ξ_ωx y' + ξ_ωy x')
//! ```
//! and ξ itself depends on m, since the pose was estimated on this depth: ξ = D m + n, D = −(Σ w J Jᵀ)⁻¹ Σ w J q φᵀ.
//! φ has the constant 1 in addition to the modes, the unit of the keyframe; it is fitted with them and then dropped: an
//! error of the unit causes no error of another mode.

use nalgebra::{Matrix3, Matrix4, Matrix6, SMatrix, Vector3, Vector4, Vector6};

use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::noise::ImageNoise;
use crate::slam::modes::NUM_MODES;

/// A matrix of modes by pose unknowns.
pub type ModesByPose = SMatrix<f64, NUM_MODES, 6>;
/// A matrix of pose unknowns by modes.
pub type PoseByModes = SMatrix<f64, 6, NUM_MODES>;

/// Maximum number of sampled hypotheses: three modes and a pose need hundreds.
const MAX_SAMPLES: usize = 1500;
/// Step between sampled rows.
const ROW_STEP: usize = 5;
/// Relative standard deviation of depth below which points have equal weight: surfaces are not flat to a pixel.
const MIN_RELATIVE_STD_DEV: f64 = 0.02;
/// Pyramid level on which the alignment of frames ends.
const ALIGNED_LEVEL: usize = 1;
/// Variance of the difference of two images there, grey levels²: the effect of a pose on it weights all points alike.
const INTENSITY_VARIANCE: f64 = 2.0 * ImageNoise::DEFAULT.variance(ALIGNED_LEVEL) as f64;
/// Least depth of a point in the frame, as a share of its depth in the keyframe.
const NEAREST_DEPTH_RATIO: f64 = 0.1;
/// cos² between gradient and epipolar line below which a pixel is not matched.
const MIN_SQUARED_COSINE: f64 = 0.02;

/// A hypothesis before a frame was observed.
#[derive(Debug, Clone, Copy)]
struct Sample {
    /// Index in the map, row by row.
    index: usize,
    /// The pixel's ray.
    ray: Vector3<f64>,
    /// Gradient of the keyframe, grey levels per unit of the ray's coordinates.
    gradient: [f64; 2],
    before: Hypothesis,
}

/// A representative sample of the hypotheses of a keyframe.
#[derive(Debug, Clone, Default)]
pub struct SampledDepth {
    samples: Vec<Sample>,
}

/// Dependence of the modes after a frame on the modes before it and on the error of its pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModeResponse {
    /// I − K, or the propagation to another keyframe.
    pub on_modes: Matrix3<f64>,
    /// C.
    pub on_pose: ModesByPose,
}

/// The contribution of a sample at one pose.
struct Terms {
    /// The point in the frame's camera over its inverse depth in the keyframe: R x + t d.
    warped: Vector3<f64>,
    jacobian: Vector6<f64>,
    /// (∂r/∂d) d.
    q: f64,
    /// (1, X, Y, ln d).
    phi: Vector4<f64>,
    /// w, the weight of the residual in the alignment.
    weight: f64,
    /// ω, the weight of the point in the fit of the modes.
    fit_weight: f64,
    /// Whether gradient and epipolar line determine the depth.
    is_observable: bool,
}

impl Sample {
    fn terms(&self, current_from_keyframe: &SE3) -> Option<Terms> {
        let t = &current_from_keyframe.translation;
        let d = f64::from(self.before.smoothed);
        let rotated = current_from_keyframe.rotation * self.ray;
        let warped = rotated + t * d;
        if !(d > 0.0 && warped.z > NEAREST_DEPTH_RATIO) {
            return None;
        }
        let n = warped / warped.z;
        // The rotation turns the gradient; stretching by the warp does not matter, since J and q share it.
        let turned =
            current_from_keyframe.rotation * Vector3::new(self.gradient[0], self.gradient[1], 0.0);
        let (ax, ay) = (turned.x, turned.y);
        let m = ax * n.x + ay * n.y;
        let s = d / warped.z;
        let jacobian = Vector6::new(
            s * ax,
            s * ay,
            -s * m,
            -(ay + n.y * m),
            ax + n.x * m,
            n.x * ay - n.y * ax,
        );
        let along = jacobian.fixed_rows::<3>(0).into_owned();
        let q = along.dot(t);
        // Displacement of the projection with depth, times the gradient: the largest possible q.
        let flow = [t.x - n.x * t.z, t.y - n.y * t.z].map(|x| s * x);
        let best = (flow[0] * flow[0] + flow[1] * flow[1]) * (ax * ax + ay * ay);
        let relative_variance = f64::from(self.before.variance) / (d * d);
        Some(Terms {
            warped,
            jacobian,
            q,
            phi: Vector4::new(1.0, self.ray.x, self.ray.y, d.ln()),
            weight: 1.0 / (INTENSITY_VARIANCE + q * q * relative_variance),
            fit_weight: fit_weight(relative_variance),
            is_observable: q * q > MIN_SQUARED_COSINE * best,
        })
    }
}

fn fit_weight(relative_variance: f64) -> f64 {
    1.0 / (relative_variance + MIN_RELATIVE_STD_DEV * MIN_RELATIVE_STD_DEV)
}

impl SampledDepth {
    /// Samples the current state of `map`.
    pub fn take(&mut self, map: &DepthMap, intrinsics: &Intrinsics) {
        self.samples.clear();
        let known = map.num_hypotheses();
        let step = known.div_ceil(ROW_STEP * MAX_SAMPLES).max(1);
        let image = &map.image;
        let (mut count, mut memory) = (0, Vec::new());
        for v in (ROW_STEP / 2..image.height()).step_by(ROW_STEP) {
            let row = map.hypotheses.row(v);
            for u in map.hypotheses.known_columns(v, &mut memory).iter().map(|&u| usize::from(u)) {
                count += 1;
                if count % step != 0 {
                    continue;
                }
                let ray = intrinsics.ray(u as f64, v as f64);
                let index = v * image.width() + u;
                let (gu, gv) = image.gradient(index);
                let gradient = [f64::from(gu) * intrinsics.fx, f64::from(gv) * intrinsics.fy];
                self.samples.push(Sample { index, ray, gradient, before: row[u] });
            }
        }
    }

    /// Converts to a unit of depth that is `factor` times as long.
    pub fn rescale(&mut self, factor: f32) {
        for sample in &mut self.samples {
            sample.before.inverse_depth *= factor;
            sample.before.smoothed *= factor;
            sample.before.variance *= factor * factor;
        }
    }

    /// D: how the pose of a frame that was aligned to this depth depends on its modes; `None` if the points do not
    /// determine a pose.
    pub fn d_pose_d_modes(&self, current_from_keyframe: &SE3) -> Option<PoseByModes> {
        let mut information = Matrix6::zeros();
        let mut mixed = SMatrix::<f64, 6, 4>::zeros();
        for terms in self.samples.iter().filter_map(|s| s.terms(current_from_keyframe)) {
            information.ger(terms.weight, &terms.jacobian, &terms.jacobian, 1.0);
            mixed.ger(terms.weight * terms.q, &terms.jacobian, &terms.phi, 1.0);
        }
        let moved = -information.cholesky()?.solve(&mixed);
        let moved = moved.fixed_columns::<NUM_MODES>(1).into_owned();
        moved.iter().all(|x| x.is_finite()).then_some(moved)
    }

    /// The effect of the observation of a frame on the modes: `after` is the map since [`SampledDepth::take`]. `None`
    /// if nothing was observed.
    pub fn response_to_observation(
        &self,
        after: &DepthMap,
        current_from_keyframe: &SE3,
    ) -> Option<ModeResponse> {
        let (mut fit, mut gained) = (Matrix4::zeros(), Matrix4::zeros());
        let mut by_pose = SMatrix::<f64, 4, 6>::zeros();
        for sample in &self.samples {
            let Some(terms) = sample.terms(current_from_keyframe) else { continue };
            let Some(now) = after.hypotheses.pixels().get(sample.index) else { continue };
            let share = gain(&sample.before, now);
            fit.ger(terms.fit_weight, &terms.phi, &terms.phi, 1.0);
            if share > 0.0 && terms.is_observable {
                let weight = terms.fit_weight * share;
                gained.ger(weight, &terms.phi, &terms.phi, 1.0);
                by_pose.ger(-weight / terms.q, &terms.phi, &terms.jacobian, 1.0);
            }
        }
        if gained[(0, 0)] == 0.0 {
            return None;
        }
        let factors = fit.cholesky()?;
        let on_modes = Matrix4::identity() - factors.solve(&gained);
        ModeResponse::of(&on_modes, &factors.solve(&by_pose))
    }

    /// The modes of depth that was estimated from one frame at this pose alone.
    pub fn modes_by_pose(&self, current_from_keyframe: &SE3) -> Option<ModesByPose> {
        let mut fit = Matrix4::zeros();
        let mut by_pose = SMatrix::<f64, 4, 6>::zeros();
        let terms = self.samples.iter().filter_map(|s| s.terms(current_from_keyframe));
        for terms in terms.filter(|terms| terms.is_observable) {
            fit.ger(terms.fit_weight, &terms.phi, &terms.phi, 1.0);
            by_pose.ger(-terms.fit_weight / terms.q, &terms.phi, &terms.jacobian, 1.0);
        }
        let by_pose = fit.cholesky()?.solve(&by_pose);
        ModeResponse::of(&Matrix4::zeros(), &by_pose).map(|response| response.on_pose)
    }

    /// The propagation of the modes to a keyframe at this pose.
    pub fn response_to_propagation(
        &self,
        current_from_keyframe: &SE3,
        intrinsics: &Intrinsics,
    ) -> Option<ModeResponse> {
        let (mut fit, mut by_modes) = (Matrix4::zeros(), Matrix4::zeros());
        let mut by_pose = SMatrix::<f64, 4, 6>::zeros();
        for sample in &self.samples {
            let Some(terms) = sample.terms(current_from_keyframe) else { continue };
            let (x, y) = (terms.warped.x / terms.warped.z, terms.warped.y / terms.warped.z);
            if !is_inside(x, y, intrinsics) {
                continue;
            }
            // z/z' of the point, and its inverse depth in the new keyframe.
            let depth_ratio = 1.0 / terms.warped.z;
            let d = f64::from(sample.before.smoothed) * depth_ratio;
            let phi = Vector4::new(1.0, x, y, d.ln());
            let t_z = current_from_keyframe.translation.z;
            let kept = (terms.warped.z - t_z * f64::from(sample.before.smoothed)) * depth_ratio;
            let by_twist = Vector6::new(0.0, 0.0, -d, -y, x, 0.0);
            fit.ger(terms.fit_weight, &phi, &phi, 1.0);
            by_modes.ger(terms.fit_weight * kept, &phi, &terms.phi, 1.0);
            by_pose.ger(terms.fit_weight, &phi, &by_twist, 1.0);
        }
        let factors = fit.cholesky()?;
        ModeResponse::of(&factors.solve(&by_modes), &factors.solve(&by_pose))
    }
}

impl ModeResponse {
    /// Drops the row and column of the unit; `None` for non-finite values.
    fn of(on_modes: &Matrix4<f64>, on_pose: &SMatrix<f64, 4, 6>) -> Option<Self> {
        let on_modes = on_modes.fixed_view::<NUM_MODES, NUM_MODES>(1, 1).into_owned();
        let on_pose = on_pose.fixed_rows::<NUM_MODES>(1).into_owned();
        let is_finite = on_modes.iter().chain(on_pose.iter()).all(|x: &f64| x.is_finite());
        is_finite.then_some(Self { on_modes, on_pose })
    }
}

fn is_inside(x: f64, y: f64, camera: &Intrinsics) -> bool {
    let (u, v) = (camera.fx * x + camera.cx, camera.fy * y + camera.cy);
    u >= 0.0 && v >= 0.0 && u < camera.width as f64 && v < camera.height as f64
}

/// Share of a match that a hypothesis has adopted; 0 if it was not fused. Fusion moves the smoothed value and the
/// hypothesis's own towards the match by the same share, so that their difference shrinks by it. Where they are equal,
/// the reduction in variance stands in: less than the share, since the error that all matches have remains.
fn gain(before: &Hypothesis, after: &Hypothesis) -> f64 {
    if !after.is_some() || after.inverse_depth == before.inverse_depth {
        return 0.0;
    }
    let difference = before.smoothed - before.inverse_depth;
    let kept = if difference == 0.0 {
        after.variance / before.variance
    } else {
        (after.smoothed - after.inverse_depth) / difference
    };
    (1.0 - f64::from(kept)).clamp(0.0, 1.0)
}

/// Joint covariance of a keyframe's modes and the pose error of the current frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointCovariance {
    /// P.
    pub modes: Matrix3<f64>,
    /// Covariance of modes and pose error.
    mixed: ModesByPose,
    /// Covariance of the pose error.
    pose: Matrix6<f64>,
}

impl JointCovariance {
    /// The covariance for a frame that was aligned to depth with these modes: ξ = D m + n.
    pub fn of_aligned(modes: &Matrix3<f64>, follows: &PoseByModes, noise: &Matrix6<f64>) -> Self {
        let mixed = modes * follows.transpose();
        Self { modes: *modes, mixed, pose: follows * mixed + noise }
    }

    /// The covariance of a start: the modes come from the pose error of its second frame alone.
    pub fn of_start(by_pose: &ModesByPose, pose: &Matrix6<f64>) -> Self {
        let mixed = by_pose * pose;
        Self { modes: mixed * by_pose.transpose(), mixed, pose: *pose }
    }

    /// The same in a unit that is `factor` times as long.
    pub fn rescaled(mut self, factor: f64) -> Self {
        let shrunk = 1.0 / factor;
        self.mixed.columns_mut(0, 3).scale_mut(shrunk);
        self.pose.rows_mut(0, 3).scale_mut(shrunk);
        self.pose.columns_mut(0, 3).scale_mut(shrunk);
        self
    }

    /// Propagates the covariance through a response to modes and pose.
    pub fn after(&self, response: &ModeResponse) -> Self {
        let ModeResponse { on_modes, on_pose } = response;
        let crossed = on_modes * self.mixed * on_pose.transpose();
        let modes = on_modes * self.modes * on_modes.transpose()
            + crossed
            + crossed.transpose()
            + on_pose * self.pose * on_pose.transpose();
        Self {
            modes: 0.5 * (modes + modes.transpose()),
            mixed: on_modes * self.mixed + on_pose * self.pose,
            pose: self.pose,
        }
    }
}

/// Largest standard deviation of the rotation of a pose (translation, rotation), radians.
pub fn rotation_std_dev(covariance: &Matrix6<f64>) -> f64 {
    let rotation = covariance.fixed_view::<3, 3>(3, 3).into_owned();
    let largest = rotation.symmetric_eigenvalues().max();
    // Rounding may make it negative; NaN stays NaN.
    if largest < 0.0 { 0.0 } else { largest.sqrt() }
}

#[cfg(test)]
mod tests;
