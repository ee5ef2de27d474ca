//! Estimates the offset between another machine's clock and ours.
//!
//! CLOCK_MONOTONIC counts from each machine's own start. The receiver queries the sender's clock once a
//! second; an answer determines the offset to within half of the round-trip time (Cristian, 1989), whether or
//! not the clocks of the two machines are set. Until the first answer the offset follows from CLOCK_REALTIME,
//! which is as accurate as its synchronisation on both machines.

use std::collections::VecDeque;

/// Number of answers compared: half a minute of them.
const KEPT: usize = 30;
/// Upper limit for the relative drift of two quartz clocks, seconds per second.
const MAX_DRIFT: f64 = 200e-6;

/// A query of the other clock and its answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockAnswer {
    /// Our clock at the query.
    pub asked_nanos: i64,
    /// The other clock at the answer.
    pub remote_nanos: i64,
    /// Our clock when the answer arrived.
    pub answered_nanos: i64,
}

impl ClockAnswer {
    /// Ours − theirs, at the middle of the round trip.
    fn offset_nanos(&self) -> i64 {
        let middle = self.asked_nanos.saturating_add(self.uncertainty_nanos());
        middle.saturating_sub(self.remote_nanos)
    }

    /// Bound on the error of the offset.
    fn uncertainty_nanos(&self) -> i64 {
        self.answered_nanos.saturating_sub(self.asked_nanos) / 2
    }
}

/// The offset between two clocks.
#[derive(Debug, Clone, Default)]
pub struct ClockOffset {
    answers: VecDeque<ClockAnswer>,
    /// From CLOCK_REALTIME of both.
    by_realtime_nanos: i64,
}

impl ClockOffset {
    /// Sets CLOCK_REALTIME − CLOCK_MONOTONIC of both machines.
    pub fn set_realtime(&mut self, remote_nanos: i64, local_nanos: i64) {
        self.by_realtime_nanos = remote_nanos.saturating_sub(local_nanos);
    }

    /// Adds an answer. One that contradicts the earlier ones shows that the other machine was suspended and
    /// its clock stopped: the earlier ones are discarded.
    pub fn take(&mut self, answer: ClockAnswer) {
        if answer.answered_nanos < answer.asked_nanos {
            return;
        }
        let is_contradicted = self.best().is_some_and(|best| {
            let age = answer.answered_nanos.saturating_sub(best.answered_nanos);
            let allowed = best.uncertainty_nanos() + answer.uncertainty_nanos();
            let apart = best.offset_nanos().saturating_sub(answer.offset_nanos()).saturating_abs();
            apart > allowed.saturating_add((age as f64 * MAX_DRIFT) as i64)
        });
        if is_contradicted {
            self.answers.clear();
        }
        if self.answers.len() == KEPT {
            self.answers.pop_front();
        }
        self.answers.push_back(answer);
    }

    /// Converts `remote_nanos` from the other clock to ours.
    pub fn local_nanos(&self, remote_nanos: i64) -> i64 {
        let offset = self.best().map_or(self.by_realtime_nanos, |best| best.offset_nanos());
        remote_nanos.saturating_add(offset)
    }

    /// Bound on the error of the conversion; `None` while it relies on CLOCK_REALTIME.
    pub fn uncertainty_nanos(&self) -> Option<i64> {
        self.best().map(ClockAnswer::uncertainty_nanos)
    }

    /// The answer with the shortest round trip.
    fn best(&self) -> Option<&ClockAnswer> {
        self.answers.iter().min_by_key(|answer| answer.uncertainty_nanos())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// Their clock is ahead of ours by 100 s.
    fn answer(asked: i64, there: i64, back: i64) -> ClockAnswer {
        let remote_nanos = asked + there + 100_000 * MS;
        ClockAnswer { asked_nanos: asked, remote_nanos, answered_nanos: asked + there + back }
    }

    #[test]
    fn the_shortest_round_trip_counts() {
        let mut offset = ClockOffset::default();
        offset.take(answer(0, 40 * MS, 2 * MS));
        offset.take(answer(1000 * MS, MS, MS));
        offset.take(answer(2000 * MS, 3 * MS, 90 * MS));
        assert_eq!(offset.local_nanos(100_500 * MS), 500 * MS);
        assert_eq!(offset.uncertainty_nanos(), Some(MS));
    }

    #[test]
    fn before_the_first_answer_the_realtime_clocks_count() {
        let mut offset = ClockOffset::default();
        offset.set_realtime(1_000, 5_000);
        assert_eq!((offset.local_nanos(10_000), offset.uncertainty_nanos()), (6_000, None));
    }

    #[test]
    fn a_stopped_clock_is_detected_and_arbitrary_stamps_are_accepted() {
        let mut offset = ClockOffset::default();
        offset.take(answer(0, MS, MS));
        let mut late = answer(1000 * MS, MS, MS);
        late.remote_nanos -= 600_000 * MS;
        offset.take(late);
        assert_eq!(offset.local_nanos(late.remote_nanos), 1001 * MS);
        for (asked, remote, answered) in
            [(i64::MIN, i64::MAX, i64::MAX), (5, i64::MIN, 6), (9, 0, 3)]
        {
            offset.take(ClockAnswer {
                asked_nanos: asked,
                remote_nanos: remote,
                answered_nanos: answered,
            });
            offset.local_nanos(i64::MAX);
            offset.local_nanos(i64::MIN);
        }
    }
}
