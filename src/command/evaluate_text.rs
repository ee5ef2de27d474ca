//! Output of `semidense evaluate`: a table, or JSON with the keys of `summary.json`.

use serde::Serialize;

use crate::service::results::summary::TrajectorySummary;
use crate::slam::counted::counted;
use crate::slam::evaluation::epochs::{EpochEvaluation, EpochsEvaluation};
use crate::slam::evaluation::statistics::ErrorStatistics;
use crate::slam::evaluation::umeyama::TrajectoryAlignment;

/// The figures of all epochs together, and of each one.
#[derive(Debug, Serialize)]
struct EvaluationSummary {
    /// Over all matched poses; `ate_scale` is null where several epochs each have their own.
    #[serde(flatten)]
    total: TrajectorySummary,
    epochs: Vec<EpochSummary>,
}

/// The figures of one epoch.
#[derive(Debug, Serialize)]
struct EpochSummary {
    epoch: u32,
    poses: usize,
    /// Why the epoch is left out of the total; null if it is not.
    left_out: Option<String>,
    /// All null if the epoch is left out.
    #[serde(flatten)]
    errors: TrajectorySummary,
}

/// The figures as JSON.
pub fn evaluation_json(evaluation: &EpochsEvaluation) -> serde_json::Result<String> {
    let total = TrajectorySummary {
        ate_scale: common_scale(evaluation),
        ..TrajectorySummary::from(&evaluation.total)
    };
    let epoch = |of: &EpochEvaluation| EpochSummary {
        epoch: of.epoch,
        poses: of.poses,
        left_out: of.result.as_ref().err().map(ToString::to_string),
        errors: of.result.as_ref().map(TrajectorySummary::from).unwrap_or_default(),
    };
    let epochs = evaluation.epochs.iter().map(epoch).collect();
    serde_json::to_string_pretty(&EvaluationSummary { total, epochs })
}

/// The scale if one epoch has all matches; `None` if several epochs each have their own.
fn common_scale(evaluation: &EpochsEvaluation) -> Option<f64> {
    let mut scales = evaluation.evaluated().map(|of| of.alignment.scale);
    scales.next().filter(|_| scales.next().is_none())
}

/// The figures as a table; with several epochs, a line for each precedes the total.
pub fn evaluation_text(evaluation: &EpochsEvaluation, alignment: TrajectoryAlignment) -> String {
    let total = &evaluation.total;
    let (name, is_scaled) = match alignment {
        TrajectoryAlignment::Sim3 => ("sim3", true),
        TrajectoryAlignment::SE3 => ("se3", false),
        TrajectoryAlignment::None => ("none", false),
    };
    let fitted = match common_scale(evaluation).filter(|_| is_scaled) {
        Some(scale) => format!("{name}, scale {scale:.6}"),
        None => name.to_owned(),
    };
    let poses: usize = evaluation.epochs.iter().map(|of| of.poses).sum();
    let mut lines = epoch_lines(evaluation);
    lines.extend([
        format!("{} of {poses} poses matched", total.pairs.len()),
        format!("alignment {fitted}; path {:.3} m", total.path_length),
        format!("{:<26} {:>12} {:>12} {:>12} {:>12}", "", "rmse", "mean", "median", "max"),
    ]);
    for (name, statistics) in [
        ("ATE [m]", Some(total.ate)),
        ("RPE, one frame [m]", Some(total.rpe_translation)),
        ("RPE, one frame [deg]", Some(total.rpe_rotation_deg)),
        ("RPE, 1 s [m]", total.rpe_translation_1s),
        ("RPE, 1 s [deg]", total.rpe_rotation_deg_1s),
    ] {
        lines.extend(statistics.map(|of| statistics_row(name, of)));
    }
    if let Some(error) = total.window_error {
        lines.push(format!("windows of 30 frames: median error {error:.6} m"));
    }
    if let Some(ratio) = total.window_scale_ratio {
        lines.push(format!("windows of 100 frames: largest / smallest scale {ratio:.4}"));
    }
    lines.join("\n")
}

fn statistics_row(name: &str, s: ErrorStatistics) -> String {
    format!("{name:<26} {:>12.6} {:>12.6} {:>12.6} {:>12.6}", s.rmse, s.mean, s.median, s.max)
}

/// A line for each epoch and a heading for the total that follows; nothing for a single epoch.
fn epoch_lines(evaluation: &EpochsEvaluation) -> Vec<String> {
    if evaluation.epochs.len() < 2 {
        return Vec::new();
    }
    let columns = ["poses", "matched", "path [m]", "scale", "ATE rmse [m]"];
    let [poses, matched, path, scale, ate] = columns;
    let mut lines = vec![
        format!(
            "{}, each with a separate origin and unit, aligned by itself",
            counted(evaluation.epochs.len(), "epoch")
        ),
        format!("{:<12} {poses:>8} {matched:>8} {path:>12} {scale:>12} {ate:>12}", ""),
    ];
    for EpochEvaluation { epoch, poses, result } in &evaluation.epochs {
        let name = format!("epoch {epoch}");
        lines.push(match result {
            Ok(of) => format!(
                "{name:<12} {poses:>8} {:>8} {:>12.3} {:>12.6} {:>12.6}",
                of.pairs.len(),
                of.path_length,
                of.alignment.scale,
                of.ate.rmse
            ),
            Err(reason) => format!("{name:<12} {poses:>8} left out: {reason}"),
        });
    }
    let evaluated = counted(evaluation.evaluated().count(), "epoch");
    lines.push(format!("total of {evaluated}, over all matched poses:"));
    lines
}
