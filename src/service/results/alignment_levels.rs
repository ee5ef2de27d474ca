//! Cost of alignment on each pyramid level, over the frames of a run.

use serde::{Deserialize, Serialize};

use crate::service::alignment_stamps::{AlignmentTrace, LevelTrace};
use crate::slam::evaluation::statistics::percentiles;
use crate::slam::image::sums::MAX_LEVELS;

/// Frames aligned on one level.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LevelSummary {
    /// The level; 0 is the finest.
    pub level: u32,
    /// Number of frames aligned on it.
    pub frames: u64,
    /// Its points, median over the frames.
    pub points: f64,
    /// Iterations per frame, median.
    pub iterations_median: f64,
    /// Iterations per frame, mean.
    pub iterations_mean: f64,
    /// Nanoseconds per point and iteration, median over the frames; null where none was timed.
    pub nanos_per_point: Option<f64>,
}

/// One per level that frames were aligned on, finest first; `None` without any.
pub fn alignment_levels(traces: &[AlignmentTrace]) -> Option<Vec<LevelSummary>> {
    let levels: Vec<_> = (0..MAX_LEVELS).filter_map(|level| summary_of(traces, level)).collect();
    (!levels.is_empty()).then_some(levels)
}

fn summary_of(traces: &[AlignmentTrace], level: usize) -> Option<LevelSummary> {
    let of_level = traces.iter().map(|trace| trace.levels[level]);
    let frames: Vec<LevelTrace> = of_level.filter(|trace| trace.iterations > 0).collect();
    let median = |values: Vec<f64>| percentiles(values, [0.5]).map(|[median]| median);
    let of = |value: fn(&LevelTrace) -> u32| {
        frames.iter().map(|trace| f64::from(value(trace))).collect::<Vec<_>>()
    };
    let iterations = of(|trace| trace.iterations);
    Some(LevelSummary {
        level: level as u32,
        frames: frames.len() as u64,
        points: median(of(|trace| trace.points))?,
        iterations_mean: iterations.iter().sum::<f64>() / iterations.len() as f64,
        iterations_median: median(iterations)?,
        nanos_per_point: median(frames.iter().filter_map(LevelTrace::nanos_per_point).collect()),
    })
}
