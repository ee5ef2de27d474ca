//! The noise of a camera's images: one model for everything that compares grey levels.

use serde::{Deserialize, Serialize};

use crate::slam::parameter::{ParameterError, check_range};

/// How much the grey levels of the same point differ between images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImageNoise {
    /// Standard deviation of the noise of a pixel, grey levels; halves with each level of a pyramid. Cameras in rooms
    /// have 2 to 4.
    pub pixel_std_dev: f32,
    /// Standard deviation of the errors that do not halve (interpolation, reflections, occlusion), where single pixels
    /// are compared, grey levels. 4 needs a tenth fewer iterations of the alignment than 2; errors on recordings differ
    /// by up to a tenth, either way.
    pub model_std_dev: f32,
}

impl ImageNoise {
    /// The noise of an uncharacterised camera.
    pub const DEFAULT: Self = Self { pixel_std_dev: 3.0, model_std_dev: 4.0 };

    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        // Without a floor a noise-free image would weigh its residuals infinitely.
        check_range("pixel_std_dev", self.pixel_std_dev, 0.1..=50.0)?;
        check_range("model_std_dev", self.model_std_dev, 0.01..=100.0)
    }

    /// Variance of a single pixel of this pyramid level, grey levels².
    pub const fn variance(&self, level: usize) -> f32 {
        let averaged = self.pixel_std_dev / (1u32 << level) as f32;
        averaged * averaged + self.model_std_dev * self.model_std_dev
    }
}

impl Default for ImageNoise {
    fn default() -> Self {
        Self::DEFAULT
    }
}
