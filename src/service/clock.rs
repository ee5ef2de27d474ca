//! The process's clock, and the pace of a recording that is played live.

use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};

/// CLOCK_MONOTONIC in nanoseconds, the one clock of all messages.
pub fn now_nanos() -> i64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}

/// Nanoseconds since 1970 (CLOCK_REALTIME) at the instant `clock_nanos` of CLOCK_MONOTONIC, from the current offset of
/// the clocks. Never blocks. As exact as the two clocks are read together: to a microsecond, unless the thread is
/// interrupted between them at every attempt.
pub fn realtime_of(clock_nanos: i64) -> i64 {
    /// Accepted time between the two readings around the other clock's, nanoseconds: several times what three take.
    const READ_TOGETHER: i64 = 2_000;
    /// Attempts to stay within it.
    const ATTEMPTS: usize = 4;
    let read = || {
        let before = now_nanos();
        let realtime = clock_gettime(ClockId::Realtime);
        let width = now_nanos().saturating_sub(before);
        let realtime = realtime.tv_sec * 1_000_000_000 + realtime.tv_nsec;
        (width, realtime.saturating_sub(before.saturating_add(width / 2)))
    };
    let mut best = read();
    for _ in 1..ATTEMPTS {
        if best.0 <= READ_TOGETHER {
            break;
        }
        best = best.min(read());
    }
    clock_nanos.saturating_add(best.1)
}

/// `nanos` as a duration, zero where negative.
pub fn duration_from_nanos(nanos: i64) -> Duration {
    Duration::from_nanos(u64::try_from(nanos).unwrap_or(0))
}

/// Nanoseconds since `begin`.
pub fn elapsed_nanos(begin: Instant) -> u64 {
    u64::try_from(begin.elapsed().as_nanos()).unwrap_or(u64::MAX)
}

/// Polls `is_over` until it holds or `longest` has passed; returns whether it holds.
pub fn wait_at_most(longest: Duration, mut is_over: impl FnMut() -> bool) -> bool {
    /// Pause between two polls.
    const PAUSE: Duration = Duration::from_millis(2);
    let start = Instant::now();
    while !is_over() {
        if start.elapsed() >= longest {
            return false;
        }
        std::thread::sleep(PAUSE);
    }
    true
}

/// Longest time between two stamps that is waited for: a longer one is a jump of the clock that stamped them, or a
/// recording that was paused.
const LONGEST_STEP_NANOS: i64 = 5_000_000_000;

/// When recorded frames are due: as long after the first as their stamps are, except that jumps are skipped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pace {
    first_stamp_nanos: i64,
    first_clock_nanos: i64,
    last_stamp_nanos: i64,
}

impl Pace {
    /// The first frame, with this stamp, is due at `clock_nanos`.
    pub fn start(stamp_nanos: i64, clock_nanos: i64) -> Self {
        Self {
            first_stamp_nanos: stamp_nanos,
            first_clock_nanos: clock_nanos,
            last_stamp_nanos: stamp_nanos,
        }
    }

    /// When the next frame is due, which has this stamp; at once, at `clock_nanos`, after a jump forward or back.
    pub fn due_nanos(&mut self, stamp_nanos: i64, clock_nanos: i64) -> i64 {
        let step = stamp_nanos.saturating_sub(self.last_stamp_nanos);
        if !(0..=LONGEST_STEP_NANOS).contains(&step) {
            *self = Self::start(stamp_nanos, clock_nanos);
        }
        self.last_stamp_nanos = stamp_nanos;
        let since_first = stamp_nanos.saturating_sub(self.first_stamp_nanos);
        self.first_clock_nanos.saturating_add(since_first)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_due_according_to_their_stamps() {
        let mut pace = Pace::start(5_000, 1_000_000);
        assert_eq!(pace.due_nanos(5_000, 1_000_010), 1_000_000);
        assert_eq!(pace.due_nanos(38_000, 1_000_020), 1_033_000);
        let late = 38_000 + LONGEST_STEP_NANOS;
        assert_eq!(pace.due_nanos(late, 1_034_000), 1_033_000 + LONGEST_STEP_NANOS);
    }

    #[test]
    fn jumps_of_the_stamps_are_not_waited_for() {
        let mut pace = Pace::start(5_000, 1_000_000);
        for stamp in [5_001 + LONGEST_STEP_NANOS, -40, i64::MAX, i64::MIN, i64::MAX] {
            assert_eq!(pace.due_nanos(stamp, 2_000_000), 2_000_000, "{stamp}");
        }
        let mut pace = Pace::start(i64::MAX - 10, 0);
        pace.due_nanos(7, 3_000_000);
        assert_eq!(pace.due_nanos(40, 3_000_001), 3_000_033, "it goes on from there");
    }

    #[test]
    fn an_instant_has_one_realtime() {
        let since_1970 = || {
            let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
            now.unwrap().as_nanos() as i64
        };
        let (before, instant, after) = (since_1970(), now_nanos(), since_1970());
        // The two clocks are read together to some microseconds.
        let slack = 1_000_000;
        let found = realtime_of(instant);
        assert!((before - slack..=after + slack).contains(&found), "{before} {found} {after}");
        let shift = realtime_of(instant - 1_000_000_000) - found;
        assert!((shift + 1_000_000_000).abs() < slack, "{shift}");
        assert_eq!(realtime_of(i64::MAX), i64::MAX, "a hostile stamp does not overflow");
    }

    #[test]
    fn the_clock_does_not_go_back() {
        let first = now_nanos();
        assert!(now_nanos() >= first);
        assert_eq!(duration_from_nanos(-1), Duration::ZERO);
    }
}
