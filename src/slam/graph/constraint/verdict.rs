//! Gates that two aligned keyframes must pass to count as the same place. A false loop distorts the whole map: doubtful
//! ones are refused.

use super::{KeyframeAlignment, Measurement};

/// Bounds for accepting a measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct GateParams {
    /// Fewest points of the finest level that are compared: nine unknowns need many times as many.
    pub min_points: usize,
    /// Largest logarithm of the gain, either way: a small gain flattens any image (as for a lost tracker).
    pub max_log_gain: f64,
    /// Least share of the points in view.
    pub min_usage: f64,
    /// Least share of inliers among them.
    pub min_inliers: f64,
    /// Largest distance of the cameras, mean depths: from afar the variance of depth explains any image.
    pub max_distance: f64,
    /// Fewest tiles with texture.
    pub min_tiles: u32,
    /// Least share of these in which the images correlate: neither gain nor variance can imitate that.
    pub min_agreement: f64,
    /// The same for another pose that makes the measurement ambiguous.
    pub min_rival_agreement: f64,
    /// Least share of the points in view that meet depth.
    pub min_depth: f64,
    /// Least share of those whose depths agree: another room may look the same.
    pub min_depth_inliers: f64,
    /// Largest squared normalised difference between the two directions: χ²₇ at 99 %.
    pub max_reciprocal_chi2: f64,
    /// Largest standard deviation of translation in mean depths, of rotation in radians and of ln s: a less certain
    /// measurement constrains nothing, and agrees with anything.
    pub max_std_dev: f64,
}

impl Default for GateParams {
    fn default() -> Self {
        Self {
            min_points: 200,
            max_log_gain: 0.5,
            min_usage: 0.3,
            min_inliers: 0.7,
            max_distance: 1.0,
            min_tiles: 20,
            min_agreement: 0.6,
            min_rival_agreement: 0.6,
            min_depth: 0.15,
            min_depth_inliers: 0.7,
            max_reciprocal_chi2: 18.5,
            max_std_dev: 0.1,
        }
    }
}

/// Why there is no measurement.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The keyframes are of cameras with different intrinsics.
    #[error("the keyframes have different intrinsics")]
    OtherCamera,
    /// A keyframe has too few points with depth.
    #[error("a keyframe has too few points with depth")]
    TooFewPoints,
    /// The initial similarity is invalid.
    #[error("the initial similarity is not finite or its scale is not positive")]
    InvalidStart,
    /// No start makes the images agree.
    #[error("the images do not overlap")]
    NoOverlap,
    /// No point falls into the other image.
    #[error("no point falls into the other image")]
    NothingInView,
    /// Too few points fall into the other image.
    #[error("too few points fall into the other image")]
    LittleOverlap,
    /// Images and depths do not determine the similarity.
    #[error("images and depths do not determine the similarity")]
    Undetermined,
    /// The gain is implausible.
    #[error("the gain between the images is not plausible")]
    ImplausibleGain,
    /// The cameras are too far apart.
    #[error("the cameras are too far apart")]
    TooFar,
    /// Too few points are explained.
    #[error("too few points are inliers")]
    FewInliers,
    /// Too little of the images has texture in both.
    #[error("too little texture is in view of both keyframes")]
    LittleTexture,
    /// Tiles of the images do not correlate.
    #[error("the images do not agree")]
    ImagesDisagree,
    /// Too few points meet depth of the other keyframe.
    #[error("too little depth is in view of both keyframes")]
    LittleDepth,
    /// The depths contradict each other.
    #[error("the depths do not agree")]
    DepthsDisagree,
    /// The two directions do not agree within their covariances.
    #[error("the two directions disagree: χ² = {0:.1}")]
    NotReciprocal(f64),
    /// Another pose explains the images as well: the texture repeats.
    #[error("another pose explains the images equally well")]
    Ambiguous,
    /// The measurement is too uncertain to be of use.
    #[error("the measurement is too uncertain")]
    Uncertain,
}

impl GateParams {
    /// Judges one alignment.
    pub(super) fn judge(&self, found: &KeyframeAlignment) -> Result<(), Refusal> {
        let gates = [
            (found.log_gain.abs() <= self.max_log_gain, Refusal::ImplausibleGain),
            (found.distance <= self.max_distance, Refusal::TooFar),
            (found.usage >= self.min_usage, Refusal::LittleOverlap),
            (found.inlier_share >= self.min_inliers, Refusal::FewInliers),
            (found.agreement.tiles >= self.min_tiles, Refusal::LittleTexture),
            (found.agreement.share >= self.min_agreement, Refusal::ImagesDisagree),
            (found.depth_share >= self.min_depth, Refusal::LittleDepth),
            (found.depth_inlier_share >= self.min_depth_inliers, Refusal::DepthsDisagree),
        ];
        gates.iter().find(|(holds, _)| !holds).map_or(Ok(()), |&(_, refusal)| Err(refusal))
    }

    /// Judges the difference between the two directions.
    pub(super) fn judge_reciprocity(&self, chi2: f64) -> Result<(), Refusal> {
        if chi2 <= self.max_reciprocal_chi2 { Ok(()) } else { Err(Refusal::NotReciprocal(chi2)) }
    }

    /// Judges the certainty of the result.
    pub(super) fn judge_certainty(
        &self,
        found: &Measurement,
        mean_inverse_depth: f64,
    ) -> Result<(), Refusal> {
        let std_devs = found.covariance.diagonal().map(|variance| variance.max(0.0).sqrt());
        let translation = std_devs.fixed_rows::<3>(0).norm() * mean_inverse_depth;
        let is_sure = translation.max(std_devs.fixed_rows::<4>(3).amax()) <= self.max_std_dev;
        if is_sure { Ok(()) } else { Err(Refusal::Uncertain) }
    }
}
