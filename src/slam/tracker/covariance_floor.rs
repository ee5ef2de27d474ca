//! The part of a published covariance beyond noise and the keyframe's common depth errors: displacements of the whole
//! image, of which the residuals show only the part that differs between tiles.
//!
//! ```text
//! Σ_published = Σ_alignment + (M⁻¹H) P (M⁻¹H)ᵀ + diag(σ_t² I, σ_ω² I)
//! σ_ω² = (image_px / f)² + (misfit_ratio · misfit)²      σ_t = σ_ω / d̄
//! ```
//! `misfit` is the displacement of tiles of this very image beyond the noise of single pixels: 0.03 px in the
//! simulator, 0.3 to 0.5 px where lens, rolling shutter and the shape of the depth play a part. It distinguishes
//! cameras that one constant cannot serve. Only the published covariance includes it: matching, keyframes and verdicts
//! use the covariance of the alignment.

use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};

use crate::slam::alignment::misfit::TileMisfit;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::parameter::{ParameterError, check_range};

/// Parameters of the displacement of the whole image in the published covariance of a pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CovarianceFloorParams {
    /// Standard deviation of the displacement of any image, pixels: the interpolation error of an exact image.
    pub image_px: f64,
    /// Displacement of the whole image per displacement of one of its tiles beyond noise. The errors behind both are
    /// smooth, so more of them is common to the image than differs between its tiles. Calibrated on the map's own depth
    /// over rooms and recordings.
    pub misfit_ratio: f64,
}

impl Default for CovarianceFloorParams {
    fn default() -> Self {
        Self { image_px: 0.02, misfit_ratio: 2.8 }
    }
}

impl CovarianceFloorParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("image_px", self.image_px, 0.0..=100.0)?;
        check_range("misfit_ratio", self.misfit_ratio, 0.0..=100.0)
    }

    /// Standard deviation of the displacement of an image, pixels, from the misfit of its tiles and the mean whitened
    /// squared residual.
    pub fn displacement_px(
        &self,
        misfit: &TileMisfit,
        mean_energy: f64,
        intrinsics: &Intrinsics,
    ) -> f64 {
        let of_tiles = misfit.beyond_noise(mean_energy).sqrt() * shortest_focal(intrinsics);
        self.image_px.hypot(self.misfit_ratio * of_tiles)
    }
}

/// Covariance (translation, rotation) of the left increment of a pose whose image is displaced by this standard
/// deviation in pixels: about each axis, and along each for points at the mean inverse depth.
pub fn displacement_covariance(
    displacement_px: f64,
    intrinsics: &Intrinsics,
    mean_inverse_depth: f64,
) -> Matrix6<f64> {
    let about = displacement_px / shortest_focal(intrinsics);
    let along = about / mean_inverse_depth;
    let variances = [along, along, along, about, about, about].map(|std_dev| std_dev * std_dev);
    Matrix6::from_diagonal(&variances.into())
}

fn shortest_focal(intrinsics: &Intrinsics) -> f64 {
    intrinsics.fx.min(intrinsics.fy)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics =
        Intrinsics { fx: 500.0, fy: 400.0, cx: 0.0, cy: 0.0, width: 64, height: 48 };

    #[test]
    fn displaced_tiles_widen_the_covariance() {
        let floor = CovarianceFloorParams { image_px: 0.3, misfit_ratio: 2.0 };
        // A tile with noise only, and one that is displaced by 0.2 px in addition.
        let noise = (0.1f64 / 400.0).powi(2);
        let misfit = |beyond_px: f64| TileMisfit {
            variance: 0.5 * noise + (beyond_px / 400.0).powi(2),
            noise,
        };
        let of = |beyond_px: f64| floor.displacement_px(&misfit(beyond_px), 0.5, &CAMERA);
        assert!((of(0.0) - 0.3).abs() < 1e-9);
        assert!((of(0.2) - 0.5).abs() < 1e-9);
        assert!(CovarianceFloorParams { image_px: f64::NAN, ..floor }.validate().is_err());
        assert!(CovarianceFloorParams::default().validate().is_ok());
    }

    #[test]
    fn the_covariance_scales_with_lens_and_depth() {
        let covariance = displacement_covariance(2.0, &CAMERA, 0.5);
        assert!((covariance[(4, 4)].sqrt() - 0.005).abs() < 1e-12);
        assert!((covariance[(1, 1)].sqrt() - 0.01).abs() < 1e-12);
        assert_eq!(covariance[(0, 4)], 0.0);
    }
}
