//! The first depth of a map: random, so that the first frames can be tracked at all, and proven or
//! thrown away by what they then show (Engel, Schöps, Cremers 2014, §3.1).

use serde::{Deserialize, Serialize};

use crate::slam::depth::gaussian::NEW_VALIDITY;
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::two_frame::TwoFrameParams;

/// How a map begins where no sensor gives its depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StartMethod {
    /// Pose and depths of two frames together, once their parallax is proven (DSO18 §3.1).
    #[default]
    TwoFrame,
    /// Random depth, proven or thrown away by the frames that follow (LSD14 §3.1).
    Random,
}

/// Tuning of the start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InitializerParams {
    /// How a map begins. The two-frame start is the default: it does not begin on a standing or
    /// turning camera, and its first depth is right to a few per cent.
    pub method: StartMethod,
    /// The two-frame start.
    pub two_frame: TwoFrameParams,
    /// Seed of the random depth; the same seed gives the same map.
    pub seed: u64,
    /// Median parallax that proves motion, as a share of the image width: 8 px at 640. Less cannot be
    /// told from noise on random depth, and a standing camera never gets there.
    pub min_parallax_ratio: f64,
    /// Share of the hypotheses that must be known to within [`InitializerParams::proven_std_dev_ratio`].
    pub min_proven_ratio: f64,
    /// Standard deviation over inverse depth of a proven hypothesis.
    pub proven_std_dev_ratio: f32,
    /// Share of the searches that must find a consistent match.
    pub min_match_ratio: f64,
    /// `matching.line_noise_px` until the start is proven: poses on unproven depth are that far off.
    pub line_noise_px: f32,
    /// Frames after which an unproven start is thrown away and begun again on a new frame.
    pub max_frames: u32,
}

impl Default for InitializerParams {
    fn default() -> Self {
        Self {
            method: StartMethod::TwoFrame,
            two_frame: TwoFrameParams::default(),
            seed: 1,
            min_parallax_ratio: 0.0125,
            min_proven_ratio: 0.5,
            proven_std_dev_ratio: 0.15,
            min_match_ratio: 0.6,
            line_noise_px: 0.7,
            max_frames: 60,
        }
    }
}

impl InitializerParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        self.two_frame.validate().map_err(|e| e.within("two_frame"))?;
        check_range("min_parallax_ratio", self.min_parallax_ratio, 0.001..=0.5)?;
        check_range("min_proven_ratio", self.min_proven_ratio, 0.01..=1.0)?;
        check_range("proven_std_dev_ratio", self.proven_std_dev_ratio, 0.001..=1.0)?;
        check_range("min_match_ratio", self.min_match_ratio, 0.0..=1.0)?;
        check_range("line_noise_px", self.line_noise_px, 0.0..=5.0)?;
        check_range("max_frames", self.max_frames, 5..=10_000)
    }
}

/// Variance of the random start: half a mean inverse depth each way is within 1.4 σ.
const RANDOM_VARIANCE: f32 = 0.125;

/// Gives every candidate an inverse depth between 0.5 and 1.5, a function of the seed and the pixel.
pub fn randomise(map: &mut DepthMap, seed: u64) {
    let candidates = &map.candidates;
    let pixels = map.hypotheses.pixels_mut().iter_mut().zip(candidates.pixels());
    for (index, (hypothesis, _)) in pixels.enumerate().filter(|(_, (_, candidate))| **candidate) {
        let inverse_depth = 0.5 + unit_hash(seed, index as u64);
        *hypothesis = Hypothesis {
            inverse_depth,
            variance: RANDOM_VARIANCE,
            smoothed: inverse_depth,
            validity: NEW_VALIDITY,
            propagated: false,
            failures: 0,
        };
    }
}

/// A number in [0, 1) from two integers (the finaliser of SplitMix64).
fn unit_hash(seed: u64, index: u64) -> f32 {
    let mut z = seed.wrapping_add(index.wrapping_mul(0x9E37_79B9_7F4A_7C15));
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 40) as f32 / (1u64 << 24) as f32
}

/// What is known of a start after a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartEvidence {
    /// Median over the hypotheses of the image motion that the translation causes, pixels.
    pub median_parallax_px: f64,
    /// Share of the hypotheses whose relative standard deviation is small enough.
    pub proven_ratio: f64,
    /// Share of the latest searches with a consistent match.
    pub match_ratio: f64,
}

impl StartEvidence {
    /// Whether the map can be trusted.
    pub fn proves(&self, params: &InitializerParams, image_width: usize) -> bool {
        self.median_parallax_px >= params.min_parallax_ratio * image_width as f64
            && self.proven_ratio >= params.min_proven_ratio
            && self.match_ratio >= params.min_match_ratio
    }
}

/// Share of the hypotheses of `map` that are known to within `std_dev_ratio` of their inverse depth.
pub fn proven_ratio(map: &DepthMap, std_dev_ratio: f32) -> f64 {
    let (mut all, mut proven) = (0usize, 0usize);
    for h in map.hypotheses.pixels().iter().filter(|h| h.is_some()) {
        all += 1;
        proven += usize::from(h.variance <= (std_dev_ratio * h.inverse_depth).powi(2));
    }
    if all == 0 { 0.0 } else { proven as f64 / all as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn random_depth_is_spread_and_repeatable() {
        let mut map = DepthMap::with_size(64, 64);
        map.candidates.pixels_mut().fill(true);
        randomise(&mut map, 3);
        let mean = map.mean_inverse_depth().unwrap();
        assert!((mean - 1.0).abs() < 0.02);
        let again = {
            let mut again = map.clone();
            randomise(&mut again, 3);
            again
        };
        assert_eq!(map.hypotheses, again.hypotheses);
        let mut other = map.clone();
        randomise(&mut other, 4);
        assert_ne!(map.hypotheses, other.hypotheses);
    }

    #[test]
    fn parallax_proof_and_matches_are_all_needed() {
        let params = InitializerParams::default();
        let good = StartEvidence { median_parallax_px: 10.0, proven_ratio: 0.8, match_ratio: 0.9 };
        assert!(good.proves(&params, 640));
        assert!(!StartEvidence { median_parallax_px: 3.0, ..good }.proves(&params, 640));
        assert!(!StartEvidence { proven_ratio: 0.1, ..good }.proves(&params, 640));
        assert!(!StartEvidence { match_ratio: f64::NAN, ..good }.proves(&params, 640));
    }
}
