//! Tracking status of an aligned frame: the thresholds between tracked, degraded and lost.

use serde::{Deserialize, Serialize};

use crate::slam::alignment::align::{Alignment, Ending};
use crate::slam::alignment::normal_equations::NormalEquations;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{DegradedReason, LostReason, Quality, TrackingState};

/// Thresholds on the quality of an alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VerdictParams {
    /// Fewest points in view and not clipped by the sensor, at the level solved: eight unknowns need many times more.
    pub min_points: u32,
    /// Share of points in view and not clipped by the sensor below which a frame is lost.
    pub lost_in_view: f64,
    /// Share of inliers among those below which a frame is lost.
    pub lost_inliers: f64,
    /// Increase of `lost_inliers` until a lost tracker may claim a pose again: a wrong pose must not pass by chance.
    /// Wrong poses on recordings had up to 0.85 of inliers, most of them below 0.78; nor may a pose be claimed then
    /// that would be degraded for its overlap.
    pub recovery_margin: f64,
    /// Largest distance from the keyframe at which a lost tracker may claim a pose, keyframe units (mean depths): from
    /// afar the depth variance explains any image. Keyframes are created at a third; wrong poses were 0.4 to 0.9 away.
    pub recovery_distance: f64,
    /// Largest logarithm of the gain, either way, with which a lost tracker may claim a pose: a small gain flattens any
    /// image. Where the camera has been before, automatic exposure is about as it was; wrong poses had 0.7 to 1.
    pub recovery_gain: f64,
    /// Share of points in view and not clipped by the sensor below which a pose is degraded.
    pub degraded_in_view: f64,
    /// Whitened RMSE above which a pose is degraded.
    pub degraded_whitened_rmse: f64,
    /// Missing frames in a row above which a pose is degraded.
    pub gap_frames: u64,
}

impl Default for VerdictParams {
    fn default() -> Self {
        Self {
            min_points: 60,
            lost_in_view: 0.1,
            lost_inliers: 0.5,
            recovery_margin: 0.3,
            recovery_distance: 0.5,
            recovery_gain: 0.5,
            degraded_in_view: 0.35,
            degraded_whitened_rmse: 2.0,
            gap_frames: 2,
        }
    }
}

impl VerdictParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("min_points", self.min_points, 10..=10_000)?;
        check_range("lost_in_view", self.lost_in_view, 0.0..=1.0)?;
        check_range("lost_inliers", self.lost_inliers, 0.0..=1.0)?;
        check_range("recovery_margin", self.recovery_margin, 0.0..=1.0)?;
        check_range("recovery_distance", self.recovery_distance, 0.0..=1e3)?;
        check_range("recovery_gain", self.recovery_gain, 0.0..=100.0)?;
        check_range("degraded_in_view", self.degraded_in_view, 0.0..=1.0)?;
        check_range("degraded_whitened_rmse", self.degraded_whitened_rmse, 0.0..=1e3)?;
        check_range("gap_frames", self.gap_frames, 0..=1_000_000)
    }

    /// Judges an alignment. `was_lost`: whether the previous frame was lost; `missing`: number of frames in between.
    pub fn judge(
        &self,
        alignment: &Alignment,
        quality: &Quality,
        was_lost: bool,
        missing: u64,
    ) -> TrackingState {
        let compared = f64::from(quality.points) / alignment.points.max(1) as f64;
        let inliers = self.lost_inliers + if was_lost { self.recovery_margin } else { 0.0 };
        if !alignment.state.current_from_keyframe.is_finite() {
            TrackingState::Lost(LostReason::Diverged)
        } else if alignment.points < self.min_points as usize {
            TrackingState::Lost(LostReason::NoPoints)
        } else if alignment.ending == Ending::NothingInView
            || quality.points < self.min_points
            || compared < self.lost_in_view
            || (was_lost && !self.is_near(alignment))
        {
            TrackingState::Lost(LostReason::Diverged)
        } else if quality.inlier_ratio < inliers || (was_lost && compared < self.degraded_in_view) {
            TrackingState::Lost(LostReason::TooFewInliers)
        } else if alignment.ending == Ending::OutOfBudget {
            TrackingState::Degraded(DegradedReason::Budget)
        } else if compared < self.degraded_in_view {
            TrackingState::Degraded(DegradedReason::LowOverlap)
        } else if quality.whitened_rmse > self.degraded_whitened_rmse {
            TrackingState::Degraded(DegradedReason::HighResidual)
        } else if missing > self.gap_frames {
            TrackingState::Degraded(DegradedReason::Gap)
        } else {
            TrackingState::Tracking
        }
    }

    /// Whether position and brightness are plausible for a camera that is found again.
    pub fn is_near(&self, alignment: &Alignment) -> bool {
        alignment.state.current_from_keyframe.translation.norm() <= self.recovery_distance
            && self.has_likely_gain(alignment)
    }

    /// Whether the brightness is plausible.
    pub fn has_likely_gain(&self, alignment: &Alignment) -> bool {
        alignment.state.brightness.a.abs() <= self.recovery_gain
    }
}

/// The figures of an alignment.
pub fn quality_of(alignment: &Alignment) -> Quality {
    let sums = &alignment.state.sums;
    let compared = f64::from(sums.compared).max(1.0);
    // One that was cut short is evaluated on the finest level, but was solved on coarser ones at most.
    let iterations = &alignment.iterations;
    let solved = iterations.iter().position(|&taken| taken > 0).unwrap_or(iterations.len());
    Quality {
        in_view_ratio: f64::from(sums.in_view) / alignment.points.max(1) as f64,
        inlier_ratio: f64::from(sums.inliers) / compared,
        whitened_rmse: (sums.energy / compared).sqrt(),
        residual_rmse: (sums.squared_residual / compared).sqrt(),
        iterations: alignment.iterations.iter().sum(),
        finest_level: solved as u32,
        points: sums.compared,
        mean_squared_flow: alignment.mean_squared_flow,
        displacement_px: 0.0,
    }
}

/// Whether one coarse alignment explains the frame better than another, both from [`Aligner::sums_with_exact_depth`]:
/// more inliers, counted over all points so that looking away does not pay.
///
/// [`Aligner::sums_with_exact_depth`]: crate::slam::alignment::align::Aligner::sums_with_exact_depth
pub fn is_better(one: &NormalEquations, other: &NormalEquations) -> bool {
    one.inliers > other.inliers
        || (one.inliers == other.inliers && one.mean_energy() < other.mean_energy())
}

/// Whether the first of two nearby states fits better: by the energy, which is finer than a count of inliers, unless
/// one of them gains by looking away.
pub fn fits_better(one: &NormalEquations, other: &NormalEquations) -> bool {
    /// If the counts of points compared differ by more than this ratio, their energies are not compared.
    const SIMILAR_VIEW: f64 = 0.8;
    let counts = [one, other].map(|sums| f64::from(sums.compared));
    if counts[0].min(counts[1]) < SIMILAR_VIEW * counts[0].max(counts[1]) {
        return is_better(one, other);
    }
    one.mean_energy() < other.mean_energy()
}
