//! Why a run has tracked nothing, according to what its start saw.

use crate::service::results::mapping_load::is_overloaded;
use crate::service::results::record::RunRecord;
use crate::slam::counted::counted;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::evaluation::statistics::percentiles;
use crate::slam::keyframe::Keyframe;
use crate::slam::mapper::situation::StartFrame;
use crate::slam::pose::{LostReason, TrackingState};

/// Fewest frames with which a map can begin and one be tracked on it: a start is confirmed by its third.
const MIN_FRAMES: u64 = 5;

/// Why `record` has no tracked frame, and what to do; `None` where it has one.
pub fn why_untracked(record: &RunRecord) -> Option<String> {
    if record.poses.iter().any(|pose| pose.estimate.state.is_tracked()) {
        return None;
    }
    let frames_in = record.counters.frames_in.max(record.poses.len() as u64);
    if frames_in == 0 {
        return Some("the source delivered no frame".to_owned());
    }
    if record.depth_scale == DepthScale::Given && record.poses.is_empty() {
        return Some(
            "no frame has a true pose near its stamp; check that images and ground truth have the same clock"
                .to_owned(),
        );
    }
    let slowness = slowness(record, frames_in);
    if let Some((began, reason)) = lost_at_once(record) {
        let usual = || "move the camera more slowly, or raise the frame rate".to_owned();
        return Some(format!(
            "a map started at frame {began}, but the tracker lost it at once: {}; {}",
            loss_text(reason),
            slowness.unwrap_or_else(usual)
        ));
    }
    let all: u64 = record.start.0.values().sum();
    let most = record.start.0.iter().max_by_key(|(_, count)| **count);
    let (&seen, &count) = most.unwrap_or((&StartFrame::Begun, &0));
    // Nothing can be proven between frames that are far apart; darkness and a still camera show all the same.
    let is_far_apart =
        matches!(seen, StartFrame::Unmatched | StartFrame::Turned | StartFrame::LittleParallax);
    Some(match slowness.filter(|_| is_far_apart || all < MIN_FRAMES) {
        Some(slowness) => slowness,
        None if frames_in < MIN_FRAMES => too_few_text(frames_in),
        None if all == 0 => advice(seen).to_owned(),
        None => format!("{} ({count} of {all} frames of the start)", advice(seen)),
    })
}

fn too_few_text(frames: u64) -> String {
    format!(
        "{} {} too few: a map starts only after the camera has moved sideways for several frames",
        counted(frames, "frame"),
        if frames == 1 { "is" } else { "are" }
    )
}

/// For a run with lost frames: the frame on which its map began, and why the first one was lost. A frame is lost only
/// where there is a map.
fn lost_at_once(record: &RunRecord) -> Option<(u64, LostReason)> {
    let mut estimates = record.poses.iter().map(|pose| &pose.estimate);
    let (lost, reason) = estimates.find_map(|estimate| match estimate.state {
        TrackingState::Lost(reason) => Some((estimate, reason)),
        _ => None,
    })?;
    let is_its = |keyframe: &&Keyframe| {
        (keyframe.epoch, keyframe.keyframe_id) == (lost.epoch, lost.keyframe_id)
    };
    let keyframe = record.map.keyframes.iter().find(is_its);
    Some((keyframe.map_or(lost.sequence, |keyframe| keyframe.sequence), reason))
}

/// Set where a live run left out so many frames that the rest are too far apart.
fn slowness(record: &RunRecord, frames_in: u64) -> Option<String> {
    let skipped = frames_in.saturating_sub(record.map_nanos.len() as u64);
    if !is_overloaded(record.mode, skipped, frames_in) {
        return None;
    }
    let times = record.map_nanos.iter().map(|&n| n as f64 * 1e-6);
    let period_ms = record.recorded_nanos as f64 * 1e-6 / frames_in.saturating_sub(1).max(1) as f64;
    let [map_ms] = percentiles(times, [0.5]).unwrap_or_default();
    Some(format!(
        "the machine is too slow: the mapper had no time for {skipped} of {frames_in} frames \
         ({map_ms:.1} ms for one, one every {period_ms:.1} ms); lower the rate or the image size, give it more \
         CPUs, or use --lockstep for a recording"
    ))
}

