//! What a published covariance may not fall below: errors that no point of the image knows of.
//!
//! The covariance of the alignment takes the errors of distant points for independent. Depth that is
//! tilted or flattened over a whole keyframe, what the lens model leaves, a rolling shutter: these move
//! all points together, and the residuals do not show them. Until they are estimated, this floor on the
//! diagonal stands for them:
//! ```text
//! Σ_published = Σ_alignment + diag(σ_t² I, σ_ω² I)      σ_t = translation_ratio ‖t‖      σ_ω = image_px / f
//! ```
//! Only what is published is raised: matching, keyframes and verdicts use the covariance of the alignment.

use nalgebra::{Matrix6, Vector3};
use serde::{Deserialize, Serialize};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::parameter::{ParameterError, check_range};

/// Floor under the published covariance of a pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CovarianceFloorParams {
    /// Standard deviation by which the image as a whole may be displaced, pixels: divided by the
    /// focal length it is that of the rotation about each axis. 1 px is what consecutive keyframes of
    /// recordings disagree by (0.5 to 3 px; 0.3 px in the simulator).
    pub image_px: f64,
    /// Standard deviation of the translation along each axis, as a share of the translation since the
    /// keyframe: tilt and relief of depth turn and stretch it. Recordings: 2 to 20 %.
    pub translation_ratio: f64,
}

impl Default for CovarianceFloorParams {
    fn default() -> Self {
        Self { image_px: 1.0, translation_ratio: 0.1 }
    }
}

impl CovarianceFloorParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("image_px", self.image_px, 0.0..=100.0)?;
        check_range("translation_ratio", self.translation_ratio, 0.0..=10.0)
    }

    /// `covariance` (translation, rotation) of the left increment of a `current_from_keyframe` with
    /// this translation, raised by the floor.
    pub fn raised(
        &self,
        covariance: &Matrix6<f64>,
        intrinsics: &Intrinsics,
        translation: &Vector3<f64>,
    ) -> Matrix6<f64> {
        let along = self.translation_ratio * translation.norm();
        let about = self.image_px / intrinsics.fx.min(intrinsics.fy);
        let mut raised = *covariance;
        for axis in 0..3 {
            raised[(axis, axis)] += along * along;
            raised[(axis + 3, axis + 3)] += about * about;
        }
        raised
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_floor_is_added_and_scales_with_lens_and_translation() {
        let camera = Intrinsics { fx: 500.0, fy: 400.0, cx: 0.0, cy: 0.0, width: 64, height: 48 };
        let floor = CovarianceFloorParams { image_px: 2.0, translation_ratio: 0.1 };
        let alignment = Matrix6::from_fn(|i, j| if i == j { 1e-6 } else { 1e-8 });
        let raised = floor.raised(&alignment, &camera, &Vector3::new(0.0, 0.3, 0.4));
        let added = raised - alignment;
        for i in 0..6 {
            for j in 0..6 {
                let expected = match (i == j, i < 3) {
                    (false, _) => 0.0,
                    (true, true) => 0.05 * 0.05,
                    (true, false) => 0.005 * 0.005,
                };
                assert!((added[(i, j)] - expected).abs() < 1e-12, "{i} {j}");
            }
        }
        let none = CovarianceFloorParams { image_px: 0.0, translation_ratio: 0.0 };
        assert_eq!(none.raised(&alignment, &camera, &Vector3::x()), alignment);
        assert!(none.validate().is_ok());
        let broken = CovarianceFloorParams { image_px: f64::NAN, ..none };
        assert!(broken.validate().is_err());
    }
}
