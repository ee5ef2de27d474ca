//! Frames of a replay aligned again with fewer iterations: what a deadline would have cost.

use std::time::Instant;

use crate::service::results::budget_curve::{BudgetSample, BudgetStep, is_tried};
use crate::slam::alignment::displacement::mean_displacement_px;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::tracker::{Memory, Tracker};

/// Frames from one that is aligned again to the next, at least: a twentieth of a replay's time.
const LEAST_INTERVAL: usize = 10;

/// Frames of a sequence that are aligned again, at most: enough for a percentile.
const MOST_FRAMES: usize = 60;

/// Every so many points are enough for a mean.
const POINT_STRIDE: usize = 8;

/// Aligns frames again, spread over a sequence.
#[derive(Debug)]
pub struct Rehearsal {
    interval: usize,
    frames: usize,
    samples: Vec<BudgetSample>,
    nanos: u64,
}

impl Rehearsal {
    /// For a sequence of `total` frames, where that is known.
    pub fn new(total: Option<usize>) -> Self {
        let interval = total.map_or(0, |total| total.div_ceil(MOST_FRAMES)).max(LEAST_INTERVAL);
        Self { interval, frames: 0, samples: Vec::new(), nanos: 0 }
    }

    /// Aligns `frame` again where its turn has come. `memory` is what `tracker` remembered before it tracked the
    /// frame; the tracker stays as it is.
    pub fn observe(&mut self, tracker: &mut Tracker, memory: &Memory, frame: &FrameView<'_>) {
        self.frames += 1;
        if !self.frames.is_multiple_of(self.interval) || self.samples.len() >= MOST_FRAMES {
            return;
        }
        let begin = Instant::now();
        self.samples.extend(rehearse(tracker, memory, frame));
        self.nanos += elapsed_nanos(begin);
    }

    /// The frames that were aligned again, and the time that it took.
    pub fn into_samples(self) -> (Vec<BudgetSample>, u64) {
        (self.samples, self.nanos)
    }
}

/// One frame with growing budgets; `None` where it is not tracked.
fn rehearse(tracker: &mut Tracker, memory: &Memory, frame: &FrameView<'_>) -> Option<BudgetSample> {
    let mut attempt = |budget: u32| {
        let (begin, mut used) = (Instant::now(), 0);
        let estimate = tracker.rehearse(memory, frame, &mut |_| {
            let is_left = used < budget;
            used += u32::from(is_left);
            is_left
        });
        (estimate, used, elapsed_nanos(begin))
    };
    let (best, needed, nanos) = attempt(u32::MAX);
    if !best.state.is_tracked() {
        return None;
    }
    let attempts: Vec<_> = (0..needed)
        .filter(|&budget| is_tried(budget))
        .map(|budget| {
            let (estimate, _, nanos) = attempt(budget);
            (budget, estimate.keyframe_from_camera.inverse(), nanos)
        })
        .collect();
    let reference = tracker.reference()?;
    let best = best.keyframe_from_camera.inverse();
    let step = |(iterations, pose, nanos): (u32, SE3, u64)| BudgetStep {
        iterations,
        nanos,
        displacement_px: mean_displacement_px(reference, &pose, &best, POINT_STRIDE),
    };
    let last = BudgetStep { iterations: needed, nanos, displacement_px: 0.0 };
    // A frame that is cut short takes a last look at the finest level: less may take longer than more.
    Some(attempts.into_iter().map(step).chain([last]).collect())
}

fn elapsed_nanos(begin: Instant) -> u64 {
    u64::try_from(begin.elapsed().as_nanos()).unwrap_or(u64::MAX)
}
