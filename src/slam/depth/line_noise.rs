//! The displacement of epipolar lines, estimated from the scatter of the matches along them.
//!
//! The poses of frames are only as good as the depth they were estimated with, and their covariance does not include
//! errors that all points share. Matches show how much they differ from the known depth: along the line, in pixels.
//! Errors that recur in every frame do not show; they are assumed to be proportional to the scatter.

use serde::{Deserialize, Serialize};

use crate::slam::parameter::{ParameterError, check_range};

/// Tuning of the estimate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LineNoiseParams {
    /// Line noise over the scatter of matches along the line. It also covers errors common to all frames, which do not
    /// show in the scatter; it was chosen by the share of true depths within one standard deviation.
    pub scatter_ratio: f32,
    /// Least line noise, pixels: the scatter of a frame with little motion is not informative.
    pub min_px: f32,
    /// Largest line noise, pixels: beyond it the search finds false matches.
    pub max_px: f32,
    /// Frames over which the estimate is averaged.
    pub averaged_frames: f32,
}

impl Default for LineNoiseParams {
    fn default() -> Self {
        Self { scatter_ratio: 0.5, min_px: 0.05, max_px: 3.0, averaged_frames: 10.0 }
    }
}

impl LineNoiseParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("scatter_ratio", self.scatter_ratio, 0.0..=20.0)?;
        check_range("min_px", self.min_px, 0.0..=5.0)?;
        check_range("max_px", self.max_px, 0.0..=20.0)?;
        check_range("averaged_frames", self.averaged_frames, 1.0..=1000.0)
    }
}

/// Bins of a [`Histogram`].
const BINS: usize = 64;
/// Bins per pixel: matches scatter by 0.1 px at best.
const BINS_PER_PX: f32 = 16.0;

/// A histogram of lengths in pixels; a sum over rows does not depend on their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Histogram([u32; BINS]);

impl Histogram {
    #[inline(always)]
    fn add(&mut self, px: f32) {
        self.0[((px * BINS_PER_PX) as usize).min(BINS - 1)] += 1;
    }

    fn total(&self) -> u32 {
        self.0.iter().sum()
    }

    /// Median, linear within a bin; 0 if empty.
    fn median(&self) -> f32 {
        let half = 0.5 * self.total() as f32;
        let mut below = 0.0;
        for (bin, &count) in self.0.iter().enumerate() {
            let count = count as f32;
            if count > 0.0 && below + count >= half {
                return (bin as f32 + (half - below) / count) / BINS_PER_PX;
            }
            below += count;
        }
        0.0
    }
}

/// Distances along the line of one frame's matches from the positions predicted by known depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Innovations {
    /// Their sizes.
    sizes: Histogram,
    /// Standard deviations of the single matches due to image noise and sampling.
    own: Histogram,
}

impl Default for Innovations {
    fn default() -> Self {
        Self { sizes: Histogram([0; BINS]), own: Histogram([0; BINS]) }
    }
}

impl Innovations {
    /// Adds a match `px` off, of which noise and sampling explain `own_px`.
    #[inline(always)]
    pub fn add(&mut self, px: f32, own_px: f32) {
        self.sizes.add(px.abs());
        self.own.add(own_px);
    }

    /// The sum over two parts of the image.
    pub fn plus(self, other: Self) -> Self {
        let plus =
            |a: Histogram, b: Histogram| Histogram(std::array::from_fn(|bin| a.0[bin] + b.0[bin]));
        Self { sizes: plus(self.sizes, other.sizes), own: plus(self.own, other.own) }
    }

    /// Standard deviation, pixels, beyond what noise and sampling explain, from the median size; `None` for too few
    /// matches.
    pub fn scatter_px(&self) -> Option<f32> {
        /// Fewer matches than this do not represent a frame.
        const MIN_MATCHES: u32 = 200;
        /// Median of |x| over the standard deviation for a Gaussian.
        const MEDIAN_RATIO: f32 = 0.6745;
        if self.sizes.total() < MIN_MATCHES {
            return None;
        }
        let (all, own) = (self.sizes.median() / MEDIAN_RATIO, self.own.median());
        Some((all * all - own * own).max(0.0).sqrt())
    }
}

/// The estimate, updated from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineNoise {
    variance: f32,
}

impl LineNoise {
    /// The estimate before any frame.
    pub fn new(std_dev_px: f32) -> Self {
        Self { variance: std_dev_px * std_dev_px }
    }

    /// Updates the estimate with the matches of a frame.
    pub fn observe(&mut self, innovations: &Innovations, params: &LineNoiseParams) {
        let Some(scatter) = innovations.scatter_px() else { return };
        let now = (params.scatter_ratio * scatter).min(params.max_px).max(params.min_px);
        self.variance += (now * now - self.variance) / params.averaged_frames;
    }

    /// Standard deviation, pixels.
    pub fn std_dev_px(&self) -> f32 {
        self.variance.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::alignment::scene::Noise;

    #[test]
    fn the_scatter_is_robust_to_a_few_outliers() {
        let (mut noise, mut innovations) = (Noise(5), Innovations::default());
        for i in 0..5000 {
            let outlier = if i % 20 == 0 { 30.0 } else { 0.0 };
            innovations.add(0.5 * noise.normal() as f32 + outlier, 0.3);
        }
        let scatter = innovations.scatter_px().unwrap();
        assert!((scatter / 0.4 - 1.0).abs() < 0.2, "{scatter}");
        assert_eq!(Innovations::default().scatter_px(), None);
    }

    #[test]
    fn the_estimate_follows_the_matches_and_stays_within_its_bounds() {
        let params = LineNoiseParams { scatter_ratio: 2.0, ..LineNoiseParams::default() };
        let mut line_noise = LineNoise::new(1.0);
        let (mut still, mut wild) = (Innovations::default(), Innovations::default());
        for _ in 0..1000 {
            still.add(0.1, 0.2);
            wild.add(50.0, 0.2);
        }
        for _ in 0..200 {
            line_noise.observe(&still, &params);
        }
        assert!((line_noise.std_dev_px() - params.min_px).abs() < 1e-3);
        for _ in 0..200 {
            line_noise.observe(&wild, &params);
        }
        assert!((line_noise.std_dev_px() - params.max_px).abs() < 1e-3);
        line_noise.observe(&Innovations::default(), &params);
        assert!((line_noise.std_dev_px() - params.max_px).abs() < 1e-3);
    }
}
