//! `semidense evaluate`: a trajectory against ground truth.

use std::error::Error;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, ValueEnum};

use crate::capture::euroc::sensor_beside;
use crate::capture::sensor_yaml;
use crate::command::print::{note, print};
use crate::service::atomic_file::write_atomically;
use crate::service::results::report::evaluation_plot::evaluation_plot;
use crate::service::results::summary::TrajectorySummary;
use crate::service::trajectory_file::{TrajectoryFile, read_trajectory_file};
use crate::slam::evaluation::statistics::ErrorStatistics;
use crate::slam::evaluation::umeyama::TrajectoryAlignment;
use crate::slam::evaluation::{TrajectoryEvaluation, evaluate_trajectory};

/// What is fitted before positions are compared.
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
/// Files are in TUM layout (timestamp tx ty tz qx qy qz qw) or EuRoC ground truth (CSV). EuRoC poses are
/// those of the body; they are moved to the camera with T_BS of cam0/sensor.yaml, as is an estimate in that
/// layout. Each pose of the shorter trajectory is compared with the pose of the longer one that is nearest in
/// time; the figures are those of the Python package evo.
#[derive(Debug, Args)]
pub struct EvaluateArgs {
    /// Estimated trajectory
    #[arg(value_name = "EST")]
    estimate: PathBuf,
    /// True trajectory
    #[arg(value_name = "GT")]
    truth: PathBuf,
    /// Alignment before positions are compared
    #[arg(long, value_enum, default_value = "sim3")]
    align: Align,
    /// Largest difference between matched time stamps, in seconds
    #[arg(long, value_name = "SECS", default_value_t = 0.02, value_parser = parse_difference)]
    max_difference: f64,
    /// sensor.yaml of the camera, if it is not next to EuRoC ground truth; with ground truth in another layout it
    /// also says that its poses are those of the body
    #[arg(long, value_name = "FILE")]
    sensor: Option<PathBuf>,
    /// Print the figures as JSON, with the keys of summary.json
    #[arg(long)]
    json: bool,
    /// Write a plot of both trajectories and the error
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
}

/// A difference of stamps: an hour is longer than any clock error worth bridging.
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
    let (estimate, truth) = (estimate.poses, truth.poses);
    let alignment = match args.align {
        Align::Sim3 => TrajectoryAlignment::Sim3,
        Align::Se3 => TrajectoryAlignment::SE3,
        Align::None => TrajectoryAlignment::None,
    };
    let max_difference_nanos = (args.max_difference * 1e9).round() as i64;
    let evaluation = evaluate_trajectory(&estimate, &truth, alignment, max_difference_nanos)
        .map_err(|error| {
            format!("{} against {}: {error}", args.estimate.display(), args.truth.display())
        })?;
    if let Some(path) = &args.plot {
        let svg = evaluation_plot(&estimate, &truth, &evaluation);
        write_atomically(path, |file| file.write_all(svg.as_bytes()))
            .map_err(|error| format!("cannot write {}: {error}", path.display()))?;
    }
    let text = if args.json {
        serde_json::to_string_pretty(&TrajectorySummary::from(&evaluation))?
    } else {
        evaluation_text(&evaluation, estimate.len(), alignment)
    };
    print(&format!("{text}\n"))?;
    Ok(ExitCode::SUCCESS)
}

/// Moves poses of the body to the camera on it: an estimate is the camera's, and seen from another
/// place, or along other axes, the same motion has another relative error. EuRoC's poses are the body's, and
/// so is ground truth of any layout for which `--sensor` is given.
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
                 errors are not about the camera's axes; name the file with --sensor",
                args.truth.display()
            ));
        }
        return Ok(());
    };
    let body_from_camera = sensor_yaml::read(&path)?.body_from_camera;
    let with_estimate = estimate.is_euroc;
    let moved = if with_estimate { &mut estimate.poses[..] } else { &mut [] };
    for pose in truth.poses.iter_mut().chain(moved) {
        pose.world_from_camera = pose.world_from_camera * body_from_camera;
    }
    let what = if with_estimate { "estimate and ground truth" } else { "ground truth" };
    note(&format!("{what}: poses of the body, moved to the camera with {}", path.display()));
    Ok(())
}

/// The figures as a table.
fn evaluation_text(
    evaluation: &TrajectoryEvaluation,
    estimated: usize,
    alignment: TrajectoryAlignment,
) -> String {
    let fitted = match alignment {
        TrajectoryAlignment::Sim3 => format!("sim3, scale {:.6}", evaluation.alignment.scale),
        TrajectoryAlignment::SE3 => "se3".to_owned(),
        TrajectoryAlignment::None => "none".to_owned(),
    };
    let mut lines = vec![
        format!("{} of {estimated} poses matched", evaluation.association.pairs.len()),
        format!("alignment {fitted}; path {:.3} m", evaluation.path_length),
        format!("{:<26} {:>12} {:>12} {:>12} {:>12}", "", "rmse", "mean", "median", "max"),
    ];
    let mut row = |name: &str, statistics: Option<ErrorStatistics>| {
        if let Some(s) = statistics {
            lines.push(format!(
                "{name:<26} {:>12.6} {:>12.6} {:>12.6} {:>12.6}",
                s.rmse, s.mean, s.median, s.max
            ));
        }
    };
    row("ATE [m]", Some(evaluation.ate));
    row("RPE, one frame [m]", Some(evaluation.rpe_translation));
    row("RPE, one frame [deg]", Some(evaluation.rpe_rotation_deg));
    row("RPE, 1 s [m]", evaluation.rpe_translation_1s);
    row("RPE, 1 s [deg]", evaluation.rpe_rotation_deg_1s);
    if let Some(error) = evaluation.window_error {
        lines.push(format!("windows of 30 frames: median error {error:.6} m"));
    }
    if let Some(ratio) = evaluation.window_scale_ratio {
        lines.push(format!("windows of 100 frames: largest / smallest scale {ratio:.4}"));
    }
    lines.join("\n")
}
