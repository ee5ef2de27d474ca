//! What a run leaves behind: trajectories, keyframes, point cloud, summary and report.
//!
//! `run` and `replay` end in [`Results`] of a [`RunRecord`], so that their files mean the
//! same and can be compared byte by byte.

pub(crate) mod alignment_levels;
pub(crate) mod budget_curve;
pub(crate) mod calibration;
pub(crate) mod colour;
pub(crate) mod debug_pictures;
pub(crate) mod depth_maps;
pub(crate) mod empty_map;
pub(crate) mod full_points;
pub(crate) mod joint;
pub(crate) mod joint_points;
pub(crate) mod lettering;
pub(crate) mod loops;
pub(crate) mod mapping_load;
pub mod output_folder;
pub(crate) mod output_lock;
pub(crate) mod pcd;
pub(crate) mod pictures;
pub mod ply;
pub(crate) mod poses;
pub mod record;
pub mod report;
pub mod results_error;
pub(crate) mod set;
pub(crate) mod step_times;
pub(crate) mod summary;
pub(crate) mod summary_text;
pub(crate) mod times;
pub(crate) mod untracked;
pub(crate) mod weight_picture;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::capture::source::FrameSource;
use crate::service::atomic_file::write_atomically;
use crate::service::results::full_points::{FULL_POINT_BYTES, num_points, write_full_points};
use crate::service::results::ply::SURFACE_POINT_BYTES;
use crate::service::results::record::RunRecord;
use crate::service::results::report::report;
use crate::service::results::results_error::ResultsError;
use crate::service::results::set::ResultSet;
use crate::service::results::summary::PointCounts;
use crate::service::trajectory_file::write_epochs;
use crate::slam::evaluation::depth_error::{DepthErrors, DepthScale};
use crate::slam::evaluation::umeyama::TrajectoryAlignment;
use crate::slam::evaluation::{MAX_DIFFERENCE_NANOS, TrajectoryEvaluation, evaluate_trajectory};
use crate::slam::fusion::{FusionParams, MapResolution, SurfacePoint, fuse};
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::trajectory::StampedPose;

pub use crate::service::results::budget_curve::BudgetSample;
pub use crate::service::results::summary::Summary;

/// Which parts of the map are written, and how a run is evaluated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ResultsParams {
    /// Largest σ/d of a point that is written or shown. 0.1: a standard deviation of a tenth of the distance; larger
    /// values keep more points and more outliers.
    pub max_relative_std_dev: f64,
    /// Distance between the points of `map.ply`: a length in map units (`"0.02"`), or a share of the distance from the
    /// camera (`"0.5%"`), so that near surfaces are finer; nowhere below the points' standard deviation.
    pub map_resolution: MapResolution,
    /// Also write `map.pcd`: the points of `map.ply` for PCL.
    pub pcd: bool,
    /// Also write `points-full.ply`: every point of every keyframe, before fusion.
    pub full_points: bool,
    /// Transform fitted before positions are compared with the ground truth: `sim3`, `se3` or `none`.
    pub alignment: TrajectoryAlignment,
    /// Whether keyframes hold the spread points of the interval filter: from `mapping.depth_filter`.
    #[serde(skip)]
    pub has_spread_points: bool,
}

impl Default for ResultsParams {
    fn default() -> Self {
        Self {
            max_relative_std_dev: 0.1,
            map_resolution: MapResolution::default(),
            pcd: false,
            full_points: false,
            alignment: TrajectoryAlignment::Sim3,
            has_spread_points: false,
        }
    }
}

impl ResultsParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("max_relative_std_dev", self.max_relative_std_dev, 0.0..=10.0)
    }

    /// Parameters for fusing keyframes into one surface.
    pub fn fusion(&self) -> FusionParams {
        let params = FusionParams {
            resolution: self.map_resolution,
            max_relative_std_dev: self.max_relative_std_dev,
            ..FusionParams::default()
        };
        if self.has_spread_points { params.of_spread_points() } else { params }
    }
}

/// The figures of a run and the data behind them.
pub struct Results<'a> {
    /// The figures.
    pub summary: Summary,
    record: &'a RunRecord,
    params: &'a ResultsParams,
    trajectory: Vec<StampedPose>,
    online: Vec<StampedPose>,
    evaluation: Option<TrajectoryEvaluation>,
    online_evaluation: Option<TrajectoryEvaluation>,
    surface: Vec<SurfacePoint>,
}

impl<'a> Results<'a> {
    /// Evaluates a run. True depth comes from `depth_source` where it has any. Calls `progress` with the number of
    /// keyframes fused so far, and of all.
    pub fn new(
        record: &'a RunRecord,
        depth_source: &mut dyn FrameSource,
        params: &'a ResultsParams,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Self, ResultsError> {
        // Files hold every epoch; figures and pictures show the longest.
        let epoch = poses::longest_epoch(record);
        let trajectory = poses::of_epoch(&poses::final_poses(record), epoch);
        let online = poses::online_trajectory(record, epoch);
        let evaluate = |estimate: &[StampedPose]| {
            // Given poses have no error.
            let given = record.depth_scale == DepthScale::Given;
            let truth = if given { &[][..] } else { &record.ground_truth };
            evaluate_trajectory(estimate, truth, params.alignment, MAX_DIFFERENCE_NANOS).ok()
        };
        let (evaluation, online_evaluation) = (evaluate(&trajectory), evaluate(&online));
        let depth = match record.is_depth_from_sensor {
            true => DepthErrors::default(),
            false => depth_maps::evaluate_depth(record, epoch, depth_source)?,
        };
        let begin = Instant::now();
        let surface = fuse(&keyframes_of(&record.map, epoch), &params.fusion(), progress);
        let points = PointCounts {
            points: num_points(&record.map, params.max_relative_std_dev),
            map_points: surface.len(),
            fusion_secs: begin.elapsed().as_secs_f64(),
        };
        let summary = Summary::new(
            record,
            points,
            evaluation.as_ref(),
            online_evaluation.as_ref(),
            poses::normalized_errors_of(record, epoch),
            depth,
        );
        Ok(Self {
            summary,
            record,
            params,
            trajectory,
            online,
            evaluation,
            online_evaluation,
            surface,
        })
    }

