//! Tuning of the Gaussian filter.

use serde::{Deserialize, Serialize};

use crate::slam::parameter::{ParameterError, check_range};

/// Tuning of the filter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GaussianParams {
    /// Half width of the search around a hypothesis, in its standard deviations. 2 covers 95 %.
    pub search_sigmas: f32,
    /// An observation further off than this many joint standard deviations contradicts. A gate of 1, the value in the
    /// literature, rejects a third of the correct ones.
    pub gate_sigmas: f32,
    /// A pixel is observed only if a match promises to reduce its variance to less than this share: consecutive frames
    /// share the error of their poses, so waiting for baseline gains more than observing again.
    pub max_variance_ratio: f32,
    /// Factor on the variance before each fusion: neither the world nor the poses are exactly constant.
    pub process_inflation: f32,
    /// Factor on the variance after a contradiction.
    pub contradiction_inflation: f32,
    /// Standard deviation beyond which a hypothesis is dropped, in units of the mean inverse depth.
    pub max_std_dev: f32,
    /// Largest inverse depth that is searched for a new pixel, in units of the mean inverse depth: nothing nearer than
    /// a quarter of the usual distance is expected.
    pub max_inverse_depth: f32,
    /// Shortest segment worth a search for a new pixel, pixels.
    pub min_new_segment_px: f32,
    /// Longest segment that is searched for a new pixel while less than a third of the pixels that may carry depth have
    /// it, pixels; not below the `max_search_px` of all others. With a fast camera no frame may have shorter segments,
    /// and a keyframe without depth is worse than repeated structure. Of a longer segment the far part, of this length,
    /// is searched.
    pub max_first_search_px: f32,
}

impl Default for GaussianParams {
    fn default() -> Self {
        Self {
            search_sigmas: 2.0,
            gate_sigmas: 2.5,
            max_variance_ratio: 0.2,
            process_inflation: 1.01,
            contradiction_inflation: 1.2,
            max_std_dev: 0.5,
            max_inverse_depth: 4.0,
            min_new_segment_px: 3.0,
            max_first_search_px: 90.0,
        }
    }
}

impl GaussianParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("search_sigmas", self.search_sigmas, 0.5..=10.0)?;
        check_range("gate_sigmas", self.gate_sigmas, 0.5..=10.0)?;
        check_range("max_variance_ratio", self.max_variance_ratio, 0.01..=1.0)?;
        check_range("process_inflation", self.process_inflation, 1.0..=2.0)?;
        check_range("contradiction_inflation", self.contradiction_inflation, 1.0..=10.0)?;
        check_range("max_std_dev", self.max_std_dev, 0.01..=10.0)?;
        check_range("max_inverse_depth", self.max_inverse_depth, 1.0..=100.0)?;
        check_range("min_new_segment_px", self.min_new_segment_px, 1.0..=30.0)?;
        check_range("max_first_search_px", self.max_first_search_px, 5.0..=90.0)
    }
}
