//! Tuning of the alignment.

use serde::{Deserialize, Serialize};

use crate::slam::image::noise::ImageNoise;
use crate::slam::image::sums::MAX_LEVELS;
use crate::slam::kernel::SimdMode;
use crate::slam::parameter::{ParameterError, check_range};

/// Tuning of the alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlignmentParams {
    /// The camera's noise, configured once for all modules.
    #[serde(skip)]
    pub noise: ImageNoise,
    /// Whether the variance of the inverse depth weights the residuals (LSD14 §3.3); off only to measure its effect.
    pub use_depth_variance: bool,
    /// Standard deviation of the error that neighbouring points share, as a share of the inverse depth: weights have it
    /// in addition to the variance, which treats errors as independent and would let the most observed points lead
    /// alone. Inliers are counted without it, so that a wrong pose is not excused; see `docs/depth-noise.md`.
    pub common_depth_error: f32,
    /// Huber's k on |r|/σ_r; LSD-SLAM's 1.5 keeps 95 % efficiency on Gaussian noise.
    pub huber: f32,
    /// |r|/σ_r below which a point counts as inlier.
    pub inlier_gate: f32,
    /// Whether the brightness (a, b) is estimated with the pose.
    pub estimate_brightness: bool,
    /// Standard deviation of a around 0: a gain of 1.6 is one σ.
    pub gain_prior_std_dev: f64,
    /// Standard deviation of b around 0, grey levels.
    pub offset_prior_std_dev: f64,
    /// Maximum number of iterations of each level, finest first.
    pub max_iterations: [u32; MAX_LEVELS],
    /// A level is finished when a step is shorter than this, in standard deviations of the unknowns by the level's own
    /// information: √(δᵀMδ), the Newton decrement. The remaining error is then small against the claimed uncertainty.
    pub step_tolerance: f64,
    /// A level is finished when a step leaves more than this share of the mean energy.
    pub energy_tolerance: f64,
    /// Smallest share of the level's points that must be in view and unclipped.
    pub min_in_view: f64,
    /// The instructions to use.
    pub simd: SimdMode,
    /// Inflation s² of the covariance, for errors that even the scatter of the gradient does not show: those of one
    /// sign everywhere. Fitted by `cargo run --release --example alignment_figures -- covariance`.
    pub covariance_inflation: f64,
}

impl Default for AlignmentParams {
    fn default() -> Self {
        Self {
            noise: ImageNoise::default(),
            use_depth_variance: true,
            common_depth_error: 0.05,
            huber: 1.5,
            inlier_gate: 2.5,
            estimate_brightness: true,
            gain_prior_std_dev: 0.5,
            offset_prior_std_dev: 30.0,
            max_iterations: [8, 12, 20, 30, 40],
            step_tolerance: 0.3,
            energy_tolerance: 0.999,
            min_in_view: 0.05,
            simd: SimdMode::Auto,
            covariance_inflation: 2.2,
        }
    }
}

impl AlignmentParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("common_depth_error", self.common_depth_error, 0.0..=1.0)?;
        check_range("huber", self.huber, 0.1..=100.0)?;
        check_range("inlier_gate", self.inlier_gate, 0.1..=100.0)?;
        check_range("gain_prior_std_dev", self.gain_prior_std_dev, 1e-3..=1e3)?;
        check_range("offset_prior_std_dev", self.offset_prior_std_dev, 1e-3..=1e6)?;
        for (level, &iterations) in self.max_iterations.iter().enumerate() {
            check_range(&format!("max_iterations[{level}]"), iterations, 1..=1000)?;
        }
        check_range("step_tolerance", self.step_tolerance, 1e-6..=10.0)?;
        check_range("energy_tolerance", self.energy_tolerance, 0.5..=1.0)?;
        check_range("min_in_view", self.min_in_view, 0.0..=1.0)?;
        check_range("covariance_inflation", self.covariance_inflation, 1e-3..=1e6)
    }
}
