//! `summary.json`: the figures of a run. A key that is not applicable in a mode is null.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::service::results::budget_curve::BudgetCurve;
use crate::service::results::calibration::whitened_residual_median;
use crate::service::results::joint::JointSummary;
use crate::service::results::loops::LoopSummary;
use crate::service::results::output_folder::utc_text;
use crate::service::results::poses::{final_poses, longest_epoch, placed_later};
use crate::service::results::record::{
    EndOfRun, RecordedPose, Rejection, RestartCause, RunMode, RunRecord,
};
use crate::service::results::step_times::StepTimes;
use crate::service::results::times::{LatencySummary, Percentiles};
use crate::service::results::untracked::why_untracked;
use crate::slam::evaluation::TrajectoryEvaluation;
use crate::slam::evaluation::depth_error::{
    DepthErrors, DepthScale, KeyframeDepth, depth_scale_ratio,
};
use crate::slam::evaluation::grade::{Grade, GradeInput};
use crate::slam::evaluation::map_consistency::MapConsistency;
use crate::slam::evaluation::normalized_error::NormalizedErrors;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::map::Map;
use crate::slam::pose::TrackingState;

/// Numbers of points, and the time to fuse them.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct PointCounts {
    /// Points of all keyframes whose σ/d is at most `results.max_relative_std_dev`.
    pub points: usize,
    /// Points of `map.ply`: the surface that they are fused into, of the evaluated epoch.
    pub map_points: usize,
    /// Time to fuse them.
    pub fusion_secs: f64,
}

/// A trajectory against ground truth; all null without ground truth. Lengths in the ground truth's unit (metres),
/// errors after the alignment.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct TrajectorySummary {
    /// Poses that have ground truth.
    pub matched_poses: Option<u64>,
    /// Root mean square position error.
    pub ate_rmse_m: Option<f64>,
    /// Mean position error.
    pub ate_mean_m: Option<f64>,
    /// Median position error.
    pub ate_median_m: Option<f64>,
    /// Largest position error.
    pub ate_max_m: Option<f64>,
    /// Factor from estimated lengths to true ones.
    pub ate_scale: Option<f64>,
    /// Root mean square translation error from frame to frame, metres.
    pub rpe_translation: Option<f64>,
    /// Root mean square rotation error from frame to frame, degrees.
    pub rpe_rotation_deg: Option<f64>,
    /// Root mean square translation error over 1 s, metres.
    pub rpe_translation_1s: Option<f64>,
    /// Root mean square rotation error over 1 s, degrees.
    pub rpe_rotation_deg_1s: Option<f64>,
    /// Length of the true path between matched poses.
    pub path_length_m: Option<f64>,
    /// Scale drift: largest over smallest scale of consecutive windows of 100 frames.
    pub window_scale_ratio: Option<f64>,
    /// Median position error of windows of 30 frames, each aligned separately.
    pub window_error_m: Option<f64>,
}

impl From<&TrajectoryEvaluation> for TrajectorySummary {
    fn from(evaluation: &TrajectoryEvaluation) -> Self {
        Self {
            matched_poses: Some(evaluation.pairs.len() as u64),
            ate_rmse_m: Some(evaluation.ate.rmse),
            ate_mean_m: Some(evaluation.ate.mean),
            ate_median_m: Some(evaluation.ate.median),
            ate_max_m: Some(evaluation.ate.max),
            ate_scale: Some(evaluation.alignment.scale),
            rpe_translation: Some(evaluation.rpe_translation.rmse),
            rpe_rotation_deg: Some(evaluation.rpe_rotation_deg.rmse),
            rpe_translation_1s: evaluation.rpe_translation_1s.map(|s| s.rmse),
            rpe_rotation_deg_1s: evaluation.rpe_rotation_deg_1s.map(|s| s.rmse),
            path_length_m: Some(evaluation.path_length),
            window_scale_ratio: evaluation.window_scale_ratio,
            window_error_m: evaluation.window_error,
        }
    }
}

