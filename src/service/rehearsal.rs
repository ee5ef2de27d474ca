//! Realigns frames of a replay with fewer iterations: what a deadline would have cost.

use std::time::Instant;

use crate::service::clock::elapsed_nanos;
use crate::service::results::budget_curve::{BudgetSample, BudgetStep, is_tried};
use crate::slam::alignment::displacement::mean_displacement_px;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::tracker::{Memory, Tracker};

/// Fewest frames from one realigned frame to the next: a twentieth of a replay's time.
const MIN_INTERVAL: usize = 10;

/// Most realigned frames of a sequence: enough for a percentile.
const MAX_FRAMES: usize = 60;

/// One point in this many is enough for a mean.
const POINT_STRIDE: usize = 8;

/// Realigns frames spread over a sequence.
#[derive(Debug)]
pub struct Rehearsal {
    interval: usize,
    frames: usize,
    samples: Vec<BudgetSample>,
    nanos: u64,
}

impl Rehearsal {
    /// For a sequence of `total` frames, if that is known.
    pub fn new(total: Option<usize>) -> Self {
        let interval = total.map_or(0, |total| total.div_ceil(MAX_FRAMES)).max(MIN_INTERVAL);
        Self { interval, frames: 0, samples: Vec::new(), nanos: 0 }
    }

    /// Realigns `frame` when it is due. `memory` is that of `tracker` before it tracked the frame; the tracker is
    /// unchanged.
    pub fn observe(&mut self, tracker: &mut Tracker, memory: &Memory, frame: &FrameView<'_>) {
        self.frames += 1;
        if !self.frames.is_multiple_of(self.interval) || self.samples.len() >= MAX_FRAMES {
            return;
        }
        let begin = Instant::now();
        self.samples.extend(rehearse(tracker, memory, frame));
        self.nanos += elapsed_nanos(begin);
    }

    /// The realigned frames, and the time they took.
    pub fn into_samples(self) -> (Vec<BudgetSample>, u64) {
        (self.samples, self.nanos)
    }
}

/// Aligns one frame with growing budgets; `None` where it is not tracked.
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
    // A frame that is cut short is evaluated once more on the finest level: less may take longer than more.
    Some(attempts.into_iter().map(step).chain([last]).collect())
}
