//! The summary as the few lines that a run prints when it ends.

use std::fmt::Write;

use crate::service::results::joint::JointSummary;
use crate::service::results::loops::LoopSummary;
use crate::service::results::record::Rejection;
use crate::service::results::summary::{DepthSummary, Summary, TrajectorySummary};
use crate::service::results::times::Percentiles;
use crate::slam::counted::counted;
use crate::slam::evaluation::grade::Grade;

/// The lines, each with its end.
pub fn summary_text(summary: &Summary) -> String {
    let mut lines = Lines(String::new());
    lines.add("frames", [frames(summary)]);
    lines.add("images", summary.refused.clone());
    let brightened = summary.brightened_by.filter(|factor| *factor > 1);
    lines.add(
        "images",
        brightened.map(|by| format!("dim: their grey levels were multiplied by up to {by}")),
    );
    lines.add("map", [map(summary)]);
    let restarts = summary.restart_causes.iter();
    lines.add("restarts", restarts.map(|of| format!("{} {}: {}", of.count, of.process, of.cause)));
    let rejections = summary.map_rejections.iter().flatten();
    let rejected = |of: &Rejection| format!("map at frame {}: {}", of.sequence, of.reason);
    lines.add("rejected", rejections.map(rejected).chain(withdrawn(summary)));
    lines.add("errors", evaluated(summary));
    lines.add("trajectory", trajectory_errors(&summary.trajectory));
    lines.add("online", trajectory_errors(&summary.online));
    // Depth that no frame has confirmed is not judged.
    lines.add("depth", depth_errors(&summary.depth).filter(|_| !is_unproven(summary)));
    lines.add("tracking", summary.times.track_ms.as_ref().map(times_text));
    lines.add("mapping", summary.times.map_ms.as_ref().map(times_text));
    lines.add("keyframe", summary.times.keyframe_ms.as_ref().map(times_text));
    lines.add("sent after", summary.send_ms.as_ref().map(times_text));
    lines.add("latency", summary.latency.latency_ms.as_ref().map(times_text));
    lines.add("joint", joint_text(&summary.joint));
    lines.add("loops", loops_text(&summary.loops));
    lines.add("deadline", deadline(summary));
    lines.add("run", [run(summary)]);
    lines.add("grade", [grade_text(&summary.grade)]);
    lines.0
}

/// Lines of a name and a value.
struct Lines(String);

impl Lines {
    /// Adds a line for each value.
    fn add(&mut self, name: &str, values: impl IntoIterator<Item = String>) {
        for value in values {
            // Writing to a string cannot fail.
            let _ = writeln!(self.0, "{name:<11} {value}");
        }
    }
}

/// The contents of the map.
fn map(summary: &Summary) -> String {
    let without_depth = match summary.keyframes_without_depth {
        0 => String::new(),
        count => format!(" ({count} without depth)"),
    };
    let unproven = if is_unproven(summary) { "; no frame was tracked on it" } else { "" };
    format!(
        "{}{without_depth}, {} fused to {} in map.ply, epoch {}{unproven}",
        counted(summary.keyframes, "keyframe"),
        counted(summary.point_counts.points, "certain point"),
        summary.point_counts.map_points,
        summary.epoch
    )
}

/// Frames that were tracked on keyframes rejected afterwards; `None` without any.
fn withdrawn(summary: &Summary) -> Option<String> {
    let frames = Some(summary.frames.frames_withdrawn).filter(|&frames| frames > 0)?;
    let frames = counted(frames, "frame");
    Some(format!("{frames} on rejected keyframes, left out of trajectory.txt"))
}

/// Whether there is a map that no frame has confirmed: it began with the last frames, was lost at once, or the camera
/// was not located in it.
pub(super) fn is_unproven(summary: &Summary) -> bool {
    summary.frames.frames_tracked == 0 && summary.keyframes > 0
}

/// The epoch of the errors that follow; `None` where there is only one epoch.
fn evaluated(summary: &Summary) -> Option<String> {
    let epoch = summary.evaluated_epoch.filter(|_| summary.epochs > 1)?;
    Some(format!("below are those of epoch {epoch}, the longest of {}", summary.epochs))
}

/// Poses that were late; `None` without a deadline.
fn deadline(summary: &Summary) -> Option<String> {
    let (deadline_ms, misses) = (summary.deadline_ms?, summary.deadline_misses?);
    let late = counted(misses, "pose");
    Some(format!("{late} later than {deadline_ms:.2} ms after the frame arrived"))
}

