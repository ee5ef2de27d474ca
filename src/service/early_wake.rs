//! Waking before a frame: a sleeping CPU takes a tenth of a millisecond to wake. Shortly before the next frame is
//! expected the loop wakes and polls until it arrives.

use std::time::Duration;

/// When to wake, and until when to poll.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Watch {
    /// CLOCK_MONOTONIC at which to wake, nanoseconds.
    pub begin_nanos: i64,
    /// CLOCK_MONOTONIC at which to go back to sleep, nanoseconds.
    pub end_nanos: i64,
}

impl Watch {
    /// Plans the watch for a frame expected `period_nanos` after the last arrival: from `early_us` microseconds before
    /// until as long after; `None` where that is 0, no frame is expected, or its time has passed.
    pub fn plan(
        early_us: f64,
        last_arrival_nanos: Option<i64>,
        period_nanos: i64,
        now_nanos: i64,
    ) -> Option<Self> {
        let early_nanos = ((early_us * 1e3) as i64).min(period_nanos / 4);
        let expected_nanos = last_arrival_nanos?.checked_add(period_nanos)?;
        let begin_nanos = expected_nanos.checked_sub(early_nanos)?;
        let end_nanos = expected_nanos.checked_add(early_nanos)?;
        (early_nanos > 0 && now_nanos < end_nanos).then_some(Self { begin_nanos, end_nanos })
    }

    /// Time to sleep from `now_nanos` on.
    pub fn sleep(&self, now_nanos: i64) -> Duration {
        Duration::from_nanos(self.begin_nanos.saturating_sub(now_nanos).max(0) as u64)
    }

    /// Whether `now_nanos` lies within the watch.
    pub fn is_on(&self, now_nanos: i64) -> bool {
        (self.begin_nanos..self.end_nanos).contains(&now_nanos)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NANOS: i64 = 33_000_000;

    #[test]
    fn the_loop_wakes_before_the_frame_and_sleeps_again_when_none_arrives() {
        let watch = Watch::plan(300.0, Some(1_000), PERIOD_NANOS, 2_000).unwrap();
        assert_eq!(watch.sleep(1_000), Duration::from_nanos(PERIOD_NANOS as u64 - 300_000));
        let expected = 1_000 + PERIOD_NANOS;
        for (now, is_on) in [
            (expected - 300_001, false),
            (expected - 300_000, true),
            (expected + 299_999, true),
            (expected + 300_000, false),
        ] {
            assert_eq!(watch.is_on(now), is_on, "{now}");
        }
        assert_eq!(watch.sleep(expected), Duration::ZERO);
        let over = expected + 300_000;
        assert_eq!(Watch::plan(300.0, Some(1_000), PERIOD_NANOS, over), None);
    }

    #[test]
    fn no_watch_is_planned_where_no_frame_is_expected() {
        assert_eq!(Watch::plan(0.0, Some(0), PERIOD_NANOS, 0), None);
        assert_eq!(Watch::plan(300.0, None, PERIOD_NANOS, 0), None);
        assert_eq!(Watch::plan(300.0, Some(i64::MAX), PERIOD_NANOS, 0), None);
        // At most a quarter of the period, either way: other work needs the CPU too.
        let watch = Watch::plan(1e6, Some(0), 4_000_000, 0).unwrap();
        assert_eq!((watch.begin_nanos, watch.end_nanos), (3_000_000, 5_000_000));
    }
}
