//! Waking before a frame: a sleeping CPU takes a tenth of a millisecond to wake. Shortly before the next frame is
//! expected the loop wakes and polls until it arrives.

use std::time::Duration;

/// Share of the last frames that must have arrived when expected. Below it, waking twice for each of the others costs
/// more than the rest gains.
const MIN_PUNCTUAL_SHARE: f64 = 0.85;
/// Frames over which the share is averaged, exponentially.
const AVERAGED_FRAMES: f64 = 16.0;

/// When to wake, and until when to poll.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Watch {
    /// CLOCK_MONOTONIC at which to wake, nanoseconds.
    pub begin_nanos: i64,
    /// CLOCK_MONOTONIC at which to go back to sleep, nanoseconds.
    pub end_nanos: i64,
}

impl Watch {
    /// Plans the watch for a frame expected `period_nanos` after an arrival: from `early_us` microseconds before until
    /// as long after; `None` where that is 0.
    fn plan(early_us: f64, arrival_nanos: i64, period_nanos: i64) -> Option<Self> {
        let early_nanos = ((early_us * 1e3) as i64).min(period_nanos / 4);
        let expected_nanos = arrival_nanos.checked_add(period_nanos)?;
        let begin_nanos = expected_nanos.checked_sub(early_nanos)?;
        let end_nanos = expected_nanos.checked_add(early_nanos)?;
        (early_nanos > 0).then_some(Self { begin_nanos, end_nanos })
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

/// Plans a watch for each frame, as long as the frames are punctual.
#[derive(Debug, Clone)]
pub struct EarlyWake {
    early_us: f64,
    next: Option<Watch>,
    punctual_share: f64,
}

impl EarlyWake {
    /// Wakes `early_us` microseconds before a frame; 0 never does.
    pub fn new(early_us: f64) -> Self {
        Self { early_us, next: None, punctual_share: 1.0 }
    }

    /// A frame has arrived, and the next is expected `period_nanos` later.
    pub fn arrive(&mut self, arrival_nanos: i64, period_nanos: i64) {
        if let Some(watch) = self.next {
            let punctual = f64::from(u8::from(watch.is_on(arrival_nanos)));
            self.punctual_share += (punctual - self.punctual_share) / AVERAGED_FRAMES;
        }
        self.next = Watch::plan(self.early_us, arrival_nanos, period_nanos);
    }

    /// The watch for the next frame; `None` if none is expected, its time has passed, or too few of the last frames
    /// arrived when expected.
    pub fn watch(&self, now_nanos: i64) -> Option<Watch> {
        let is_due = |watch: &Watch| now_nanos < watch.end_nanos;
        self.next.filter(is_due).filter(|_| self.punctual_share >= MIN_PUNCTUAL_SHARE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NANOS: i64 = 33_000_000;

    /// After one arrival at 1000 ns.
    fn after_one(early_us: f64, period_nanos: i64) -> EarlyWake {
        let mut early_wake = EarlyWake::new(early_us);
        early_wake.arrive(1_000, period_nanos);
        early_wake
    }

    #[test]
    fn the_loop_wakes_before_the_frame_and_sleeps_again_when_none_arrives() {
        let early_wake = after_one(300.0, PERIOD_NANOS);
        let watch = early_wake.watch(2_000).unwrap();
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
        assert_eq!(early_wake.watch(expected + 299_999), Some(watch));
        assert_eq!(early_wake.watch(expected + 300_000), None);
    }

    #[test]
    fn no_watch_is_planned_where_no_frame_is_expected() {
        assert_eq!(after_one(0.0, PERIOD_NANOS).watch(0), None);
        assert_eq!(EarlyWake::new(300.0).watch(0), None);
        assert_eq!(after_one(300.0, i64::MAX).watch(0), None);
        // At most a quarter of the period, either way: other work needs the CPU too.
        let watch = after_one(1e6, 4_000_000).watch(0).unwrap();
        assert_eq!((watch.begin_nanos, watch.end_nanos), (3_001_000, 5_001_000));
    }

    #[test]
    fn a_loop_whose_frames_come_early_and_late_sleeps_until_they_are_punctual_again() {
        let mut early_wake = EarlyWake::new(300.0);
        let mut now = 0;
        let mut watched = |late_nanos: &dyn Fn(i64) -> i64| {
            let is_watched = (0..60).map(|frame| {
                now += PERIOD_NANOS + late_nanos(frame);
                early_wake.arrive(now, PERIOD_NANOS);
                early_wake.watch(now).is_some()
            });
            is_watched.filter(|&is_watched| is_watched).count()
        };
        assert_eq!(watched(&|_| 0), 60);
        assert_eq!(
            watched(&|frame| if frame % 20 == 10 { 400_000 } else { 0 }),
            60,
            "few are late"
        );
        let uneven = watched(&|frame| [0, 0, 400_000, 0, -400_000][frame as usize % 5]);
        assert!(uneven < 10, "{uneven}");
        let punctual = watched(&|_| 0);
        assert!((35..60).contains(&punctual), "{punctual}");
    }
}