fn depth_errors(depth: &DepthSummary) -> Option<String> {
    let all = 100.0 * depth.depth_relative_error_median?;
    let best = 100.0 * depth.depth_relative_error_median_best_half?;
    let scales = depth
        .depth_scale_ratio
        .map(|ratio| format!(", depth scales of the keyframes agree to a factor of {ratio:.2}"));
    let scales = scales.unwrap_or_default();
    Some(format!(
        "median relative error {all:.1} %, {best:.1} % over the more certain half{scales}"
    ))
}

/// The level and at most two reasons; the report lists what it cannot see.
fn grade_text(grade: &Grade) -> String {
    let reasons: Vec<&str> = grade.reasons.iter().take(2).map(String::as_str).collect();
    format!("{}: {}", grade.level.name(), reasons.join("; "))
}

/// Part of a recovery's last line, on the run; empty for any other run.
pub fn recovery_text(summary: &Summary) -> String {
    summary.recovered_run_end.as_ref().map_or(String::new(), |end| {
        format!(", recovered from the journal of a run that ended at {end}")
    })
}

/// Part of a run's last line, on unusable images; empty where all were usable.
pub fn refused_text(summary: &Summary) -> String {
    match summary.frames_refused {
        0 => String::new(),
        refused => {
            let all = refused + summary.frames_in;
            format!("; {refused} of {all} images could not be used and were left out")
        }
    }
}

fn frames(summary: &Summary) -> String {
    let initialised = match summary.initialization_secs {
        Some(secs) => format!("initialised after {secs:.2} s"),
        None if summary.frames.frames_lost > 0 || is_unproven(summary) => {
            "no frame was tracked on the map".to_owned()
        }
        None => "never initialised".to_owned(),
    };
    let skipped = match summary.frames_skipped_by_mapper {
        None | Some(0) => String::new(),
        Some(frames) => format!(", {frames} skipped by the mapper"),
    };
    let lost = match (summary.frames.frames_lost, summary.lost_count) {
        (0, 0) => "never lost".to_owned(),
        (frames, 0 | 1) => format!("{frames} lost"),
        (frames, times) => format!("{frames} lost ({times} times)"),
    };
    let before = match summary.frames.frames_initializing {
        0 => String::new(),
        frames => format!("{frames} before the map, "),
    };
    let later = match summary.frames.frames_tracked_later {
        0 => String::new(),
        frames => format!(" ({frames} of them afterwards)"),
    };
    format!(
        "{} in, {before}{} tracked{later}, {lost}, {} dropped, {}{skipped}; {initialised}",
        summary.frames_in,
        summary.frames.frames_tracked,
        summary.frames_dropped,
        counted(summary.gaps, "gap")
    )
}

fn trajectory_errors(trajectory: &TrajectorySummary) -> Option<String> {
    let (ate, path) = (trajectory.ate_rmse_m?, trajectory.path_length_m?);
    let mut text = format!(
        "ATE {ate:.4} m over {} and {path:.2} m, scale {:.4}",
        counted(trajectory.matched_poses?, "pose"),
        trajectory.ate_scale?
    );
    if let Some(ratio) = trajectory.window_scale_ratio {
        let _ = write!(text, ", scale drift x{ratio:.2}");
    }
    Some(text)
}

/// Outcome of the joint estimation of keyframes; `None` without estimates.
fn joint_text(joint: &JointSummary) -> Option<String> {
    let times = times_text(joint.adjustment_ms.as_ref()?);
    let JointSummary { adjustments, adjustments_merged, adjustments_dropped, .. } = *joint;
    let estimates = counted(adjustments, "estimate");
    Some(format!(
        "{estimates} of keyframes ({adjustments_merged} merged), {adjustments_dropped} dropped; {times}"
    ))
}

/// Outcome of the search for loops; `None` without searches.
pub(super) fn loops_text(loops: &LoopSummary) -> Option<String> {
    let times = times_text(loops.loop_search_ms.as_ref()?);
    let of = |count: Option<u64>| count.unwrap_or(0);
    Some(format!(
        "{} searched, {} closed, {} held already, {} joined; refused: {}, {} against the drift, {} unconfirmed, \
         {} inconsistent; a search takes {times}",
        counted(of(loops.loop_searches), "keyframe"),
        of(loops.loops_closed),
        of(loops.loops_held),
        counted(of(loops.epochs_joined), "epoch"),
        counted(of(loops.loops_refused), "other place"),
        of(loops.loops_against_drift),
        of(loops.loops_unconfirmed),
        of(loops.loops_inconsistent),
    ))
}

