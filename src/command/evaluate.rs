//! `semidense evaluate`: compares a trajectory with ground truth.

use std::error::Error;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, ValueEnum};

use crate::capture::euroc::sensor_beside;
use crate::capture::sensor_yaml;
use crate::command::evaluate_text::{evaluation_json, evaluation_text};
use crate::command::parse::no_instance;
use crate::command::print::{note, print};
use crate::service::atomic_file::write_atomically;
use crate::service::results::report::evaluation_plot::evaluation_plot;
use crate::service::trajectory_file::{TrajectoryFile, read_trajectory_file};
use crate::slam::evaluation::EvaluationError;
use crate::slam::evaluation::epochs::evaluate_epochs;
use crate::slam::evaluation::umeyama::TrajectoryAlignment;
use crate::slam::trajectory::{EpochPose, StampedPose, by_epoch};

/// Transformation fitted before positions are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Align {
    /// Rotation, translation and scale
    Sim3,
    /// Rotation and translation
    Se3,
    /// Nothing
    None,
}

/// Compare a trajectory with ground truth: absolute and relative errors, scale
///
/// Files are in TUM format (timestamp tx ty tz qx qy qz qw) or EuRoC ground truth (CSV). EuRoC poses are
/// those of the body; they are moved to the camera with T_BS of cam0/sensor.yaml, as is an estimate in that
/// format. Each pose of the shorter trajectory is compared with the pose of the longer one that is nearest in
/// time; the figures match those of the Python package evo.
///
/// If the estimate marks several epochs (`# epoch N: …`, as in the trajectory.txt of a run), each has its own
/// origin and unit: epochs are aligned and evaluated separately, and the total is over the matched poses of
/// all of them. An epoch with too few poses to align is named and left out.
#[derive(Debug, Args)]
#[command(arg = no_instance())]
pub struct EvaluateArgs {
    /// Estimated trajectory
    #[arg(value_name = "EST")]
    estimate: PathBuf,
    /// Ground-truth trajectory
    #[arg(value_name = "GT")]
    truth: PathBuf,
    /// Alignment before positions are compared
    #[arg(long, value_enum, default_value = "sim3")]
    align: Align,
    /// Largest difference between matched time stamps, in seconds
    #[arg(long, value_name = "SECS", default_value_t = 0.02, value_parser = parse_difference)]
    max_difference: f64,
    /// sensor.yaml of the camera, if it is not next to EuRoC ground truth; with ground truth in another
    /// format, also declares its poses to be those of the body
    #[arg(long, value_name = "FILE")]
    sensor: Option<PathBuf>,
    /// Print the figures as JSON, with the keys of summary.json: the total, and one entry in `epochs` for each epoch
    #[arg(long)]
    json: bool,
    /// Write a plot of both trajectories and the error
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
}

/// Parses a difference of stamps: an hour is longer than any clock error worth bridging.
fn parse_difference(text: &str) -> Result<f64, String> {
    const LONGEST_SECS: f64 = 3600.0;
    let secs: f64 = text.parse().map_err(|_| "expected seconds, such as 0.02".to_owned())?;
    let allowed = (0.0..=LONGEST_SECS).contains(&secs);
    allowed.then_some(secs).ok_or_else(|| format!("expected 0 to {LONGEST_SECS} s"))
}

/// Reads both files, compares them and prints the figures.
pub fn run(args: &EvaluateArgs) -> Result<ExitCode, Box<dyn Error>> {
    let mut estimate = read_trajectory_file(&args.estimate)?;
    let mut truth = read_trajectory_file(&args.truth)?;
    move_to_camera(&mut estimate, &mut truth, args)?;
    let truth = one_path(&truth.poses, &args.truth)?;
    let alignment = match args.align {
        Align::Sim3 => TrajectoryAlignment::Sim3,
        Align::Se3 => TrajectoryAlignment::SE3,
        Align::None => TrajectoryAlignment::None,
    };
    let max_difference_nanos = (args.max_difference * 1e9).round() as i64;
    let evaluation = evaluate_epochs(&estimate.poses, &truth, alignment, max_difference_nanos)
        .map_err(|error| {
            use EvaluationError::{OneMatch, TooFewMatches};
            let option = match error {
                TooFewMatches { .. } | OneMatch { .. } => " (--max-difference)",
                _ => "",
            };
            format!("{} against {}: {error}{option}", args.estimate.display(), args.truth.display())
        })?;
    if let Some(path) = &args.plot {
        let svg = evaluation_plot(&evaluation, &truth);
        write_atomically(path, |file| file.write_all(svg.as_bytes()))
            .map_err(|error| format!("cannot write {}: {error}", path.display()))?;
    }
    let text = match args.json {
        true => evaluation_json(&evaluation)?,
        false => evaluation_text(&evaluation, alignment),
    };
    print(&format!("{text}\n"))?;
    Ok(ExitCode::SUCCESS)
}

/// The poses of the ground truth, which must have one origin and one unit.
fn one_path(truth: &[EpochPose], path: &Path) -> Result<Vec<StampedPose>, String> {
    let epochs = by_epoch(truth);
    match epochs.len() {
        0 | 1 => Ok(epochs.into_values().flatten().collect()),
        count => Err(format!(
            "{} marks {count} epochs, each with a separate origin and unit, and cannot be ground truth: keep the \
             lines of one epoch",
            path.display()
        )),
    }
}

/// Moves body poses to the camera on the body: the estimate is the camera's, and seen from another position,
/// or along other axes, the same motion has a different relative error. EuRoC poses are the body's, and so is
/// ground truth in any format for which `--sensor` is given.
fn move_to_camera(
    estimate: &mut TrajectoryFile,
    truth: &mut TrajectoryFile,
    args: &EvaluateArgs,
) -> Result<(), Box<dyn Error>> {
    let beside = || sensor_beside(&args.truth).filter(|_| truth.is_euroc);
    let Some(path) = args.sensor.clone().or_else(beside) else {
        if truth.is_euroc {
            note(&format!(
                "warning: {} holds poses of the body and there is no cam0/sensor.yaml next to its folder: relative \
                 errors do not refer to the camera's axes; name the file with --sensor",
                args.truth.display()
            ));
        }
        return Ok(());
    };
    let body_from_camera = sensor_yaml::read(&path)?.body_from_camera;
    let with_estimate = estimate.is_euroc;
    let moved = if with_estimate { &mut estimate.poses[..] } else { &mut [] };
    for EpochPose { pose, .. } in truth.poses.iter_mut().chain(moved) {
        pose.world_from_camera = pose.world_from_camera * body_from_camera;
    }
    let what = if with_estimate { "estimate and ground truth" } else { "ground truth" };
    note(&format!("{what}: poses of the body, moved to the camera with {}", path.display()));
    Ok(())
}
