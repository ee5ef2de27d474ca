//! Costs of the parts of an alignment, from the times at which the aligner queries its budget.
//!
//! It queries with the level before each iteration, which ends in one evaluation of the level's points; the first
//! iteration on a level also pays for the evaluation the level starts with. Time after the last query of a frame is not
//! counted, the covariance included.

use crate::service::clock::now_nanos;
use crate::slam::alignment::reference::Reference;
use crate::slam::image::sums::MAX_LEVELS;

/// The alignment of one frame on one pyramid level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LevelTrace {
    /// Points of the level, in view or not.
    pub points: u32,
    /// Iterations.
    pub iterations: u32,
    /// Evaluations that were timed.
    pub timed_evaluations: u32,
    /// Their total time.
    pub timed_nanos: u64,
}

impl LevelTrace {
    /// Nanoseconds per point and evaluation; `None` where nothing was timed.
    pub fn nanos_per_point(&self) -> Option<f64> {
        let evaluated = u64::from(self.points) * u64::from(self.timed_evaluations);
        (evaluated > 0).then(|| self.timed_nanos as f64 / evaluated as f64)
    }
}

/// The alignment of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct AlignmentTrace {
    /// From the frame to the first iteration: the image pyramid, the prediction, and the first
    /// look at the coarsest level, some thousandths of a millisecond.
    pub pyramid_nanos: u64,
    /// By level, finest first.
    pub levels: [LevelTrace; MAX_LEVELS],
}

/// Takes a stamp at every query, in its own memory.
#[derive(Debug)]
pub struct AlignmentStamps {
    begin_nanos: i64,
    /// Level and time of the last query, and the evaluations that it was for.
    last: Option<(usize, i64, u32)>,
    trace: AlignmentTrace,
}

impl AlignmentStamps {
    /// Begins a frame now.
    pub fn begin() -> Self {
        Self { begin_nanos: now_nanos(), last: None, trace: AlignmentTrace::default() }
    }

    /// The aligner is about to iterate on `level`.
    pub fn ask(&mut self, level: usize) {
        self.ask_at(level, now_nanos());
    }

    fn ask_at(&mut self, level: usize, now: i64) {
        let elapsed = |since: i64| u64::try_from(now.saturating_sub(since)).unwrap_or(0);
        let mut evaluations = 2;
        match self.last {
            None => self.trace.pyramid_nanos = elapsed(self.begin_nanos),
            Some((before, since, paid)) => {
                if let Some(level) = self.trace.levels.get_mut(before) {
                    level.timed_nanos += elapsed(since);
                    level.timed_evaluations += paid;
                }
                evaluations -= u32::from(before == level);
            }
        }
        if let Some(level) = self.trace.levels.get_mut(level) {
            level.iterations += 1;
        }
        self.last = Some((level, now, evaluations));
    }

    /// Cost of the frame that was aligned to `reference`; `None` where it was not aligned.
    pub fn trace(mut self, reference: &Reference) -> Option<AlignmentTrace> {
        self.last?;
        for (level, trace) in self.trace.levels.iter_mut().enumerate() {
            trace.points = reference.level(level).len() as u32;
        }
        Some(self.trace)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::alignment::reference::ReferenceParams;

    #[test]
    fn the_first_iteration_of_a_level_pays_for_two_evaluations() {
        let mut stamps = AlignmentStamps { begin_nanos: 100, ..AlignmentStamps::begin() };
        // Three iterations on level 2, two on level 1, of which the last is not timed.
        for (level, now) in [(2, 150), (2, 170), (2, 180), (1, 190), (1, 290)] {
            stamps.ask_at(level, now);
        }
        stamps.ask_at(MAX_LEVELS, 300);
        let trace = stamps.trace(&Reference::new(ReferenceParams::default())).unwrap();
        assert_eq!(trace.pyramid_nanos, 50);
        let level = |iterations, timed_evaluations, timed_nanos| LevelTrace {
            points: 0,
            iterations,
            timed_evaluations,
            timed_nanos,
        };
        assert_eq!(trace.levels[2], level(3, 4, 40));
        assert_eq!(trace.levels[1], level(2, 3, 110));
        assert_eq!(trace.levels[0], LevelTrace::default());
        let with_points = LevelTrace { points: 5, ..trace.levels[2] };
        assert_eq!(with_points.nanos_per_point(), Some(2.0));
        assert_eq!(trace.levels[0].nanos_per_point(), None);
    }

    #[test]
    fn a_frame_that_is_not_aligned_leaves_no_trace() {
        let reference = Reference::new(ReferenceParams::default());
        assert_eq!(AlignmentStamps::begin().trace(&reference), None);
    }
}