/// Normalised estimation errors squared of a pose; all null without ground truth.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct NeesSummary {
    /// Frames compared.
    pub nees_frames: Option<u64>,
    /// Mean of all six unknowns; 6 where the covariance is right.
    pub nees_mean: Option<f64>,
    /// Median of all six unknowns; 5.3 where the covariance is right.
    pub nees_median: Option<f64>,
    /// Mean of the translation alone; 3 where the covariance is right.
    pub nees_translation: Option<f64>,
    /// Mean of the rotation alone; 3 where the covariance is right.
    pub nees_rotation: Option<f64>,
    /// Share of the frames below 12.6; 0.95 where the covariance is right.
    pub nees_below_bound: Option<f64>,
}

impl From<&NormalizedErrors> for NeesSummary {
    fn from(errors: &NormalizedErrors) -> Self {
        Self {
            nees_frames: Some(errors.frames as u64),
            nees_mean: Some(errors.mean),
            nees_median: Some(errors.median),
            nees_translation: Some(errors.translation),
            nees_rotation: Some(errors.rotation),
            nees_below_bound: Some(errors.below_bound),
        }
    }
}

/// Depth of the keyframes against ground truth; all null without ground truth.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct DepthSummary {
    /// Pixels of keyframes with known true depth.
    pub depth_pixels: Option<u64>,
    /// Median relative depth error over them.
    pub depth_relative_error_median: Option<f64>,
    /// The same over the half with the smallest σ/d.
    pub depth_relative_error_median_best_half: Option<f64>,
    /// Share of them whose true inverse depth is within 1, 2 and 3 reported σ.
    pub depth_coverage: Option<[f64; 3]>,
    /// Share of the keyframes' pixels that have depth.
    pub depth_density: Option<f64>,
    /// Depth errors common to a keyframe, medians of their magnitude: relative error per unit of the ray along columns,
    /// along rows, and per unit of ln d (relief).
    pub depth_modes: Option<[f64; 3]>,
    /// The same over the standard deviation that each keyframe claims: 0.67 is right, more is overconfident.
    pub depth_modes_whitened: Option<[f64; 3]>,
    /// Spread of the keyframes' depth scales: largest over smallest map unit of their depth, 1 where they agree.
    #[serde(default)]
    pub depth_scale_ratio: Option<f64>,
    /// The same and the modes, per keyframe.
    #[serde(default)]
    pub keyframe_depth: Vec<KeyframeDepth>,
}

impl From<DepthErrors> for DepthSummary {
    fn from(depth: DepthErrors) -> Self {
        let statistics = depth.statistics();
        Self {
            depth_pixels: statistics.map(|of| of.compared as u64),
            depth_relative_error_median: statistics.map(|of| of.relative_error_median),
            depth_relative_error_median_best_half: statistics
                .map(|of| of.relative_error_median_best_half),
            depth_coverage: statistics.map(|of| of.coverage),
            depth_density: statistics.map(|of| of.density),
            depth_modes: statistics.and_then(|of| of.modes),
            depth_modes_whitened: statistics.and_then(|of| of.whitened_modes),
            depth_scale_ratio: depth_scale_ratio(&depth.keyframes),
            keyframe_depth: depth.keyframes,
        }
    }
}

/// Frames by their state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct FrameCounts {
    /// Frames with a pose: claimed on arrival, or found afterwards.
    pub frames_tracked: u64,
    /// Those of them from before the start of their map, which were aligned to it afterwards.
    #[serde(default)]
    pub frames_tracked_later: u64,
    /// Those of them whose pose is worse than it should be.
    pub frames_degraded: u64,
    /// Tracked frames whose keyframe was rejected afterwards: `trajectory.txt` leaves them out.
    #[serde(default)]
    pub frames_withdrawn: u64,
    /// Frames without a pose from before the map could be trusted.
    pub frames_initializing: u64,
    /// Frames without a pose because tracking was lost.
    pub frames_lost: u64,
}