fn loss_text(reason: LostReason) -> &'static str {
    match reason {
        LostReason::Diverged => "the view changed too much",
        LostReason::TooFewInliers => "too few points matched",
        LostReason::NoPoints => "its keyframe had no usable points",
        LostReason::UnusableFrame => "the images have no contrast",
        LostReason::MapRejected => "the map contradicted itself",
    }
}

fn advice(seen: StartFrame) -> &'static str {
    match seen {
        StartFrame::Begun => {
            "the start failed again and again; move the camera sideways, smoothly and for longer"
        }
        StartFrame::Dark => {
            "the images are dark and show no texture; add light or exposure, and check the lens cap"
        }
        StartFrame::Overexposed => {
            "the images are overexposed and show no texture; lower exposure or gain"
        }
        StartFrame::Textureless => {
            "the images show too little texture; point the camera at something with edges, and check its focus"
        }
        StartFrame::Unmatched => {
            "consecutive images differ too much; move more slowly, or raise the frame rate"
        }
        StartFrame::Still => "the camera stood still; move it sideways",
        StartFrame::Turned => {
            "the camera only turned; move it sideways, as depth comes from parallax"
        }
        StartFrame::LittleParallax => {
            "the camera moved too little, or towards what it sees; move it sideways by a few per cent of the distance"
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::service::recording::Recording;
    use crate::service::results::record::{RunCounters, RunMode};
    use crate::slam::frame::FrameView;
    use crate::slam::pose::PoseEstimate;
    use crate::wire::conversion::{PoseTiming, pose_message};

    /// A live run of `frames` frames without a map, in this state from its tenth frame on, of which the mapper mapped
    /// `handled` and found them too unlike the first.
    pub(in crate::service::results) fn record(
        frames: u64,
        handled: u64,
        state: TrackingState,
    ) -> RunRecord {
        let mut recording = Recording::default();
        for sequence in 0..frames {
            let frame = FrameView {
                sequence,
                capture_nanos: sequence as i64 * 100_000_000,
                exposure_nanos: 0,
                width: 0,
                height: 0,
                pixels: &[],
            };
            let mut estimate = PoseEstimate::unknown(&frame);
            if sequence >= 10 {
                (estimate.state, estimate.keyframe_id) = (state, 3);
            }
            recording.add_pose(&pose_message(&estimate, &PoseTiming::default())).unwrap();
        }
        const UNMATCHED: u32 = 5;
        (0..handled).for_each(|_| recording.add_step(40_000_000, 0, UNMATCHED));
        let counters = RunCounters { frames_in: frames, ..RunCounters::default() };
        recording.into_record(RunRecord { counters, ..RunRecord::empty(RunMode::Live, "x") }, 0.0)
    }

    #[test]
    fn one_frame_is_too_few() {
        let text = too_few_text;
        assert!(
            text(1).starts_with("1 frame is too few:") && text(3).starts_with("3 frames are too")
        );
    }

    #[test]
    fn a_source_without_frames_and_poses_at_other_times_are_named() {
        let none = record(0, 0, TrackingState::Initializing);
        assert_eq!(why_untracked(&none).unwrap(), "the source delivered no frame");
        let counters = RunCounters { frames_in: 60, ..RunCounters::default() };
        let given = RunRecord { counters, depth_scale: DepthScale::Given, ..none };
        assert!(why_untracked(&given).unwrap().starts_with("no frame has a true pose near its"));
    }

    #[test]
    fn lost_frames_show_that_a_map_began() {
        let lost = TrackingState::Lost(LostReason::TooFewInliers);
        let text = |record: &RunRecord| why_untracked(record).unwrap();
        let of_lost = text(&record(60, 60, lost));
        let expected = "a map started at frame 10, but the tracker lost it at once: too few points matched; move";
        assert!(of_lost.starts_with(expected), "{of_lost}");
        let slow = text(&record(60, 20, lost));
        assert!(slow.contains("lost it at once") && slow.contains("40 of 60 frames"), "{slow}");
        let without_map = text(&record(60, 60, TrackingState::Initializing));
        assert!(
            without_map.contains("differ too much") && without_map.contains("(60 of 60"),
            "{without_map}"
        );
        assert!(text(&record(60, 20, TrackingState::Initializing)).contains("too slow"));
        assert_eq!(why_untracked(&record(60, 60, TrackingState::Tracking)), None);
    }
}
