//! What is known of a run when it ends.

use std::collections::BTreeMap;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use crate::service::adjustments::{AdjustmentRecord, SearchRecord};
use crate::service::alignment_stamps::AlignmentTrace;
use crate::service::results::budget_curve::BudgetSample;
use crate::service::time_counts::TimeCounts;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::map::Map;
use crate::slam::mapper::consistency::Contradiction;
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

/// A pose as the tracker gave it, with what it cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedPose {
    /// The tracking result.
    pub estimate: PoseEstimate,
    /// From the frame's stamp to the publication; `None` where stamps are of another clock.
    pub latency_nanos: Option<u64>,
    /// Time in the tracker; `None` where the pose was given.
    pub track_nanos: Option<u64>,
    /// What its parts took; `None` where the frame was not aligned in this process.
    pub trace: Option<AlignmentTrace>,
    /// From the frame's sending to the tracker's look at it; `None` in one process.
    pub wake_nanos: Option<u64>,
}

/// What frames came to while there was no map, counted.
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

/// The map was found to contradict itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rejection {
    /// Sequence of the frame that showed it.
    pub sequence: u64,
    /// How.
    pub contradiction: Contradiction,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum EndOfRun {
    /// With the end of the source.
    #[default]
    Finished,
    /// By a signal.
    Interrupted,
    /// Because something failed; says what.
    Failed(String),
    /// It was killed at about this time: this is what its journal has of it.
    Recovered(SystemTime),
}

/// Why a process was started again, and how often for this.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RestartCause {
    /// The process.
    pub process: String,
    /// What had ended it, in one line.
    pub cause: String,
    /// How often.
    pub count: u64,
}

/// Everything that is known of a run when it ends.
#[derive(Debug, Clone, Default)]
pub struct RunRecord {
    /// How it was driven.
    pub mode: RunMode,
    /// Where the frames came from, as the user named it.
    pub source: String,
    /// How it ended.
    pub ended: EndOfRun,
    /// One for each frame that reached the tracker, in order.
    pub poses: Vec<RecordedPose>,
    /// The map at the end.
    pub map: Map,
    /// True poses in order of their stamps, empty where there are none.
    pub ground_truth: Vec<StampedPose>,
    /// Where metres come from when depth is compared.
    pub depth_scale: DepthScale,
    /// Whether keyframes took their first depth from the source's depth camera: held against that camera, it
    /// tells nothing.
    pub is_depth_from_sensor: bool,
    /// Frames that the source gave.
    pub frames_in: u64,
    /// Images of the source that could not be used and were left out.
    pub frames_refused: u64,
    /// Which of them was the first, and why.
    pub refused: Option<String>,
    /// Frames that the tracker never saw because a newer one had come.
    pub frames_dropped: u64,
    /// Places where the source's sequence has a hole.
    pub gaps: u64,
    /// Processes that were started again.
    pub restarts: u64,
    /// Which, and why; empty in one process.
    pub restart_causes: Vec<RestartCause>,
    /// Frames with a pose that the mapper did not take in because newer ones had come; `None` in one process.
    pub frames_skipped_by_mapper: Option<u64>,
    /// Time that the tracker was allowed for a frame; `None` without a deadline.
    pub deadline_nanos: Option<u64>,
    /// Frames published after the deadline; `None` without one.
    pub deadline_misses: Option<u64>,
    /// How late capture sent frames after their stamp; `None` but of live runs.
    pub send_counts: Option<TimeCounts>,
    /// Page faults of the tracker's frame loop since it was warm; `None` in one process.
    pub page_faults: Option<u64>,
    /// Time in the mapper, one for each frame it handled.
    pub map_nanos: Vec<u64>,
    /// Of them, those of the steps that changed to a new keyframe.
    pub keyframe_step_nanos: Vec<u64>,
    /// Of each of those, the time from the observed frame to a keyframe that others can have: carrying,
    /// smoothing, live also publishing.
    pub keyframe_nanos: Vec<u64>,
    /// Joint estimates of keyframes, in the order of their entry.
    pub adjustments: Vec<AdjustmentRecord>,
    /// Searches for places that were seen before; `None` where they are not told of.
    pub searches: Option<Vec<SearchRecord>>,
    /// What frames came to while there was no map.
    pub start: StartTally,
    /// Frames at which the map was found to contradict itself, and how; known in a replay.
    pub rejections: Option<Vec<Rejection>>,
    /// Frames that were aligned again with fewer iterations; empty where none were.
    pub budget_samples: Vec<BudgetSample>,
    /// First to last stamp.
    pub recorded_nanos: u64,
    /// Time that the run took, without the preparation of the source and frames aligned again.
    pub wall_nanos: u64,
    /// Largest resident memory of all processes together.
    pub peak_rss_bytes: Option<u64>,
}

impl RunRecord {
    /// Of a run that has not begun.
    pub fn empty(mode: RunMode, source: &str) -> Self {
        Self { mode, source: source.to_owned(), ..Self::default() }
    }
}