fn times_text(p: &Percentiles) -> String {
    let Percentiles { mean, p50, p95, p99, max, .. } = p;
    format!("{mean:.2} ms mean, {p50:.2} median, {p95:.2} p95, {p99:.2} p99, {max:.2} max")
}

fn run(summary: &Summary) -> String {
    let mut text =
        format!("{:.2} s for {:.2} s recorded", summary.wall_secs, summary.recorded_secs);
    if let Some(factor) = summary.realtime_factor {
        let _ = write!(text, " (x{factor:.2} real time)");
    }
    if let Some(memory) = summary.peak_rss_mb {
        let _ = write!(text, ", {memory:.0} MiB");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::results::record::RunRecord;
    use crate::service::results::summary::PointCounts;
    use crate::service::results::untracked::tests::record;
    use crate::slam::evaluation::depth_error::DepthErrors;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::Keyframe;
    use crate::slam::map::RealignedFrame;
    use crate::slam::pose::{LostReason, TrackingState};

    const LOST: TrackingState = TrackingState::Lost(LostReason::TooFewInliers);

    /// A run of 60 frames, the first ten before the map, with a map of one keyframe.
    fn run(state: TrackingState) -> RunRecord {
        let mut record = record(60, 60, state);
        let camera = Intrinsics::pinhole(8, 6, 8.0);
        let keyframe = Keyframe::at(Sim3::identity(), camera, Vec::new(), vec![0; 8 * 6]);
        record.map.keyframes.push(Keyframe { keyframe_id: 3, ..keyframe });
        record
    }

    fn summary(record: &RunRecord) -> Summary {
        let (points, depth) = (PointCounts::default(), DepthErrors::default());
        Summary::new(record, points, None, None, [None; 3], depth)
    }

    #[test]
    fn every_frame_is_counted_once() {
        let mut record = run(TrackingState::Tracking);
        record.poses[40..].iter_mut().for_each(|pose| pose.estimate.state = LOST);
        for sequence in 50..60 {
            let keyframe_from_camera = SE3::identity();
            record.map.store_frame_pose(&RealignedFrame {
                sequence,
                keyframe_id: 3,
                keyframe_from_camera,
            });
        }
        let text = summary_text(&summary(&record));
        assert!(
            text.contains(
                " 60 in, 10 before the map, 40 tracked (10 of them afterwards), 10 lost, "
            ),
            "{text}"
        );
    }

    #[test]
    fn a_count_of_one_is_singular() {
        let mut summary = summary(&run(TrackingState::Tracking));
        (summary.gaps, summary.joint.adjustments) = (1, 1);
        summary.joint.adjustment_ms = summary.times.map_ms;
        summary.loops.loop_search_ms = summary.times.map_ms;
        (summary.loops.loop_searches, summary.loops.epochs_joined) = (Some(1), Some(1));
        let text = summary_text(&summary);
        for part in [
            " 1 keyframe (1 without depth), 0 certain points fused to 0 in map.ply",
            " 1 gap;",
            " 1 estimate of keyframes (0 merged)",
            " 1 keyframe searched, 0 closed, 0 held already, 1 epoch joined; refused: 0 other places,",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn memory_has_the_unit_of_the_report() {
        let mut summary = summary(&run(TrackingState::Tracking));
        summary.peak_rss_mb = Some(118.6);
        let text = summary_text(&summary);
        assert!(text.contains(", 119 MiB\n"), "{text}");
    }

    #[test]
    fn a_map_that_no_frame_was_tracked_on_is_not_judged() {
        let text = |state| {
            let mut summary = summary(&run(state));
            summary.depth.depth_relative_error_median = Some(0.011);
            summary.depth.depth_relative_error_median_best_half = Some(0.005);
            summary_text(&summary)
        };
        let tracked = text(TrackingState::Tracking);
        assert!(tracked.contains("error 1.1 %") && !tracked.contains("no frame"), "{tracked}");
        for state in [TrackingState::Initializing, LOST] {
            let untracked = text(state);
            assert!(
                !untracked.contains("1.1 %") && !untracked.contains("never init"),
                "{untracked}"
            );
            assert!(untracked.contains("epoch 0; no frame was tracked on it"), "{untracked}");
        }
    }
}
