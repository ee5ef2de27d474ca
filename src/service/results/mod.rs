//! What a run leaves behind: trajectories, keyframes, point cloud, summary and report.
//!
//! `run` and `replay` end in [`write_results`] with a [`RunRecord`], so that their files mean the
//! same and can be compared byte by byte.

pub mod alignment_levels;
pub mod budget_curve;
pub mod colour;
pub mod debug_pictures;
pub mod depth_maps;
pub mod lettering;
pub mod pcd;
pub mod pictures;
pub mod ply;
pub mod poses;
pub mod report;
pub mod summary;
pub mod summary_text;
pub mod weight_picture;

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::capture::source::{FrameSource, SourceError};
use crate::service::alignment_stamps::AlignmentTrace;
use crate::service::atomic_file::write_atomically;
use crate::service::results::budget_curve::BudgetSample;
use crate::service::results::report::{ReportInput, report};
use crate::service::results::summary::Summary;
use crate::service::trajectory_file::write_trajectory;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::evaluation::umeyama::Alignment;
use crate::slam::evaluation::{MAX_DIFFERENCE_NANOS, evaluate_trajectory};
use crate::slam::mapper::Map;
use crate::slam::mapper::consistency::Contradiction;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::PoseEstimate;
use crate::slam::trajectory::StampedPose;

/// How a run was driven.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RunMode {
    /// One process, every frame in order.
    Replay,
    /// Processes over shared memory, every frame in order.
    Lockstep,
    /// Processes over shared memory, the newest frame wins.
    Live,
}

/// A pose as the tracker gave it, with what it cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedPose {
    /// The tracker's word.
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

/// The map was found to contradict itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rejection {
    /// Sequence of the frame that showed it.
    pub sequence: u64,
    /// How.
    pub contradiction: Contradiction,
}

/// Everything that is known of a run when it ends.
#[derive(Debug, Clone)]
pub struct RunRecord {
    /// How it was driven.
    pub mode: RunMode,
    /// Where the frames came from, as the user named it.
    pub source: String,
    /// One for each frame that reached the tracker, in order.
    pub poses: Vec<RecordedPose>,
    /// The map at the end.
    pub map: Map,
    /// True poses in order of their stamps, empty where there are none.
    pub ground_truth: Vec<StampedPose>,
    /// Where metres come from when depth is compared.
    pub depth_scale: DepthScale,
    /// Frames that the source gave.
    pub frames_in: u64,
    /// Frames that the tracker never saw because a newer one had come.
    pub frames_dropped: u64,
    /// Places where the source's sequence has a hole.
    pub gaps: u64,
    /// Processes that were started again.
    pub restarts: u64,
    /// Time that the tracker was allowed for a frame; `None` without a deadline.
    pub deadline_nanos: Option<u64>,
    /// Frames published after the deadline; `None` without one.
    pub deadline_misses: Option<u64>,
    /// Page faults of the tracker's frame loop since it was warm; `None` in one process.
    pub page_faults: Option<u64>,
    /// Time in the mapper, one for each frame it handled.
    pub map_nanos: Vec<u64>,
    /// Of them, those of the steps that changed to a new keyframe.
    pub keyframe_step_nanos: Vec<u64>,
    /// Of each of those, the time from the observed frame to a keyframe that others can have: carrying,
    /// smoothing, live also publishing.
    pub keyframe_nanos: Vec<u64>,
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

/// What of the map is written and how it is judged.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ResultsParams {
    /// Largest σ/d of a point of `map.ply`, `map.pcd` and of the report's pictures. 0.1: a point that is known
    /// to a tenth of its distance; larger values keep more points and more outliers.
    pub max_relative_std_dev: f64,
    /// What is fitted before positions are compared with the ground truth: `sim3`, `se3` or `none`.
    pub alignment: Alignment,
}