impl FrameCounts {
    fn of(record: &RunRecord) -> Self {
        let states = || record.poses.iter().map(|pose| pose.estimate.state);
        let count = |is: fn(TrackingState) -> bool| states().filter(|of| is(*of)).count() as u64;
        let later: Vec<TrackingState> =
            placed_later(&record.poses, &record.map).map(|of| of.state).collect();
        let without_pose = |is: fn(TrackingState) -> bool| {
            count(is) - later.iter().filter(|state| is(**state)).count() as u64
        };
        let frames_tracked = count(TrackingState::is_tracked) + later.len() as u64;
        Self {
            frames_tracked,
            frames_tracked_later: later.len() as u64,
            frames_withdrawn: frames_tracked - final_poses(record).len() as u64,
            frames_degraded: count(|s| matches!(s, TrackingState::Degraded(_))),
            frames_initializing: without_pose(|s| s == TrackingState::Initializing),
            frames_lost: without_pose(is_lost),
        }
    }
}

/// The figures of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// How it was driven.
    pub mode: RunMode,
    /// Source of the frames.
    pub source: String,
    /// The camera of the rectified images, pixels; null without a keyframe.
    pub camera: Option<Intrinsics>,
    /// How it ended: `finished`, `interrupted`, `failed`, or `recovered` where it was killed and this comes from its
    /// journal.
    pub ended: String,
    /// What failed.
    pub failure: Option<String>,
    /// End (UTC) of the run from whose journal this was recovered; null for any other run.
    pub recovered_run_end: Option<String>,
    /// Grade of the run from what is known without ground truth.
    pub grade: Grade,
    /// Frames that the source delivered.
    pub frames_in: u64,
    /// Images of the source that could not be used and were left out.
    pub frames_refused: u64,
    /// Their number, the first of them, and what is wrong with it; null where there are none.
    pub refused: Option<String>,
    /// Largest factor on the grey levels of dim images, 1 where none was dim; null where brightening is off.
    pub brightened_by: Option<u8>,
    /// Frames by their state.
    #[serde(flatten)]
    pub frames: FrameCounts,
    /// Frames that the tracker never saw.
    pub frames_dropped: u64,
    /// Gaps in the source's sequence.
    pub gaps: u64,
    /// How often tracking was lost.
    pub lost_count: u64,
    /// Each time the map was found to contradict itself: the frame, and why. Replay only.
    pub map_rejections: Option<Vec<Rejection>>,
    /// Median over the tracked frames of residuals over their standard deviation: 1 where everything is as modelled,
    /// above 1.5 the calibration is doubted; null for fewer than 30 frames.
    pub whitened_residual_median: Option<f64>,
    /// From the first frame to the first whose pose is claimed; null where none is.
    pub initialization_secs: Option<f64>,
    /// Why nothing was tracked; null where something was.
    pub untracked: Option<String>,
    /// Keyframes of the final map.
    pub keyframes: u64,
    /// Those of them without depth: the oldest of a long run, those of a map before `map load`, or those that a
    /// recovery could not find.
    pub keyframes_without_depth: u64,
    /// Their points, and those of `map.ply`.
    #[serde(flatten)]
    pub point_counts: PointCounts,
    /// Epoch of the map at the end, from 0.
    pub epoch: u32,
    /// Epochs of the poses in `trajectory.txt`.
    pub epochs: u64,
    /// The epoch that is compared with ground truth: the one with the most tracked frames. Each epoch has a separate
    /// coordinate frame and scale; `matched_poses` is the number of frames that its figures cover.
    pub evaluated_epoch: Option<u32>,
    /// From a frame's stamp to its sending by capture: lateness before the tracker's deadline begins. Live only.
    pub send_ms: Option<Percentiles>,
    /// Latency of the poses.
    #[serde(flatten)]
    pub latency: LatencySummary,
    /// Time from a frame's arrival in the tracker until its pose is due. Live only.
    pub deadline_ms: Option<f64>,
    /// Poses published later than that.
    pub deadline_misses: Option<u64>,
    /// Page faults of the tracker's frame loop after its first hundred frames. Live only: without a deadline
    /// they cost nothing.
    pub page_faults: Option<u64>,
    /// Processes that were restarted.
    pub restarts: u64,
    /// The same by process name.
    pub restarts_by_process: BTreeMap<String, u64>,
    /// Their causes, each with its count.
    pub restart_causes: Vec<RestartCause>,
    /// Frames with a pose that the mapper skipped because newer ones had arrived. Null in one process.
    pub frames_skipped_by_mapper: Option<u64>,
    /// Time in the tracker and in the mapper.
    #[serde(flatten)]
    pub times: StepTimes,
    /// Joint estimates of keyframes.
    #[serde(flatten)]
    pub joint: JointSummary,
    /// The search for loops.
    #[serde(flatten)]
    pub loops: LoopSummary,
    /// Quality of a pose as a function of its iterations; replay only.
    pub budget_curve: Option<BudgetCurve>,
    /// From the first to the last stamp.
    pub recorded_secs: f64,
    /// Duration of the run.
    pub wall_secs: f64,
    /// Recorded duration over wall time.
    pub realtime_factor: Option<f64>,
    /// Largest resident memory of all processes together, 2²⁰ bytes.
    pub peak_rss_mb: Option<f64>,
    /// `trajectory.txt` against ground truth.
    #[serde(flatten)]
    pub trajectory: TrajectorySummary,
    /// `trajectory_online.txt` against ground truth.
    pub online: TrajectorySummary,
    /// Errors of the tracked poses against their covariance, with the map's own depth.
    #[serde(flatten)]
    pub nees: NeesSummary,
    /// The same for their poses in the map, as published.
    pub map_nees: NeesSummary,
    /// The same for their velocities.
    pub velocity_nees: NeesSummary,
    /// Depth of the keyframes against ground truth.
    #[serde(flatten)]
    pub depth: DepthSummary,
}

