//! Collects what a run publishes until its results are written.

use crate::service::mode::Mode;
use crate::service::results::{RecordedPose, RunMode, RunRecord};
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::mapper::Map;
use crate::slam::pose::TrackingState;
use crate::slam::trajectory::StampedPose;
use crate::wire::conversion::pose_from_message;
use crate::wire::message::{PoseMessage, StepMessage};
use crate::wire::port::{Events, Hub, OpenError, ReceiveError, Subscriber};
use crate::wire::topic::{POSE, STEP};

/// Poses and steps as they come in.
#[derive(Debug)]
pub struct Recorder {
    poses: Subscriber<PoseMessage, ()>,
    steps: Subscriber<StepMessage, ()>,
    recorded: Vec<RecordedPose>,
    map_nanos: Vec<u64>,
    keyframe_step_nanos: Vec<u64>,
    keyframe_nanos: Vec<u64>,
    last_step: Option<StepMessage>,
    /// CLOCK_MONOTONIC of the first frame and of the last pose.
    span_nanos: Option<(i64, i64)>,
}

/// What only the supervisor knows of a run.
#[derive(Debug, Clone, Copy, Default)]
pub struct RunCounters {
    /// Frames that capture sent.
    pub frames_in: u64,
    /// Holes in the source's sequence.
    pub gaps: u64,
    /// Processes that were started again.
    pub restarts: u64,
    /// Frames published after the deadline.
    pub deadline_misses: u64,
    /// Page faults of the tracker's frame loop since it was warm.
    pub page_faults: u64,
    /// Largest resident memory of all processes together, bytes.
    pub peak_rss_bytes: u64,
}

impl Recorder {
    /// Listens from now on.
    pub fn open(hub: &Hub) -> Result<Self, OpenError> {
        Ok(Self {
            poses: hub.subscriber(&POSE)?,
            steps: hub.subscriber(&STEP)?,
            recorded: Vec::new(),
            map_nanos: Vec::new(),
            keyframe_step_nanos: Vec::new(),
            keyframe_nanos: Vec::new(),
            last_step: None,
            span_nanos: None,
        })
    }

    /// Wakes with every pose.
    pub fn events(&self) -> &Events {
        self.poses.events()
    }

    /// Takes in everything that came; whether that was anything.
    pub fn collect(&mut self) -> Result<bool, ReceiveError> {
        let before = self.recorded.len() + self.map_nanos.len();
        while let Some(message) = self.poses.receive()? {
            if let Some(pose) = message.payload().first() {
                self.take_pose(pose);
            }
        }
        while let Some(message) = self.steps.receive()? {
            let Some(step) = message.payload().first() else { continue };
            self.map_nanos.push(step.step_nanos);
            if step.change_nanos > 0 {
                self.keyframe_step_nanos.push(step.step_nanos);
                self.keyframe_nanos.push(step.change_nanos);
            }
            self.last_step = Some(*step);
        }
        Ok(self.recorded.len() + self.map_nanos.len() > before)
    }

    fn take_pose(&mut self, message: &PoseMessage) {
        match pose_from_message(message) {
            Err(error) => tracing::warn!("tracker/pose: {error}"),
            Ok(estimate) => {
                let latency = i64::try_from(message.latency_nanos).unwrap_or(i64::MAX);
                let sent_nanos = message.published_nanos.saturating_sub(latency);
                let first = self.span_nanos.map_or(sent_nanos, |(first, _)| first);
                self.span_nanos = Some((first, message.published_nanos));
                self.recorded.push(RecordedPose {
                    estimate,
                    latency_nanos: Some(message.latency_nanos),
                    track_nanos: Some(message.track_nanos),
                    trace: None,
                    wake_nanos: Some(message.wake_nanos),
                });
            }
        }
    }

    /// Poses so far.
    pub fn num_poses(&self) -> usize {
        self.recorded.len()
    }

    /// State of the last frame.
    pub fn state(&self) -> Option<TrackingState> {
        self.recorded.last().map(|pose| pose.estimate.state)
    }

    /// What the mapper said last.
    pub fn last_step(&self) -> Option<&StepMessage> {
        self.last_step.as_ref()
    }

    /// The record of the whole run.
    pub fn into_record(
        self,
        mode: Mode,
        source: String,
        map: Map,
        ground_truth: Vec<StampedPose>,
        deadline_ms: f64,
        counters: &RunCounters,
    ) -> RunRecord {
        let stamps = |pose: Option<&RecordedPose>| pose.map_or(0, |p| p.estimate.capture_nanos);
        let (first, last) = (stamps(self.recorded.first()), stamps(self.recorded.last()));
        let positive = |nanos: i64| u64::try_from(nanos).unwrap_or(0);
        let recorded_nanos = positive(last.saturating_sub(first));
        let period_nanos = recorded_nanos / counters.frames_in.saturating_sub(1).max(1);
        let deadline_nanos =
            if deadline_ms > 0.0 { (deadline_ms * 1e6) as u64 } else { period_nanos / 2 };
        let is_live = mode == Mode::Live;
        let wall_nanos = self.span_nanos.map_or(0, |(first, last)| last.saturating_sub(first));
        RunRecord {
            mode: if is_live { RunMode::Live } else { RunMode::Lockstep },
            source,
            frames_in: counters.frames_in,
            frames_dropped: counters.frames_in.saturating_sub(self.recorded.len() as u64),
            poses: self.recorded,
            map,
            ground_truth,
            depth_scale: DepthScale::MedianRatio,
            gaps: counters.gaps,
            restarts: counters.restarts,
            deadline_nanos: is_live.then_some(deadline_nanos),
            deadline_misses: is_live.then_some(counters.deadline_misses),
            page_faults: Some(counters.page_faults),
            map_nanos: self.map_nanos,
            keyframe_step_nanos: self.keyframe_step_nanos,
            keyframe_nanos: self.keyframe_nanos,
            rejections: None,
            budget_samples: Vec::new(),
            recorded_nanos,
            wall_nanos: positive(wall_nanos),
            peak_rss_bytes: Some(counters.peak_rss_bytes),
        }
    }
}