impl Default for ResultsParams {
    fn default() -> Self {
        Self { max_relative_std_dev: 0.1, alignment: Alignment::Sim3 }
    }
}

impl ResultsParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("max_relative_std_dev", self.max_relative_std_dev, 0.0..=10.0)
    }
}

/// Why results cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    /// A file or folder that cannot be written.
    #[error("cannot write {path}: {source}; choose another folder with --output")]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// True depth that cannot be read.
    #[error("cannot read the depth of a keyframe for evaluation: {0}")]
    Depth(#[from] SourceError),
}

/// Makes the output folder and writes and removes a file in it, so that a folder without room or
/// permission is noticed before the run and not after it.
pub fn prepare_output(dir: &Path) -> Result<(), ResultsError> {
    let probe = dir.join(".semidense-write-test");
    let attempt = || {
        fs::create_dir_all(dir)?;
        fs::write(&probe, [0u8; 4096])?;
        fs::remove_file(&probe)
    };
    attempt().map_err(|source| ResultsError::Write { path: dir.to_path_buf(), source })
}

/// Writes `trajectory.txt`, `trajectory_online.txt`, `keyframes.txt`, `map.ply`, `map.pcd`,
/// `summary.json` and `report.html` into `dir`, which [`prepare_output`] has made. True depth comes from
/// `depth_source` where it has any.
pub fn write_results(
    dir: &Path,
    record: &RunRecord,
    depth_source: &mut dyn FrameSource,
    params: &ResultsParams,
) -> Result<Summary, ResultsError> {
    // Files hold every epoch; figures and pictures are of the longest.
    let epoch = poses::longest_epoch(record);
    let trajectory = poses::final_trajectory(record, epoch);
    let online = poses::online_trajectory(record, epoch);
    let evaluate = |estimate: &[StampedPose]| {
        // Poses that were given have no error.
        let given = record.depth_scale == DepthScale::Given;
        let truth = if given { &[][..] } else { &record.ground_truth };
        evaluate_trajectory(estimate, truth, params.alignment, MAX_DIFFERENCE_NANOS).ok()
    };
    let (evaluation, online_evaluation) = (evaluate(&trajectory), evaluate(&online));
    let depth = depth_maps::evaluate_depth(record, depth_source)?;
    let cloud = ply::point_cloud(&record.map, params.max_relative_std_dev);
    let summary = Summary::new(
        record,
        cloud.len(),
        evaluation.as_ref(),
        online_evaluation.as_ref(),
        poses::normalized_errors_of(record, epoch).as_ref(),
        depth.statistics,
    );

    let write = |name: &str, write: &dyn Fn(&Path) -> io::Result<()>| {
        let path = dir.join(name);
        write(&path).map_err(|source| ResultsError::Write { path, source })
    };
    write("trajectory.txt", &|path| {
        write_trajectory(path, poses::FINAL_COMMENT, &poses::final_trajectory(record, None))
    })?;
    write("trajectory_online.txt", &|path| {
        write_trajectory(path, poses::ONLINE_COMMENT, &poses::online_trajectory(record, None))
    })?;
    write("keyframes.txt", &|path| poses::write_keyframes(path, &record.map))?;
    write("map.ply", &|path| ply::write_ply(path, &cloud))?;
    write("map.pcd", &|path| pcd::write_pcd(path, &cloud))?;
    write("summary.json", &|path| {
        write_atomically(path, |file| {
            serde_json::to_writer_pretty(&mut *file, &summary)?;
            writeln!(file)
        })
    })?;
    let page = report(&ReportInput {
        record,
        summary: &summary,
        trajectory: &trajectory,
        online: &online,
        evaluation: evaluation.as_ref(),
        online_evaluation: online_evaluation.as_ref(),
        cloud: &cloud,
        max_relative_std_dev: params.max_relative_std_dev,
    });
    write("report.html", &|path| write_atomically(path, |file| file.write_all(page.as_bytes())))?;
    Ok(summary)
}
