//! The charts of a report, from the record of a run.

use nalgebra::Vector3;

use crate::service::results::Results;
use crate::service::results::poses::{keyframe_pose, keyframes_of_longest_epoch};
use crate::service::results::record::RunRecord;
use crate::service::results::report::chart::{Chart, Scaling};
use crate::service::results::report::series::{Mark, Series};
use crate::service::results::report::views::Views;
use crate::slam::evaluation::TrajectoryEvaluation;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::evaluation::statistics::percentiles;
use crate::slam::evaluation::windows::SCALE_WINDOW;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::trajectory::StampedPose;

/// Colours that are distinguishable with any colour vision, on white and on black: of the truth,
pub const TRUTH: &str = "#8b929c";
/// … of estimates,
pub const ESTIMATE: &str = "#2f6fed";
/// … of what was published,
pub const ONLINE: &str = "#e59a1a";
/// … of errors,
pub const ERROR: &str = "#d6455d";
/// … of the mapper.
pub const MAPPING: &str = "#1f9d78";

/// Number of bars in a histogram.
const BARS: usize = 40;

/// Seconds from the first frame.
pub fn secs(record: &RunRecord, nanos: i64) -> f64 {
    let first = record.poses.first().map_or(0, |pose| pose.estimate.capture_nanos);
    nanos.saturating_sub(first) as f64 * 1e-9
}

/// The trajectory from above and from the side, in the coordinates of the ground truth if any; `up` is in the map's.
pub fn trajectory_views(results: &Results<'_>, up: Option<Vector3<f64>>) -> [Chart; 2] {
    let truth: Vec<StampedPose> = truth_in_time(results);
    let (alignment, unit) = match &results.evaluation {
        Some(evaluation) => (evaluation.alignment, "m"),
        None if results.record.depth_scale == DepthScale::Given => (Sim3::identity(), "m"),
        None => (Sim3::identity(), "map units"),
    };
    let views = match up {
        Some(up) => Views::of(&results.trajectory, Some(up)).turned(&alignment.rigid.rotation),
        None => Views::of(if truth.is_empty() { &results.trajectory } else { &truth }, None),
    };
    let keyframes = keyframe_poses(results.record);
    trajectory_charts(&results.trajectory, &truth, &alignment, unit, &keyframes, &views)
}

/// From above and from the side, along `views` in the truth's coordinate frame: `truth`, and `estimate` and `keyframes`
/// transformed into that frame.
pub fn trajectory_charts(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    alignment: &Sim3,
    unit: &str,
    keyframes: &[StampedPose],
    views: &Views,
) -> [Chart; 2] {
    let place = |pose: &StampedPose| StampedPose {
        nanos: pose.nanos,
        world_from_camera: alignment.transform_pose(&pose.world_from_camera),
    };
    let estimate: Vec<StampedPose> = estimate.iter().map(place).collect();
    let keyframes: Vec<StampedPose> = keyframes.iter().map(place).collect();
    let chart = |title, meaning, y_label: &str, project: &dyn Fn(&Vector3<f64>) -> [f64; 2]| {
        let points = |poses: &[StampedPose]| -> Vec<[f64; 2]> {
            poses.iter().map(|pose| project(&pose.world_from_camera.translation)).collect()
        };
        let series = [
            Series::new("ground truth", TRUTH, Mark::DashedPath, points(truth)),
            Series::new("estimate", ESTIMATE, Mark::Path, points(&estimate)),
            Series::new("keyframes", ESTIMATE, Mark::Dots(2.6), points(&keyframes)),
        ];
        Chart {
            title,
            meaning,
            x_label: format!("along the longest extent of the path [{unit}]"),
            y_label: format!("{y_label} [{unit}]"),
            height: 420.0,
            scaling: Scaling::Equal,
            series: series.into_iter().filter(|series| !series.points.is_empty()).collect(),
        }
    };
    [
        chart("Trajectory from above", ABOVE_MEANING, "across", &|p| views.seen_from_above(p)),
        chart("Trajectory from the side", SIDE_MEANING, "up", &|p| views.seen_from_side(p)),
    ]
}

/// True poses during the run.
fn truth_in_time(results: &Results<'_>) -> Vec<StampedPose> {
    if results.evaluation.is_none() {
        return Vec::new();
    }
    let poses = &results.record.poses;
    let (Some(first), Some(last)) = (poses.first(), poses.last()) else { return Vec::new() };
    let time = first.estimate.capture_nanos..=last.estimate.capture_nanos;
    results.record.ground_truth.iter().filter(|pose| time.contains(&pose.nanos)).copied().collect()
}

/// Poses of the keyframes of the longest epoch.
pub(super) fn keyframe_poses(record: &RunRecord) -> Vec<StampedPose> {
    keyframes_of_longest_epoch(record).map(keyframe_pose).collect()
}

