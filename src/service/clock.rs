//! The process's clock, and the pace of a recording that is played live.

use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};

/// Nanoseconds of CLOCK_MONOTONIC, the one clock of all our messages.
pub fn now_nanos() -> i64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}

/// Nanoseconds since 1970 (CLOCK_REALTIME) at the instant `clock_nanos` of CLOCK_MONOTONIC, by what both clocks show now. It
/// never blocks, and is as exact as the two are read together: a microsecond but where the thread is interrupted between
/// them, and then again.
pub fn realtime_of(clock_nanos: i64) -> i64 {
    /// Between the two readings of one clock around the other's, nanoseconds: several times what three take.
    const READ_TOGETHER: i64 = 2_000;
    /// How often that is tried.
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

/// `nanos` as a duration, nothing where it is negative.
pub fn duration_from_nanos(nanos: i64) -> Duration {
    Duration::from_nanos(u64::try_from(nanos).unwrap_or(0))
}

/// Looks again and again whether something is over, at most for `longest`; whether it is.
pub fn wait_at_most(longest: Duration, mut is_over: impl FnMut() -> bool) -> bool {
    /// Between two looks.
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

/// Says when a recorded frame is due: as long after the first as its stamp says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pace {
    first_stamp_nanos: i64,
    first_clock_nanos: i64,
}

impl Pace {
    /// The first frame, with this stamp, is due at `clock_nanos`.
    pub fn start(stamp_nanos: i64, clock_nanos: i64) -> Self {
        Self { first_stamp_nanos: stamp_nanos, first_clock_nanos: clock_nanos }
    }

    /// When the frame with this stamp is due.
    pub fn due_nanos(&self, stamp_nanos: i64) -> i64 {
        let since_first = stamp_nanos.saturating_sub(self.first_stamp_nanos);
        self.first_clock_nanos.saturating_add(since_first)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_due_as_their_stamps_say() {
        let pace = Pace::start(5_000, 1_000_000);
        assert_eq!(pace.due_nanos(5_000), 1_000_000);
        assert_eq!(pace.due_nanos(38_000), 1_033_000);
        assert_eq!(pace.due_nanos(i64::MAX), i64::MAX, "a hostile stamp does not overflow");
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
