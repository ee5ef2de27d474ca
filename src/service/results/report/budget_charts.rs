//! Quality of a pose against iterations and against time: two charts of the report.

use crate::service::results::budget_curve::{BudgetCurve, BudgetSample, displacement_by_time};
use crate::service::results::report::chart::{Chart, Scaling};
use crate::service::results::report::charts::{ERROR, ESTIMATE};
use crate::service::results::report::series::{Mark, Series};
use crate::slam::evaluation::statistics::median;

/// A smaller displacement counts as this: a hundredth of the accuracy of the alignment itself, pixels.
const MIN_PX: f64 = 1e-3;

/// The time axis ends at this many times the median time of a whole frame: one frame delayed by another process would
/// squeeze all others.
const SHOWN_MEDIANS: f64 = 2.0;

/// Points along the time axis.
const TIME_STEPS: usize = 160;

/// Displacement against iterations and against time; empty where no frame was realigned.
pub fn budget_charts(samples: &[BudgetSample], curve: Option<&BudgetCurve>) -> Vec<Chart> {
    let Some(curve) = curve else { return Vec::new() };
    let iterations = || curve.iterations.iter().map(|&n| f64::from(n));
    let by_iterations = |displacements: &[f64]| -> Vec<[f64; 2]> {
        iterations().zip(displacements).map(|(n, &px)| [n, px.max(MIN_PX)]).collect()
    };
    let whole: Vec<f64> =
        samples.iter().filter_map(|s| s.last()).map(|step| step.nanos as f64 * 1e-6).collect();
    let longest = SHOWN_MEDIANS * median(&whole).unwrap_or(0.0);
    let times: Vec<f64> =
        (0..=TIME_STEPS).map(|i| i as f64 / TIME_STEPS as f64 * longest).collect();
    let by_time = displacement_by_time(samples, &times);
    let share = |index: usize| -> Vec<[f64; 2]> {
        by_time.iter().map(|(time, px)| [*time, px[index].max(MIN_PX)]).collect()
    };
    let mut by_iterations = chart(
        "Pose error by iterations",
        "iterations on all levels",
        by_iterations(&curve.displacement_px_p50),
        by_iterations(&curve.displacement_px_p90),
    );
    // The budgets that were tried.
    let dots = by_iterations.series.clone().into_iter();
    by_iterations.series.extend(dots.map(|line| Series {
        name: "",
        mark: Mark::Dots(2.4),
        ..line
    }));
    vec![by_iterations, chart("Pose error by time", "time in the tracker [ms]", share(0), share(1))]
}

fn chart(title: &'static str, x_label: &str, half: Vec<[f64; 2]>, most: Vec<[f64; 2]>) -> Chart {
    let line = |name, colour, points| Series { name, colour, mark: Mark::Path, points };
    Chart {
        title,
        meaning: "Distance of a pose that was stopped early from the one without a deadline. It should fall below 0.1 px \
                  within the deadline.",
        x_label: x_label.into(),
        y_label: "distance to the final pose [px]".into(),
        height: 260.0,
        scaling: Scaling::Decades,
        series: vec![line("90 % of frames", ERROR, most), line("median", ESTIMATE, half)],
    }
}