/// Position error over time, final and as published; `None` without ground truth.
pub fn error_over_time(results: &Results<'_>) -> Option<Chart> {
    let evaluation = results.evaluation.as_ref()?;
    let series = |name, colour, poses: &[StampedPose], evaluation: &TrajectoryEvaluation| {
        let points = error_points(poses, evaluation, |nanos| secs(results.record, nanos));
        Series::new(name, colour, Mark::Line, points)
    };
    let online = results.online_evaluation.as_ref();
    let online = online.map(|of| series("as published", ONLINE, &results.online, of));
    let last = series("final", ERROR, &results.trajectory, evaluation);
    Some(error_chart(online.into_iter().chain([last]).collect()))
}

/// Time and position error of each match.
pub fn error_points(
    poses: &[StampedPose],
    evaluation: &TrajectoryEvaluation,
    secs: impl Fn(i64) -> f64,
) -> Vec<[f64; 2]> {
    let pairs = evaluation.pairs.iter().zip(&evaluation.absolute);
    pairs.map(|(&(e, _), &error)| [secs(poses[e].nanos), error]).collect()
}

/// Position errors over time.
pub fn error_chart(series: Vec<Series>) -> Chart {
    const MEANING: &str = "Distance of each frame from the ground truth after alignment: final poses and those published during \
         the run. Low and level is good; a step is a place where the map is bent or its scale changes.";
    let y_label = "error after alignment [m]";
    let chart = Chart::over_time("Position error", MEANING, y_label, Scaling::FromZero, series);
    Chart { height: 280.0, ..chart }
}

/// Scale of windows of 100 frames relative to that of the whole; `None` for fewer than two windows.
pub fn scale_over_time(results: &Results<'_>) -> Option<Chart> {
    let evaluation = results.evaluation.as_ref()?;
    if evaluation.window_scales.len() < 2 {
        return None;
    }
    let pairs = &evaluation.pairs;
    let time = |i: usize| pairs.get(i).map(|p| secs(results.record, results.trajectory[p.0].nanos));
    // The last window may share matches with the previous one.
    let mut drawn = 0;
    let points: Vec<[f64; 2]> = evaluation
        .window_scales
        .iter()
        .flat_map(|&(i, scale)| {
            let ratio = scale / evaluation.alignment.scale;
            let from = i.max(drawn);
            drawn = i + SCALE_WINDOW;
            [(from, ratio), (drawn - 1, ratio)]
        })
        .filter_map(|(i, ratio)| time(i).map(|t| [t, ratio]))
        .collect();
    const MEANING: &str = "Length of the estimated path over that of the ground truth, window by window. 1 everywhere means \
         that the scale does not drift.";
    let (title, y_label) = ("Scale drift: scale of 100-frame windows", "scale / overall scale");
    let series = vec![Series::new("", MAPPING, Mark::Path, points)];
    let chart = Chart::over_time(title, MEANING, y_label, Scaling::Free, series);
    Some(Chart { height: 280.0, ..chart })
}

/// Times of tracker and mapper over the run, and their distribution.
pub fn time_charts(record: &RunRecord) -> Vec<Chart> {
    let of_poses = |nanos: fn(&crate::service::results::record::RecordedPose) -> Option<u64>| {
        let samples = record.poses.iter().filter_map(|pose| {
            nanos(pose).map(|n| [secs(record, pose.estimate.capture_nanos), n as f64 * 1e-6])
        });
        samples.collect::<Vec<[f64; 2]>>()
    };
    let track = of_poses(|pose| pose.track_nanos);
    let latency = of_poses(|pose| pose.latency_nanos);
    // One map step per mapped frame, spread over the frames in order.
    let spread = record.poses.len() as f64 / record.map_nanos.len().max(1) as f64;
    let map: Vec<[f64; 2]> = record
        .map_nanos
        .iter()
        .enumerate()
        .filter_map(|(i, &nanos)| {
            let pose = record.poses.get((i as f64 * spread) as usize)?;
            Some([secs(record, pose.estimate.capture_nanos), nanos as f64 * 1e-6])
        })
        .collect();
    let deadline = record.deadline_nanos.map(|n| n as f64 * 1e-6);
    let mut charts = Vec::new();
    for (times, samples, limit) in
        [(&TRACKING, track, deadline), (&MAPPING_STEPS, map, None), (&LATENCY, latency, None)]
    {
        if !samples.is_empty() {
            let line = vec![Series::new("", times.colour, Mark::Line, samples.clone())];
            let (title, meaning) = (times.over_run, times.meaning);
            let y_label = "duration [ms]";
            charts.push(Chart::over_time(title, meaning, y_label, Scaling::FromZero, line));
            charts.push(histogram(times, &samples, limit));
        }
    }
    charts
}

/// One kind of time, with its texts.
struct Times {
    over_run: &'static str,
    distribution: &'static str,
    colour: &'static str,
    meaning: &'static str,
}

const TRACKING: Times = Times {
    over_run: "Tracking time",
    distribution: "Distribution of tracking time",
    colour: ESTIMATE,
    meaning: "Time in the tracker for each frame. Good is well below the interval between frames.",
};

const MAPPING_STEPS: Times = Times {
    over_run: "Mapping time",
    distribution: "Distribution of mapping time",
    colour: MAPPING,
    meaning: "Time in the mapper for each frame. It may exceed the interval between frames now and then: poses do not \
              wait for it.",
};

