//! Figures of the joint estimation of keyframes.

use serde::{Deserialize, Serialize};

use crate::service::adjustments::{AdjustmentRecord, Fate};
use crate::service::results::times::Percentiles;
use crate::slam::evaluation::statistics::percentiles;

/// The joint estimates of a run. There are none where it is switched off, or without a second keyframe.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct JointSummary {
    /// Estimates that entered the map.
    pub adjustments: u64,
    /// Those of them that entered a map with newer keyframes, which moved along.
    pub adjustments_merged: u64,
    /// Estimates dropped because the map had changed: it was rejected, joined to another, or belongs to another camera.
    pub adjustments_dropped: u64,
    /// CPU time of an estimate.
    pub adjustment_ms: Option<Percentiles>,
    /// Most frames between a keyframe and the entry of its estimate.
    pub adjustment_frames_max: Option<u64>,
    /// Median over the estimates of the share of comparisons, each of a point with a keyframe, that agree.
    pub adjustment_inlier_ratio_median: Option<f64>,
    /// Median over the estimates of the root mean square of their residuals, grey levels.
    pub adjustment_rms_grey_median: Option<f64>,
}

impl JointSummary {
    /// Summarises the estimates of a run.
    pub fn of(records: &[AdjustmentRecord]) -> Self {
        let count = |fates: &[Fate]| {
            records.iter().filter(|record| fates.contains(&record.fate)).count() as u64
        };
        let median = |value: fn(&AdjustmentRecord) -> f64| {
            percentiles(records.iter().map(value), [0.5]).map(|[median]| median)
        };
        Self {
            adjustments: count(&[Fate::Entered, Fate::Merged]),
            adjustments_merged: count(&[Fate::Merged]),
            adjustments_dropped: count(&[Fate::Dropped]),
            adjustment_ms: Percentiles::of(records.iter().map(|record| record.nanos)),
            adjustment_frames_max: records.iter().map(|record| record.frames).max(),
            adjustment_inlier_ratio_median: median(|record| record.adjustment.inlier_ratio),
            adjustment_rms_grey_median: median(|record| record.adjustment.rms_grey),
        }
    }
}
