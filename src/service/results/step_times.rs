//! Time in the tracker and in the mapper for a frame.

use serde::{Deserialize, Serialize};

use crate::service::results::alignment_levels::{LevelSummary, alignment_levels};
use crate::service::results::record::RunRecord;
use crate::service::results::times::{Percentiles, track_nanos};

/// Times of the steps of a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepTimes {
    /// Time in the tracker for a frame.
    pub track_ms: Option<Percentiles>,
    /// The part from the frame to the first iteration: the image pyramid, apart from a few microseconds. Replay only.
    pub pyramid_ms: Option<Percentiles>,
    /// Cost of alignment on each pyramid level, finest first. Replay only.
    pub alignment_levels: Option<Vec<LevelSummary>>,
    /// Time in the mapper for a frame.
    pub map_ms: Option<Percentiles>,
    /// That of the steps that changed to a new keyframe.
    pub keyframe_step_ms: Option<Percentiles>,
    /// The part of those from the observed frame to a keyframe that other processes can use: propagating, smoothing,
    /// live also publishing. What follows, depth for new pixels, is published as its next revision.
    pub keyframe_ms: Option<Percentiles>,
}

impl StepTimes {
    /// The times of `record`.
    pub fn of(record: &RunRecord) -> Self {
        let traces: Vec<_> = record.poses.iter().filter_map(|pose| pose.trace).collect();
        Self {
            track_ms: Percentiles::of(track_nanos(&record.poses)),
            pyramid_ms: Percentiles::of(traces.iter().map(|trace| trace.pyramid_nanos)),
            alignment_levels: alignment_levels(&traces),
            map_ms: Percentiles::of(record.map_nanos.iter().copied()),
            keyframe_step_ms: Percentiles::of(record.keyframe_step_nanos.iter().copied()),
            keyframe_ms: Percentiles::of(record.keyframe_nanos.iter().copied()),
        }
    }
}