/// 2²⁰.
const BYTES_PER_MB: f64 = 1_048_576.0;

fn secs(nanos: u64) -> f64 {
    nanos as f64 * 1e-9
}

impl Summary {
    /// The figures of `record`, with its `points` and the results of the evaluations: `nees` on keyframes, in the map
    /// and of velocities.
    pub fn new(
        record: &RunRecord,
        points: PointCounts,
        trajectory: Option<&TrajectoryEvaluation>,
        online: Option<&TrajectoryEvaluation>,
        nees: [Option<NormalizedErrors>; 3],
        depth: DepthErrors,
    ) -> Self {
        let (recorded_secs, wall_secs) = (secs(record.recorded_nanos), secs(record.wall_nanos));
        let (ended, failure, recovered_run_end) = end_in_words(&record.ended);
        let (counters, is_live) = (&record.counters, record.mode == RunMode::Live);
        Self {
            mode: record.mode,
            source: record.source.clone(),
            camera: record.map.keyframes.first().map(|keyframe| keyframe.intrinsics),
            ended,
            failure,
            recovered_run_end,
            grade: grade(record),
            frames_in: counters.frames_in,
            frames_refused: counters.frames_refused,
            refused: record.refused.clone(),
            brightened_by: counters.brightened_by,
            frames: FrameCounts::of(record),
            frames_dropped: record.frames_dropped,
            gaps: counters.gaps,
            lost_count: count_losses(&record.poses),
            map_rejections: record.rejections.clone(),
            whitened_residual_median: whitened_residual_median(&record.poses),
            initialization_secs: initialization_secs(&record.poses),
            untracked: why_untracked(record),
            keyframes: record.map.keyframes.len() as u64,
            keyframes_without_depth: without_depth(&record.map),
            point_counts: points,
            epoch: record.poses.last().map_or(0, |pose| pose.estimate.epoch),
            epochs: count_epochs(record, 0),
            evaluated_epoch: trajectory.and_then(|_| longest_epoch(record)),
            send_ms: is_live.then(|| Percentiles::of_counts(&counters.send_counts)).flatten(),
            latency: LatencySummary::of(&record.poses),
            deadline_ms: record.deadline_nanos.map(|n| n as f64 * 1e-6),
            deadline_misses: is_live.then_some(counters.deadline_misses),
            page_faults: is_live.then_some(counters.page_faults),
            restarts: counters.restarts,
            restarts_by_process: restarts_by_process(&record.restart_causes),
            restart_causes: record.restart_causes.clone(),
            frames_skipped_by_mapper: record.frames_skipped_by_mapper,
            times: StepTimes::of(record),
            joint: JointSummary::of(&record.adjustments),
            loops: LoopSummary::of(record.searches.as_deref(), record.own_keyframes().count()),
            budget_curve: BudgetCurve::of(&record.budget_samples),
            recorded_secs,
            wall_secs,
            realtime_factor: (wall_secs > 0.0).then(|| recorded_secs / wall_secs),
            peak_rss_mb: (counters.peak_rss_bytes > 0)
                .then(|| counters.peak_rss_bytes as f64 / BYTES_PER_MB),
            trajectory: trajectory.map(TrajectorySummary::from).unwrap_or_default(),
            online: online.map(TrajectorySummary::from).unwrap_or_default(),
            nees: nees[0].as_ref().map(NeesSummary::from).unwrap_or_default(),
            map_nees: nees[1].as_ref().map(NeesSummary::from).unwrap_or_default(),
            velocity_nees: nees[2].as_ref().map(NeesSummary::from).unwrap_or_default(),
            depth: depth.into(),
        }
    }
}

