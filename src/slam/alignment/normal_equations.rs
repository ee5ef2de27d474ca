//! The normal equations of one evaluation, and the damped step that solves them.
//!
//! State: the left increment (translation, rotation) of `current_from_keyframe`, then the
//! increments of the brightness a and b.

use nalgebra::{SMatrix, SVector, Vector6};

/// Unknowns: six of the pose, two of the brightness.
pub const UNKNOWNS: usize = 8;

/// Information, gradient and statistics of the residuals at one state.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct NormalEquations {
    /// Σ w J Jᵀ.
    pub information: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    /// Σ w J r.
    pub gradient: SVector<f64, UNKNOWNS>,
    /// Σ ρ(r/σ_r), Huber's ρ (q² inside, 2k|q| − k² outside).
    pub energy: f64,
    /// Σ r², grey levels².
    pub squared_residual: f64,
    /// Points that project into the image.
    pub in_view: u32,
    /// Points in view that the sensor does not clip; the other sums are over these.
    pub compared: u32,
    /// Compared points with |r|/σ_r below the inlier gate.
    pub inliers: u32,
}

impl NormalEquations {
    /// Mean energy of the compared points; infinite without any.
    pub fn mean_energy(&self) -> f64 {
        if self.compared == 0 { f64::INFINITY } else { self.energy / f64::from(self.compared) }
    }

    /// Adds a prior N(0, 1/information) on unknown `index`, whose current value is `value`.
    pub fn add_prior(&mut self, index: usize, value: f64, information: f64) {
        self.information[(index, index)] += information;
        self.gradient[index] += information * value;
        self.energy += information * value * value;
    }

    /// Removes an unknown from the problem: its step will be zero.
    pub fn fix(&mut self, index: usize) {
        self.information.row_mut(index).fill(0.0);
        self.information.column_mut(index).fill(0.0);
        self.information[(index, index)] = 1.0;
        self.gradient[index] = 0.0;
    }

    /// The step −(A + λ diag A)⁻¹ g; `None` if A is not positive definite or not finite.
    pub fn damped_step(&self, lambda: f64) -> Option<SVector<f64, UNKNOWNS>> {
        let mut damped = self.information;
        for i in 0..UNKNOWNS {
            damped[(i, i)] *= 1.0 + lambda;
        }
        let step = -damped.cholesky()?.solve(&self.gradient);
        step.iter().all(|x| x.is_finite()).then_some(step)
    }

    /// Length of `step` in standard deviations: √(δᵀMδ), M the information.
    pub fn decrement(&self, step: &SVector<f64, UNKNOWNS>) -> f64 {
        step.dot(&(self.information * step)).max(0.0).sqrt()
    }
}

/// The pose part of a step.
pub fn pose_step(step: &SVector<f64, UNKNOWNS>) -> Vector6<f64> {
    step.fixed_rows::<6>(0).into_owned()
}
