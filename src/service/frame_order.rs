//! The order of frames as they arrive: which are missing, repeated or out of order, and their period.

use crate::service::clock::now_nanos;
use crate::wire::message::FrameHeader;

/// Period before any is measured: 30 Hz.
const FIRST_PERIOD_NANOS: i64 = 33_000_000;
/// Periods of real cameras: from 1000 Hz to one frame in five seconds. Anything outside is a jump of the source's
/// clock.
const PERIODS_NANOS: std::ops::RangeInclusive<i64> = 1_000_000..=5_000_000_000;
/// This many seemingly repeated frames in a row mean a source that has restarted its numbering.
const RENUMBERED_FRAMES: u32 = 10;

/// How a frame relates to the previous one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameOrderOutcome {
    /// It follows the previous one; this many are missing in between.
    Next {
        /// Frames that did not arrive.
        missing: u64,
    },
    /// It follows the previous one, but the source's clock has jumped.
    ClockJump,
    /// The same frame again, or an older one: not to be used.
    Repeated,
    /// The source has restarted its numbering.
    Renumbered,
}

/// Follows the frames of one source.
#[derive(Debug, Clone, Default)]
pub struct FrameOrder {
    last: Option<(u64, i64)>,
    period_nanos: Option<i64>,
    repeated: u32,
    has_ended: bool,
}

impl FrameOrder {
    /// Time between two frames, from the stamps of the last two.
    pub fn period_nanos(&self) -> i64 {
        self.period_nanos.unwrap_or(FIRST_PERIOD_NANOS)
    }

    /// Whether frames have stopped: none for `periods` periods since the last one.
    pub fn is_silent(&self, last_arrival_nanos: Option<i64>, periods: f64) -> bool {
        let allowed_nanos = periods * self.period_nanos() as f64;
        last_arrival_nanos
            .is_some_and(|last| now_nanos().saturating_sub(last) as f64 > allowed_nanos)
    }

    /// Notes that the source has ended: a frame that seems repeated is then the first of the next source.
    pub fn end(&mut self) {
        self.has_ended = true;
    }

    /// Classifies the next frame. Accepts arbitrary input.
    pub fn arrive(&mut self, header: &FrameHeader) -> FrameOrderOutcome {
        let is_next_source = std::mem::take(&mut self.has_ended);
        let (sequence, stamp) = (header.sequence, header.capture_nanos);
        let Some((last_sequence, last_stamp)) = self.last else {
            self.last = Some((sequence, stamp));
            return FrameOrderOutcome::Next { missing: 0 };
        };
        if sequence <= last_sequence {
            self.repeated += 1;
            if self.repeated < RENUMBERED_FRAMES && !is_next_source {
                return FrameOrderOutcome::Repeated;
            }
            (self.last, self.repeated) = (Some((sequence, stamp)), 0);
            return FrameOrderOutcome::Renumbered;
        }
        (self.last, self.repeated) = (Some((sequence, stamp)), 0);
        let frames = sequence - last_sequence;
        let period = i64::try_from(frames)
            .ok()
            .and_then(|frames| stamp.checked_sub(last_stamp)?.checked_div(frames));
        match period.filter(|period| PERIODS_NANOS.contains(period)) {
            Some(period) => {
                // A camera that stalls may not count the frames it lost.
                let most = self.period_nanos.map_or(period, |known| known.saturating_mul(2));
                self.period_nanos = Some(period.min(most));
                FrameOrderOutcome::Next { missing: frames - 1 }
            }
            None => FrameOrderOutcome::ClockJump,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(sequence: u64, millis: i64) -> FrameHeader {
        FrameHeader { sequence, capture_nanos: millis * 1_000_000, ..FrameHeader::default() }
    }

    #[test]
    fn gaps_and_periods_are_found() {
        let mut order = FrameOrder::default();
        assert_eq!(order.arrive(&frame(7, 0)), FrameOrderOutcome::Next { missing: 0 });
        assert_eq!(order.arrive(&frame(8, 20)), FrameOrderOutcome::Next { missing: 0 });
        assert_eq!(order.period_nanos(), 20_000_000);
        assert_eq!(order.arrive(&frame(11, 80)), FrameOrderOutcome::Next { missing: 2 });
        assert_eq!(order.period_nanos(), 20_000_000);
    }

    #[test]
    fn a_stall_that_counts_no_frames_hardly_changes_the_period() {
        let mut order = FrameOrder::default();
        order.arrive(&frame(0, 0));
        order.arrive(&frame(1, 1000));
        assert_eq!(order.period_nanos(), 1_000_000_000, "the first is taken as it is");
        order.arrive(&frame(2, 1040));
        order.arrive(&frame(3, 3040));
        assert_eq!(order.period_nanos(), 80_000_000);
        for k in 4..9 {
            order.arrive(&frame(k, 3040 + 100 * (k as i64 - 3)));
        }
        assert_eq!(order.period_nanos(), 100_000_000);
    }

    #[test]
    fn repeated_frames_are_refused_until_the_source_is_renumbered() {
        let mut order = FrameOrder::default();
        order.arrive(&frame(100, 0));
        assert_eq!(order.arrive(&frame(100, 0)), FrameOrderOutcome::Repeated);
        assert_eq!(order.arrive(&frame(99, 50)), FrameOrderOutcome::Repeated);
        assert_eq!(order.arrive(&frame(101, 33)), FrameOrderOutcome::Next { missing: 0 });
        let mut arrivals = (0..10).map(|i| order.arrive(&frame(i, 1000 + 33 * i as i64)));
        assert!(arrivals.by_ref().take(9).all(|arrival| arrival == FrameOrderOutcome::Repeated));
        assert_eq!(arrivals.next(), Some(FrameOrderOutcome::Renumbered));
        assert_eq!(order.arrive(&frame(10, 1330)), FrameOrderOutcome::Next { missing: 0 });
    }

    #[test]
    fn the_next_source_loses_no_frame() {
        let mut order = FrameOrder::default();
        order.arrive(&frame(0, 0));
        order.arrive(&frame(1, 33));
        order.end();
        assert_eq!(order.arrive(&frame(0, 10)), FrameOrderOutcome::Renumbered);
        assert_eq!(order.arrive(&frame(0, 10)), FrameOrderOutcome::Repeated);
        order.end();
        assert_eq!(order.arrive(&frame(1, 43)), FrameOrderOutcome::Next { missing: 0 });
        assert_eq!(order.arrive(&frame(1, 43)), FrameOrderOutcome::Repeated);
    }

    #[test]
    fn clock_jumps_do_not_become_a_period() {
        let mut order = FrameOrder::default();
        order.arrive(&frame(0, 0));
        order.arrive(&frame(1, 40));
        assert_eq!(order.arrive(&frame(2, 3_600_000)), FrameOrderOutcome::ClockJump);
        assert_eq!(order.arrive(&frame(3, -5)), FrameOrderOutcome::ClockJump);
        assert_eq!(order.period_nanos(), 40_000_000);
        let hostile = FrameHeader { sequence: u64::MAX, capture_nanos: i64::MAX, ..frame(0, 0) };
        assert_eq!(order.arrive(&hostile), FrameOrderOutcome::ClockJump);
        let back = FrameHeader { sequence: u64::MAX, capture_nanos: i64::MIN, ..frame(0, 0) };
        assert_eq!(order.arrive(&back), FrameOrderOutcome::Repeated);
    }
}
