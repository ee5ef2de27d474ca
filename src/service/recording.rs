//! Poses, times and counts collected during a run, until they become a record.

use crate::service::adjustments::AdjustmentRecord;
use crate::service::results::record::{RecordedPose, RunMode, RunRecord, StartTally};
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::pose::TrackingState;
use crate::wire::conversion::{MessageError, pose_from_message, start_frame_from_code};
use crate::wire::message::PoseMessage;

/// Poses and steps of a run so far.
#[derive(Debug, Default)]
pub struct Recording {
    /// The newest; earlier ones were released.
    poses: Vec<RecordedPose>,
    num_released: usize,
    /// State of the last frame.
    pub state: Option<TrackingState>,
    map_nanos: Vec<u64>,
    keyframe_step_nanos: Vec<u64>,
    keyframe_nanos: Vec<u64>,
    adjustments: Vec<AdjustmentRecord>,
    start: StartTally,
    /// CLOCK_MONOTONIC of the first frame and of the last pose.
    span_nanos: Option<(i64, i64)>,
}

impl Recording {
    /// Takes in a pose as it was sent.
    pub fn add_pose(&mut self, message: &PoseMessage) -> Result<(), MessageError> {
        let pose = recorded(message)?;
        let latency = i64::try_from(message.latency_nanos).unwrap_or(i64::MAX);
        let sent_nanos = message.published_nanos.saturating_sub(latency);
        let first = self.span_nanos.map_or(sent_nanos, |(first, _)| first);
        self.span_nanos = Some((first, message.published_nanos));
        self.state = Some(pose.estimate.state);
        self.poses.push(pose);
        Ok(())
    }

    /// Drops the first `num_kept` poses of the run, which are kept elsewhere: a kilobyte each.
    pub fn release(&mut self, num_kept: usize) {
        /// Capacity for this many is not given back.
        const SPARE: usize = 256;
        let count = num_kept.saturating_sub(self.num_released).min(self.poses.len());
        if count > 0 {
            self.poses.drain(..count);
            self.num_released += count;
            // After the disk was full for long.
            self.poses.shrink_to(2 * self.poses.len() + SPARE);
        }
    }

    /// Poses that were released and not taken back.
    pub fn num_released(&self) -> usize {
        self.num_released
    }

    /// Takes back the released poses, which `read` gives in order; returns how many are lost.
    pub fn restore_released(&mut self, read: impl FnOnce(&mut dyn FnMut(&PoseMessage))) -> usize {
        let mut poses = Vec::with_capacity(self.num_poses());
        // They were valid when they arrived.
        read(&mut |message| poses.extend(recorded(message)));
        let missing = self.num_released.saturating_sub(poses.len());
        poses.append(&mut self.poses);
        (self.poses, self.num_released) = (poses, 0);
        missing
    }

    /// Takes in a step of the mapper: its duration, `change_nanos` (0 where no keyframe was made), and the code of the
    /// frame's outcome in a start.
    pub fn add_step(&mut self, step_nanos: u64, change_nanos: u64, start_frame: u32) {
        self.start.count(start_frame_from_code(start_frame));
        self.map_nanos.push(step_nanos);
        if change_nanos > 0 {
            self.keyframe_step_nanos.push(step_nanos);
            self.keyframe_nanos.push(change_nanos);
        }
    }

    /// Takes in a finished joint estimate of keyframes.
    pub fn add_adjustment(&mut self, adjustment: AdjustmentRecord) {
        self.adjustments.push(adjustment);
    }

    /// Poses so far.
    pub fn num_poses(&self) -> usize {
        self.num_released + self.poses.len()
    }

    /// Steps of the mapper so far.
    pub fn num_steps(&self) -> usize {
        self.map_nanos.len()
    }

