//! The record of a run at its end.

use std::collections::BTreeMap;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use crate::service::adjustments::{AdjustmentRecord, SearchRecord};
use crate::service::alignment_stamps::AlignmentTrace;
use crate::service::results::budget_curve::BudgetSample;
use crate::service::time_counts::TimeCounts;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;
use crate::slam::mapper::situation::StartFrame;
use crate::slam::pose::PoseEstimate;
use crate::slam::trajectory::StampedPose;

/// How a run was driven.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RunMode {
    /// One process, every frame in order.
    #[default]
    Replay,
    /// Processes over shared memory, every frame in order.
    Lockstep,
    /// Processes over shared memory, the newest frame wins.
    Live,
}

/// A pose as the tracker produced it, with its cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedPose {
    /// The tracking result.
    pub estimate: PoseEstimate,
    /// From the frame's stamp to the publication; `None` where stamps use another clock.
    pub latency_nanos: Option<u64>,
    /// Time in the tracker; `None` where the pose was given.
    pub track_nanos: Option<u64>,
    /// Times of its parts; `None` where the frame was not aligned in this process.
    pub trace: Option<AlignmentTrace>,
    /// From the frame's sending to its pick-up by the tracker; `None` in one process.
    pub wake_nanos: Option<u64>,
}

/// Counts of the outcomes of frames while there was no map.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct StartTally(pub BTreeMap<StartFrame, u64>);

impl StartTally {
    /// Counts a frame, unless a start began on it.
    pub fn count(&mut self, frame: Option<StartFrame>) {
        if let Some(frame) = frame.filter(|frame| *frame != StartFrame::Begun) {
            *self.0.entry(frame).or_default() += 1;
        }
    }
}

/// A contradiction found in the map.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rejection {
    /// Sequence of the frame that revealed it.
    pub sequence: u64,
    /// The contradiction, in words.
    pub reason: String,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum EndOfRun {
    /// At the end of the source.
    #[default]
    Finished,
    /// By a signal.
    Interrupted,
    /// Because of this failure.
    Failed(String),
    /// It was killed at about this time: these are the contents of its journal.
    Recovered(SystemTime),
}

/// Why a process was restarted, and how often for this reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RestartCause {
    /// The process.
    pub process: String,
    /// What ended it, in one line.
    pub cause: String,
    /// How often.
    pub count: u64,
}

/// Counts of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct RunCounters {
    /// Frames that the source delivered.
    pub frames_in: u64,
    /// Images of the source that could not be used and were left out.
    pub frames_refused: u64,
    /// Largest factor on the grey levels of dim images; `None` where brightening is off.
    pub brightened_by: Option<u8>,
    /// Gaps in the source's sequence.
    pub gaps: u64,
    /// Processes that were restarted.
    pub restarts: u64,
    /// Live: frames published after the deadline.
    pub deadline_misses: u64,
    /// Live: page faults of the tracker's frame loop since it was warm.
    pub page_faults: u64,
    /// Largest resident memory of all processes together, bytes; 0 where it is unknown.
    pub peak_rss_bytes: u64,
    /// Live: how long after its stamp capture sent each frame.
    pub send_counts: TimeCounts,
}

impl RunCounters {
    /// Adds the frame counts of one process.
    pub fn add(&mut self, counted: &Self) {
        self.frames_in += counted.frames_in;
        self.frames_refused += counted.frames_refused;
        self.brightened_by = self.brightened_by.max(counted.brightened_by);
        self.gaps += counted.gaps;
        self.deadline_misses += counted.deadline_misses;
        self.page_faults += counted.page_faults;
        self.send_counts.add(&counted.send_counts);
    }
}

/// A map that a running mapper was switched to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LoadedMap {
    /// Its folder.
    pub folder: String,
    /// Whether the camera is only localised in it.
    pub read_only: bool,
    /// The run's first epoch in it: those below belong to the map before.
    pub first_epoch: u32,
    /// First id of a keyframe made in it by the run.
    pub first_keyframe_id: u64,
}

/// Everything that is recorded of a run.
#[derive(Debug, Clone, Default)]
pub struct RunRecord {
    /// How it was driven.
    pub mode: RunMode,
    /// Source of the frames, as the user named it.
    pub source: String,
    /// How it ended.
    pub ended: EndOfRun,
    /// One per frame that reached the tracker, in order.
    pub poses: Vec<RecordedPose>,
    /// The map at the end.
    pub map: Map,
    /// The map that was loaded on request during the run.
    pub loaded_map: Option<LoadedMap>,
    /// First id of a keyframe made in this run: those below are of earlier runs in its map.
    pub first_keyframe_id: u64,
    /// True poses in order of their stamps, empty where there are none.
    pub ground_truth: Vec<StampedPose>,
    /// Source of the metric scale when depth is compared.
    pub depth_scale: DepthScale,
    /// Whether keyframes took their first depth from the source's depth camera: a comparison with that camera then
    /// shows nothing.
    pub is_depth_from_sensor: bool,
    /// Counts of frames, processes and faults.
    pub counters: RunCounters,
    /// The first of the images that could not be used, and why.
    pub refused: Option<String>,
    /// Frames that the tracker never saw because a newer one had arrived.
    pub frames_dropped: u64,
    /// Which processes, and why; empty in one process.
    pub restart_causes: Vec<RestartCause>,
    /// Frames with a pose that the mapper skipped because newer ones had arrived; `None` in one process.
    pub frames_skipped_by_mapper: Option<u64>,
    /// Time allowed to the tracker for a frame; `None` without a deadline.
    pub deadline_nanos: Option<u64>,
    /// Time in the mapper, one per frame it mapped.
    pub map_nanos: Vec<u64>,
    /// Those of the steps that changed to a new keyframe.
    pub keyframe_step_nanos: Vec<u64>,
    /// For each of those, the time from the observed frame to a keyframe that other processes can use: propagating,
    /// smoothing, live also publishing.
    pub keyframe_nanos: Vec<u64>,
    /// Joint estimates of keyframes, in the order of their entry.
    pub adjustments: Vec<AdjustmentRecord>,
    /// Searches for places that were seen before; `None` where they are not reported.
    pub searches: Option<Vec<SearchRecord>>,
    /// Outcomes of frames while there was no map.
    pub start: StartTally,
    /// Frames at which the map was found to contradict itself, and how; replay only.
    pub rejections: Option<Vec<Rejection>>,
    /// Frames realigned with fewer iterations; empty where none were.
    pub budget_samples: Vec<BudgetSample>,
    /// From the first to the last stamp.
    pub recorded_nanos: u64,
    /// Duration of the run, without the preparation of the source and the realigned frames.
    pub wall_nanos: u64,
}

impl RunRecord {
    /// The record of a run that has not begun.
    pub fn empty(mode: RunMode, source: &str) -> Self {
        Self { mode, source: source.to_owned(), ..Self::default() }
    }

    /// The keyframes made in this run; what it is compared with knows nothing of earlier runs.
    pub fn own_keyframes(&self) -> impl Iterator<Item = &Keyframe> {
        self.map.keyframes.iter().filter(|keyframe| keyframe.keyframe_id >= self.first_keyframe_id)
    }
}
