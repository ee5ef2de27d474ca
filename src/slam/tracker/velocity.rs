//! Velocity of the camera: the step from the previous pose, and its covariance.
//!
//! ```text
//! v = log(T₀⁻¹ T₁) / Δt          T = world_from_camera of the last two frames that were tracked, Δt between their stamps
//! Σ_v = (A N₀ Aᵀ + N₁ + (A J₀ − J₁) P (A J₀ − J₁)ᵀ) / Δt² + (a Δt / 2)² I          A = Ad((T₀⁻¹ T₁)⁻¹)
//! N = OWN_SHARE (Σ_alignment + Σ_displacement)
//! ```
//! N are the independent errors of each pose: a part of those of its alignment and of the displacement of its image,
//! since noise of single points' depth, lens and rolling shutter displace successive images alike. The common errors of
//! the keyframe's depth, m with covariance P, move both poses: by J₀ m and J₁ m, whose difference is a relative error
//! of the velocity. Across a change of keyframe the errors of depth, of points and common, differ. v is a mean over the
//! interval: by its end v has changed by a further a Δt / 2, a from its last changes. Errors of a pose are those of the
//! left increment of `current_from_keyframe`; the velocity is in the camera's axes, in which a steady turn is constant.

use nalgebra::{Matrix6, Matrix6x3, Vector6};

use crate::slam::geometry::se3::SE3;
use crate::slam::modes::ModeCovariance;
use crate::slam::pose::{Velocity, upper_triangle};

/// Longest interval that has a velocity, seconds: over a longer one no motion is steady.
const LONGEST_INTERVAL: f64 = 0.5;

/// Share of a pose's variance that is independent of the previous pose on the same keyframe. Calibrated on exact and
/// recorded sequences: poses differ from frame to frame by half of their uncertainty, and by less on exact images.
const OWN_SHARE: f64 = 0.25;

/// Weight of the newest change in the running mean: a quarter of a second at 30 Hz.
const NEWEST_SHARE: f64 = 0.125;

/// Errors of one pose from noise and the keyframe's common depth, keyframe units and radians.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PoseErrors {
    /// Keyframe and epoch that the pose is relative to.
    pub keyframe: (u64, u32),
    /// World units per keyframe unit.
    pub unit: f64,
    /// Covariance of the alignment.
    pub alignment: Matrix6<f64>,
    /// Covariance of the displacement of the whole image.
    pub displacement: Matrix6<f64>,
    /// J: motion of the pose per unit of each common error of depth.
    pub by_mode: Matrix6x3<f64>,
    /// P: covariance of these errors.
    pub modes: ModeCovariance,
}

impl PoseErrors {
    fn world_from_unit(&self) -> Matrix6<f64> {
        let unit = self.unit;
        Matrix6::from_diagonal(&Vector6::new(unit, unit, unit, 1.0, 1.0, 1.0))
    }
}

/// State of the previous frames, for the velocity of the next.
#[derive(Debug, Clone, Default)]
pub(super) struct VelocityMemory {
    last: Option<PoseErrors>,
    step: Option<Step>,
    acceleration: Option<[f64; 2]>,
}

/// A mean velocity.
#[derive(Debug, Clone, Copy)]
struct Step {
    /// World units and radians per second.
    velocity: Vector6<f64>,
    secs: f64,
    /// Sum of the variances of the translation, and of the rotation, without acceleration.
    variance: [f64; 2],
}

impl VelocityMemory {
    /// Forgets everything: there is no pose, or none from which the next one follows.
    pub fn forget(&mut self) {
        *self = Self::default();
    }

    /// Rescales as the map's unit changes by `factor`.
    pub fn follow(&mut self, factor: f64) {
        if let Some(last) = &mut self.last {
            last.unit *= factor;
        }
        if let Some(step) = &mut self.step {
            step.velocity.fixed_rows_mut::<3>(0).scale_mut(factor);
            step.variance[0] *= factor * factor;
        }
        if let Some([of_translation, _]) = &mut self.acceleration {
            *of_translation *= factor * factor;
        }
    }

    /// The velocity at a frame with these errors after a `motion` (twist in world units and radians, duration in
    /// seconds) from the previous one; `None` where the motion is unknown, or there is no velocity.
    pub fn observe(
        &mut self,
        errors: PoseErrors,
        motion: Option<(Vector6<f64>, f64)>,
    ) -> Option<Velocity> {
        let before = self.last.replace(errors);
        let last = self.last.as_ref()?;
        let step = before.filter(|before| before.keyframe.1 == last.keyframe.1).zip(motion);
        let step = step.filter(|(_, (_, secs))| (0.0..=LONGEST_INTERVAL).contains(secs));
        let Some((before, (twist, secs))) = step else {
            (self.step, self.acceleration) = (None, None);
            return None;
        };
        let mut covariance = of_twist(&before, last, &twist) / (secs * secs);
        let variance = [0, 3].map(|start| (start..start + 3).map(|k| covariance[(k, k)]).sum());
        let step = Step { velocity: twist / secs, secs, variance };
        let change = self.change(&step);
        for k in 0..6 {
            covariance[(k, k)] += change[k / 3];
        }
        self.step = Some(step);
        let velocity = Velocity {
            linear: step.velocity.fixed_rows::<3>(0).into_owned(),
            angular: step.velocity.fixed_rows::<3>(3).into_owned(),
            covariance: upper_triangle(|row, column| covariance[(row, column)]),
        };
        let mut numbers = step.velocity.iter().chain(&velocity.covariance);
        numbers.all(|x| x.is_finite()).then_some(velocity)
    }

    /// Variance, per axis of the translation and of the rotation, of the possible change of a velocity from the middle
    /// of its interval to the end.
    fn change(&mut self, now: &Step) -> [f64; 2] {
        let half = 0.5 * now.secs;
        // The first step may also be the camera's first motion.
        let begun = [0, 3].map(|start| now.velocity.fixed_rows::<3>(start).norm_squared() / 3.0);
        let Some(before) = self.step else { return begun };
        let between = 0.5 * (before.secs + now.secs);
        let acceleration = (now.velocity - before.velocity) / between;
        let newest = [0, 1].map(|part| {
            // Both share the pose between them: its error counts four times, those at the ends once.
            let noise = 1.5 * (before.variance[part] + now.variance[part]) / (between * between);
            (acceleration.fixed_rows::<3>(3 * part).norm_squared() - noise) / 3.0
        });
        let mean = self.acceleration.unwrap_or(newest);
        let mean = [0, 1].map(|part| mean[part] + NEWEST_SHARE * (newest[part] - mean[part]));
        self.acceleration = Some(mean);
        [0, 1].map(|part| mean[part].max(newest[part]).max(0.0) * half * half)
    }
}

/// Covariance of `twist`, the logarithm of `before_from_last`.
fn of_twist(before: &PoseErrors, last: &PoseErrors, twist: &Vector6<f64>) -> Matrix6<f64> {
    let last_from_before = SE3::exp(&-twist).adjoint();
    let is_same = before.keyframe == last.keyframe;
    let own = |errors: &PoseErrors| {
        let of_points = if is_same { OWN_SHARE } else { 1.0 };
        let own = errors.alignment * of_points + errors.displacement * OWN_SHARE;
        let world = errors.world_from_unit();
        world * own * world
    };
    let common = |errors: &PoseErrors| errors.world_from_unit() * errors.by_mode;
    let moved = if is_same { last_from_before * common(before) } else { Matrix6x3::zeros() };
    let moved = moved - common(last);
    last_from_before * own(before) * last_from_before.transpose()
        + own(last)
        + moved * last.modes.matrix() * moved.transpose()
}
