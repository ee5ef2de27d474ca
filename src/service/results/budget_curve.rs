//! Quality of a pose as a function of the budget: frames realigned with fewer iterations, and the curve through them.

use serde::{Deserialize, Serialize};

use crate::slam::evaluation::statistics::percentiles;

/// Shares of the frames whose displacement is reported: half of them, and most.
const SPREAD: [f64; 2] = [0.5, 0.9];

/// One frame, aligned with one budget.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BudgetStep {
    /// Allowed iterations, all levels together.
    pub iterations: u32,
    /// Time of the whole frame, including the image pyramid.
    pub nanos: u64,
    /// Mean image distance of the keyframe's points from where the pose without a limit projects them, pixels of level
    /// 0.
    pub displacement_px: f64,
}

/// One frame with growing budgets; the last has no limit, so that its displacement is 0.
pub type BudgetSample = Vec<BudgetStep>;

/// Displacements by budget over all realigned frames, column by column.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct BudgetCurve {
    /// Allowed iterations.
    pub iterations: Vec<u32>,
    /// Median time of a frame with that budget.
    pub track_ms_p50: Vec<f64>,
    /// Median over the frames of the mean displacement, pixels of level 0.
    pub displacement_px_p50: Vec<f64>,
    /// The displacement that 90 % of the frames do not exceed.
    pub displacement_px_p90: Vec<f64>,
}

impl BudgetCurve {
    /// The curve through `samples`; `None` where there are none.
    pub fn of(samples: &[BudgetSample]) -> Option<Self> {
        let mut budgets: Vec<u32> = samples.iter().flatten().map(|step| step.iterations).collect();
        budgets.sort_unstable();
        budgets.dedup();
        // The last step of a frame has no limit, so it is not a budget of other frames.
        budgets.retain(|&budget| budget == 0 || is_tried(budget));
        let mut curve = Self::default();
        for budget in budgets {
            let reached =
                || samples.iter().filter_map(|s| within(s, |step| step.iterations <= budget));
            let [p50, p90] = percentiles(reached().map(|step| step.displacement_px), SPREAD)?;
            let [time] = percentiles(reached().map(|step| step.nanos as f64 * 1e-6), [0.5])?;
            curve.iterations.push(budget);
            curve.track_ms_p50.push(time);
            curve.displacement_px_p50.push(p50);
            curve.displacement_px_p90.push(p90);
        }
        (!curve.iterations.is_empty()).then_some(curve)
    }
}

/// Whether frames are realigned with this budget: each of the first four, then two steps per octave.
pub fn is_tried(iterations: u32) -> bool {
    let octave = iterations.checked_ilog2().unwrap_or(0);
    iterations <= 4 || iterations == 1 << octave || 2 * iterations == 3 << octave
}

/// Median and 90th percentile of the displacement reached within each of `times_ms`, for times at which every frame has
/// a pose.
pub fn displacement_by_time(samples: &[BudgetSample], times_ms: &[f64]) -> Vec<(f64, [f64; 2])> {
    let at = |&time: &f64| {
        let nanos = (time * 1e6) as u64;
        let reached = samples.iter().map(|s| within(s, |step| step.nanos <= nanos));
        let displacements: Option<Vec<f64>> =
            reached.map(|step| step.map(|step| step.displacement_px)).collect();
        Some((time, percentiles(displacements?, SPREAD)?))
    };
    times_ms.iter().filter_map(at).collect()
}

/// The last allowed step of a frame; a finer budget would not have got further.
fn within(sample: &BudgetSample, is_allowed: impl Fn(&BudgetStep) -> bool) -> Option<&BudgetStep> {
    sample.iter().rev().find(|step| is_allowed(step))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(displacements: &[(u32, f64)]) -> BudgetSample {
        let step = |&(iterations, displacement_px): &(u32, f64)| BudgetStep {
            iterations,
            nanos: 100_000 * u64::from(iterations + 1),
            displacement_px,
        };
        displacements.iter().map(step).collect()
    }

    #[test]
    fn a_frame_that_finishes_early_keeps_its_displacement() {
        let samples = [
            sample(&[(0, 4.0), (1, 2.0), (2, 0.0)]),
            sample(&[(0, 6.0), (1, 3.0), (2, 1.0), (3, 0.5), (4, 0.25), (5, 0.0)]),
            sample(&[(0, 8.0), (1, 5.0), (2, 2.0), (3, 0.0)]),
        ];
        let curve = BudgetCurve::of(&samples).unwrap();
        assert_eq!(curve.iterations, [0, 1, 2, 3, 4]);
        assert_eq!(curve.displacement_px_p50, [6.0, 3.0, 1.0, 0.0, 0.0]);
        assert_eq!(curve.displacement_px_p90, [8.0, 5.0, 2.0, 0.5, 0.25]);
        assert!((curve.track_ms_p50[4] - 0.4).abs() < 1e-12);
        let by_time = displacement_by_time(&samples, &[0.05, 0.15, 0.65]);
        assert_eq!(by_time, [(0.15, [6.0, 8.0]), (0.65, [0.0, 0.0])]);
        assert_eq!(BudgetCurve::of(&[]), None);
        assert!(displacement_by_time(&[], &[1.0]).is_empty());
    }

    #[test]
    fn two_budgets_are_tried_per_octave() {
        let tried: Vec<u32> = (0..=64).filter(|&n| is_tried(n)).collect();
        assert_eq!(tried, [0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64]);
    }
}