const LATENCY: Times = Times {
    over_run: "Latency from stamp to pose",
    distribution: "Distribution of latency",
    colour: ONLINE,
    meaning: "From a frame's stamp to the publication of its pose: how old a pose is when it can be used.",
};

const DISTRIBUTION_MEANING: &str = "How many frames took how long; 95 % of them are left of p95. The last bar also has all longer ones.";
const DEADLINE_MEANING: &str = "How many frames took how long; 95 % of them are left of p95. The last bar also has all longer ones. The \
     deadline counts from a frame's arrival, as these times do; it is drawn where it lies in the range.";

const ABOVE_MEANING: &str = "Path of the camera; keyframes are the frames that carry the map. With ground truth the \
                             estimate is aligned to it, and good means that the two lines cover each other.";
const SIDE_MEANING: &str = "The same from the side, one length along both axes: how the camera rose and fell. Up is \
                            estimated from how it was held and from horizontal surfaces.";

/// Distribution of the times of frames. The range ends at 1.5 times the 99th percentile; larger times are counted in the
/// last bar. A deadline beyond the range is not drawn: to show it, the bars would have to shrink to one.
fn histogram(times: &Times, samples: &[[f64; 2]], deadline: Option<f64>) -> Chart {
    let durations = samples.iter().map(|sample| sample[1]);
    let [p95, p99] = percentiles(durations.clone(), [0.95, 0.99]).unwrap_or_default();
    let end = 1.5 * p99.max(1e-3);
    let width = end / BARS as f64;
    let mut counts = [0u32; BARS];
    for time in durations {
        counts[((time / width) as usize).min(BARS - 1)] += 1;
    }
    let bars = counts.iter().enumerate().map(|(i, &n)| [i as f64 * width, f64::from(n)]);
    let mut series = vec![
        Series::new("", times.colour, Mark::Bars(width * 0.9), bars.collect()),
        Series::new("p95", ERROR, Mark::Rule, vec![[p95, 0.0]]),
    ];
    let rule = |deadline| Series::new("deadline", TRUTH, Mark::Rule, vec![[deadline, 0.0]]);
    series.extend(deadline.filter(|deadline| *deadline < end).map(rule));
    Chart {
        title: times.distribution,
        meaning: if deadline.is_some() { DEADLINE_MEANING } else { DISTRIBUTION_MEANING },
        x_label: "time [ms]".into(),
        y_label: "frames".into(),
        height: 230.0,
        scaling: Scaling::FromZero,
        series,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::results::record::{RecordedPose, RunMode};
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::keyframe::Keyframe;
    use crate::slam::pose::{PoseEstimate, TrackingState};

    #[test]
    fn keyframes_of_other_epochs_are_not_drawn() {
        let mut record = RunRecord::empty(RunMode::Replay, "x");
        for keyframe_id in 0..3 {
            let camera = Intrinsics::pinhole(32, 24, 30.0);
            let keyframe = Keyframe::at(Sim3::identity(), camera, Vec::new(), Vec::new());
            let epoch = u32::from(keyframe_id > 0);
            let capture_nanos = keyframe_id as i64;
            record.map.keyframes.push(Keyframe { keyframe_id, epoch, capture_nanos, ..keyframe });
        }
        // Two frames of the second epoch, one of the first.
        record.poses.extend([0, 1, 2].map(|keyframe_id| RecordedPose {
            estimate: PoseEstimate {
                keyframe_id,
                state: TrackingState::Tracking,
                ..PoseEstimate::unknown_at(keyframe_id, 0)
            },
            latency_nanos: None,
            track_nanos: None,
            trace: None,
            wake_nanos: None,
        }));
        let drawn: Vec<i64> = keyframe_poses(&record).iter().map(|pose| pose.nanos).collect();
        assert_eq!(drawn, [1, 2]);
    }

    #[test]
    fn the_deadline_is_drawn_over_times_that_count_from_the_arrival() {
        let mut record = RunRecord::empty(RunMode::Live, "x");
        record.poses.extend((0..100).map(|sequence| RecordedPose {
            estimate: PoseEstimate::unknown_at(sequence, 0),
            latency_nanos: Some(30_000_000),
            track_nanos: Some(3_000_000),
            trace: None,
            wake_nanos: None,
        }));
        let charts_with_deadline = |deadline_nanos, record: &mut RunRecord| -> Vec<&'static str> {
            record.deadline_nanos = deadline_nanos;
            let charts = time_charts(record);
            let has_rule = |chart: &&Chart| chart.series.iter().any(|of| of.name == "deadline");
            charts.iter().filter(has_rule).map(|chart| chart.title).collect()
        };
        let near = charts_with_deadline(Some(4_000_000), &mut record);
        assert_eq!(near, ["Distribution of tracking time"]);
        let far = charts_with_deadline(Some(16_000_000), &mut record);
        assert_eq!((far, charts_with_deadline(None, &mut record)), (vec![], vec![]));
    }
}
