//! What the clock of another machine says in terms of ours.
//!
//! CLOCK_MONOTONIC counts from each machine's own start. The receiver asks the sender for its clock once a second; an answer
//! bounds the difference by half of the time that the question took (Cristian, 1989), whether or not the clocks of the two
//! machines are set. Until the first answer the difference follows from CLOCK_REALTIME, which is right as far as that is
//! synchronised on both.

use std::collections::VecDeque;

/// Answers that are compared: half a minute of them.
const KEPT: usize = 30;
/// How far two quartz clocks may run apart, seconds a second.
const MAX_DRIFT: f64 = 200e-6;

/// A question for the other clock, and its answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockAnswer {
    /// Our clock at the question.
    pub asked_nanos: i64,
    /// The other clock at the answer.
    pub remote_nanos: i64,
    /// Our clock when the answer came.
    pub answered_nanos: i64,
}

impl ClockAnswer {
    /// Ours − theirs, in the middle of the question's time.
    fn offset_nanos(&self) -> i64 {
        let middle = self.asked_nanos.saturating_add(self.uncertainty_nanos());
        middle.saturating_sub(self.remote_nanos)
    }

    /// How far that may be off.
    fn uncertainty_nanos(&self) -> i64 {
        self.answered_nanos.saturating_sub(self.asked_nanos) / 2
    }
}

/// The difference of two clocks.
#[derive(Debug, Clone, Default)]
pub struct ClockOffset {
    answers: VecDeque<ClockAnswer>,
    /// By CLOCK_REALTIME of both.
    by_realtime_nanos: i64,
}

impl ClockOffset {
    /// Takes in CLOCK_REALTIME − CLOCK_MONOTONIC of both machines.
    pub fn tell_realtime(&mut self, remote_nanos: i64, local_nanos: i64) {
        self.by_realtime_nanos = remote_nanos.saturating_sub(local_nanos);
    }

    /// Takes in an answer. One that contradicts those before tells that the other machine was suspended: its clock stood
    /// still, and they count no more.
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

    /// `remote_nanos` of the other clock in terms of ours.
    pub fn local_nanos(&self, remote_nanos: i64) -> i64 {
        let offset = self.best().map_or(self.by_realtime_nanos, |best| best.offset_nanos());
        remote_nanos.saturating_add(offset)
    }

    /// How far that may be off; `None` while it rests on CLOCK_REALTIME.
    pub fn uncertainty_nanos(&self) -> Option<i64> {
        self.best().map(ClockAnswer::uncertainty_nanos)
    }

    /// The answer that took the shortest time.
    fn best(&self) -> Option<&ClockAnswer> {
        self.answers.iter().min_by_key(|answer| answer.uncertainty_nanos())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// Theirs is ahead of ours by 100 s.
    fn answer(asked: i64, there: i64, back: i64) -> ClockAnswer {
        let remote_nanos = asked + there + 100_000 * MS;
        ClockAnswer { asked_nanos: asked, remote_nanos, answered_nanos: asked + there + back }
    }

    #[test]
    fn the_shortest_question_counts() {
        let mut offset = ClockOffset::default();
        offset.take(answer(0, 40 * MS, 2 * MS));
        offset.take(answer(1000 * MS, MS, MS));
        offset.take(answer(2000 * MS, 3 * MS, 90 * MS));
        assert_eq!(offset.local_nanos(100_500 * MS), 500 * MS);
        assert_eq!(offset.uncertainty_nanos(), Some(MS));
    }

    #[test]
    fn before_an_answer_the_realtime_of_both_counts() {
        let mut offset = ClockOffset::default();
        offset.tell_realtime(1_000, 5_000);
        assert_eq!((offset.local_nanos(10_000), offset.uncertainty_nanos()), (6_000, None));
    }

    #[test]
    fn a_clock_that_stood_still_is_noticed_and_hostile_stamps_do_no_harm() {
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