    /// Writes `trajectory.txt`, `trajectory_online.txt`, `keyframes.txt`, `map.ply`, `points.ply`, `summary.json`,
    /// `report.html`, and on request `map.pcd` and `points-full.ply` into `dir`, which
    /// [`output_folder::prepare_output`] has made: all of them, in place of an earlier run's, or none. `write_more`
    /// writes the other files of the set into the folder that it is given.
    pub fn write(
        &self,
        dir: &Path,
        write_more: &dyn Fn(&Path) -> Result<(), ResultsError>,
    ) -> Result<(), ResultsError> {
        let record = self.record;
        let page = report(self);
        let needed = self.needed_bytes(page.len());
        let failed = |path: PathBuf, source| write_failure(dir, needed, path, source);
        let set = ResultSet::begin(dir).map_err(|source| failed(dir.to_owned(), source))?;
        let write = |name: &str, write: &dyn Fn(&Path) -> io::Result<()>| {
            // Errors name the place where the user looks for the file.
            write(&set.folder().join(name)).map_err(|source| failed(dir.join(name), source))
        };
        write("trajectory.txt", &|path| {
            write_epochs(path, poses::FINAL_COMMENT, &poses::final_poses(record))
        })?;
        write("trajectory_online.txt", &|path| {
            write_epochs(path, poses::ONLINE_COMMENT, &poses::online_poses(record))
        })?;
        write("keyframes.txt", &|path| poses::write_keyframes(path, &record.map))?;
        write("map.ply", &|path| ply::write_surface(path, &self.surface))?;
        write("points.ply", &|path| joint_points::write_points(path, &record.map))?;
        if self.params.pcd {
            write("map.pcd", &|path| pcd::write_pcd(path, &self.surface))?;
        }
        if self.params.full_points {
            let most = self.params.max_relative_std_dev;
            write("points-full.ply", &|path| write_full_points(path, &record.map, most))?;
        }
        write("summary.json", &|path| {
            write_atomically(path, |file| {
                serde_json::to_writer_pretty(&mut *file, &self.summary)?;
                writeln!(file)
            })
        })?;
        write("report.html", &|path| {
            write_atomically(path, |file| file.write_all(page.as_bytes()))
        })?;
        write_more(set.folder())?;
        set.commit().map_err(|source| failed(dir.to_owned(), source))
    }

    /// Approximate size of the run's files, bytes.
    fn needed_bytes(&self, page: usize) -> u64 {
        /// Bytes of a line of either trajectory, a line of `keyframes.txt`, a point of `points.ply`.
        const POSE_BYTES: usize = 170;
        const KEYFRAME_BYTES: usize = 220;
        const CONFIRMED_BYTES: usize = 24;
        /// Largest `summary.json`.
        const SUMMARY_BYTES: usize = 50_000;
        let Self { record, params, summary, .. } = self;
        let lines = 2 * POSE_BYTES * record.poses.len()
            + KEYFRAME_BYTES * record.map.keyframes.len()
            + CONFIRMED_BYTES * record.map.confirmed.len();
        let surface = (1 + usize::from(params.pcd)) * SURFACE_POINT_BYTES * self.surface.len();
        let full =
            if params.full_points { FULL_POINT_BYTES * summary.point_counts.points } else { 0 };
        (surface + full + lines + page + SUMMARY_BYTES) as u64
    }
}

/// Keyframes of the epoch that is written and shown; of the newest where none was tracked. Each epoch has a separate
/// world and unit.
fn keyframes_of(map: &Map, epoch: Option<u32>) -> Vec<&Keyframe> {
    let newest = map.keyframes.last().map(|keyframe| keyframe.epoch);
    let of_epoch = |keyframe: &&Keyframe| Some(keyframe.epoch) == epoch.or(newest);
    map.keyframes.iter().filter(of_epoch).collect()
}

/// The error of a file that cannot be written; names the lacking space where that is the cause.
fn write_failure(dir: &Path, needed: u64, path: PathBuf, source: io::Error) -> ResultsError {
    use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    if !matches!(source.kind(), StorageFull | QuotaExceeded | FileTooLarge) {
        return ResultsError::Write { path, source };
    }
    let free =
        rustix::fs::statvfs(dir).map_or(0, |stat| stat.f_bavail.saturating_mul(stat.f_frsize));
    ResultsError::Room { path, source, needed_mb: needed.div_ceil(1 << 20), free_mb: free >> 20 }
}