/// How a run ended in a word, what failed, and when a recovered run ended.
fn end_in_words(ended: &EndOfRun) -> (String, Option<String>, Option<String>) {
    let (word, failure, recovered) = match ended {
        EndOfRun::Finished => ("finished", None, None),
        EndOfRun::Interrupted => ("interrupted", None, None),
        EndOfRun::Failed(cause) => ("failed", Some(cause.clone()), None),
        EndOfRun::Recovered(time) => ("recovered", None, Some(utc_text(*time))),
    };
    (word.to_owned(), failure, recovered)
}

/// Keyframes that have only a pose.
pub fn without_depth(map: &Map) -> u64 {
    map.keyframes.iter().filter(|keyframe| keyframe.points.is_empty()).count() as u64
}

/// The grade of a run.
fn grade(record: &RunRecord) -> Grade {
    let sequences = record.poses.iter().map(|pose| pose.estimate.sequence);
    let (first, last) = (sequences.clone().min(), sequences.max());
    let frames = last.zip(first).map_or(0, |(last, first)| last - first + 1);
    let counts = FrameCounts::of(record);
    // A map that was left for another one on request is no separate part of that.
    let first_epoch = record.loaded_map.as_ref().map_or(0, |loaded| loaded.first_epoch);
    Grade::of(&GradeInput {
        frames_tracked: counts.frames_tracked,
        frames_lost: counts.frames_lost,
        losses: count_losses(&record.poses),
        epochs: count_epochs(record, first_epoch),
        are_poses_given: record.depth_scale == DepthScale::Given,
        rejections: record.rejections.as_ref().map_or(0, |all| all.len() as u64),
        frames,
        width: record.map.keyframes.first().map_or(0, |keyframe| keyframe.intrinsics.width),
        consistency: MapConsistency::measure(&record.map.keyframes),
    })
}

fn restarts_by_process(causes: &[RestartCause]) -> BTreeMap<String, u64> {
    let mut sums = BTreeMap::new();
    causes.iter().for_each(|cause| *sums.entry(cause.process.clone()).or_default() += cause.count);
    sums
}

fn is_lost(state: TrackingState) -> bool {
    matches!(state, TrackingState::Lost(_))
}

/// Epochs from `first` on of the poses that are written: one that was joined to another does not count.
fn count_epochs(record: &RunRecord, first: u32) -> u64 {
    let epochs = final_poses(record).into_iter().map(|of| of.epoch).filter(|&of| of >= first);
    epochs.collect::<BTreeSet<_>>().len() as u64
}

/// Transitions to Lost.
fn count_losses(poses: &[RecordedPose]) -> u64 {
    let mut was_lost = false;
    let mut losses = 0;
    for pose in poses {
        let lost = is_lost(pose.estimate.state);
        losses += u64::from(lost && !was_lost);
        was_lost = lost;
    }
    losses
}

fn initialization_secs(poses: &[RecordedPose]) -> Option<f64> {
    let first = poses.first()?.estimate.capture_nanos;
    let tracked = poses.iter().find(|pose| pose.estimate.state.is_tracked())?;
    Some((tracked.estimate.capture_nanos - first) as f64 * 1e-9)
}