    /// The record of the whole run, once all released poses have been taken back. `known` has what is not collected;
    /// `deadline_ms` is the tracker's configured deadline.
    pub fn into_record(mut self, known: RunRecord, deadline_ms: f64) -> RunRecord {
        let frames_in = known.counters.frames_in;
        let stamps = |pose: Option<&RecordedPose>| pose.map_or(0, |p| p.estimate.capture_nanos);
        let (first, last) = (stamps(self.poses.first()), stamps(self.poses.last()));
        let positive = |nanos: i64| u64::try_from(nanos).unwrap_or(0);
        let recorded_nanos = positive(last.saturating_sub(first));
        let period_nanos = recorded_nanos / frames_in.saturating_sub(1).max(1);
        let deadline_nanos =
            if deadline_ms > 0.0 { (deadline_ms * 1e6) as u64 } else { period_nanos / 2 };
        let (is_live, is_replay) = (known.mode == RunMode::Live, known.mode == RunMode::Replay);
        let wall_nanos = self.span_nanos.map_or(0, |(first, last)| last.saturating_sub(first));
        if is_replay {
            // A single process sends nothing.
            self.poses.iter_mut().for_each(|p| (p.latency_nanos, p.wake_nanos) = (None, None));
        }
        if known.depth_scale == DepthScale::Given {
            self.poses.iter_mut().for_each(|pose| pose.track_nanos = None);
        }
        let skipped = self.poses.len().saturating_sub(self.map_nanos.len());
        RunRecord {
            frames_dropped: frames_in.saturating_sub(self.poses.len() as u64),
            poses: self.poses,
            frames_skipped_by_mapper: (!is_replay).then_some(skipped as u64),
            deadline_nanos: is_live.then_some(deadline_nanos),
            map_nanos: self.map_nanos,
            keyframe_step_nanos: self.keyframe_step_nanos,
            keyframe_nanos: self.keyframe_nanos,
            adjustments: self.adjustments,
            start: self.start,
            recorded_nanos,
            wall_nanos: positive(wall_nanos),
            ..known
        }
    }
}

/// A pose as it was sent.
fn recorded(message: &PoseMessage) -> Result<RecordedPose, MessageError> {
    Ok(RecordedPose {
        estimate: pose_from_message(message)?,
        latency_nanos: Some(message.latency_nanos),
        track_nanos: Some(message.track_nanos),
        trace: None,
        wake_nanos: Some(message.wake_nanos),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::results::record::RunCounters;
    use crate::service::results::summary::{PointCounts, Summary};
    use crate::slam::evaluation::depth_error::DepthErrors;
    use crate::slam::frame::FrameView;
    use crate::slam::pose::PoseEstimate;
    use crate::wire::conversion::{PoseTiming, pose_message};

    /// The message of frame `sequence`, every figure distinct.
    fn message(sequence: u64) -> PoseMessage {
        let frame = FrameView {
            sequence,
            capture_nanos: 33 * sequence as i64,
            exposure_nanos: 0,
            width: 0,
            height: 0,
            pixels: &[],
        };
        let timing = PoseTiming { latency_nanos: 7 * sequence, ..PoseTiming::default() };
        let mut estimate = PoseEstimate::unknown(&frame);
        if sequence > 5 {
            (estimate.state, estimate.keyframe_id) = (TrackingState::Tracking, sequence / 9);
        }
        estimate.covariance[20] = 1.0 / (1.0 + sequence as f64);
        pose_message(&estimate, &timing)
    }

    #[test]
    fn only_a_live_run_has_a_deadline_and_page_faults_that_may_cost_it() {
        let record = |mode| {
            let counters = RunCounters { page_faults: 3, ..RunCounters::default() };
            let known = RunRecord { counters, ..RunRecord::empty(mode, "x") };
            let record = Recording::default().into_record(known, 5.0);
            let points = PointCounts::default();
            let depth = DepthErrors::default();
            let summary = Summary::new(&record, points, None, None, [None; 3], depth);
            (summary.page_faults, record.deadline_nanos)
        };
        assert_eq!(record(RunMode::Live), (Some(3), Some(5_000_000)));
        assert_eq!(record(RunMode::Lockstep), (None, None));
        assert_eq!(record(RunMode::Replay), (None, None));
    }

    #[test]
    fn released_and_taken_back_poses_give_the_same_record() {
        let messages: Vec<PoseMessage> = (0..900).map(message).collect();
        let (mut whole, mut released) = (Recording::default(), Recording::default());
        for (number, message) in messages.iter().enumerate() {
            whole.add_pose(message).unwrap();
            released.add_pose(message).unwrap();
            if number % 7 == 0 {
                // Only existing poses are released.
                released.release(if number > 800 { 2000 } else { number / 2 });
            }
            assert_eq!(released.num_poses(), number + 1);
            assert_eq!(released.state, whole.state);
        }
        let num_released = released.num_released();
        assert!(num_released > 800 && released.poses.capacity() < 600, "{num_released}");
        let missing =
            released.restore_released(|take| messages[..num_released].iter().for_each(take));
        assert_eq!((missing, released.num_released()), (0, 0));
        assert_eq!(format!("{released:?}"), format!("{whole:?}"));
        released.release(10);
        let missing = released.restore_released(|take| messages[..8].iter().for_each(take));
        assert_eq!((missing, released.num_poses()), (2, 898));
    }
}
