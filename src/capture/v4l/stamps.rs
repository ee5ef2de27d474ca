//! Stamps and numbers of frames.

use super::kernel::{
    FLAG_STAMP_SOURCE_MASK, FLAG_STAMP_START, FLAG_TIMESTAMP_MASK, FLAG_TIMESTAMP_MONOTONIC,
};
use super::video_device::Filled;

/// A stamp farther than this from the frame's arrival is from another clock or another frame: no camera takes a second
/// from the exposure to the buffer. Drivers are off by a frame period in either direction (vivid's stamps lie in the
/// future), which is accepted.
const PLAUSIBLE_NANOS: u64 = 1_000_000_000;

/// The middle of a frame's exposure, nanoseconds of CLOCK_MONOTONIC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Taken {
    /// The instant.
    pub nanos: i64,
    /// Whether it is from the driver; otherwise it is the frame's arrival, which is later and jitters.
    pub is_stamped: bool,
}

/// Returns when a frame was taken: the driver's stamp moved from the start of the exposure, or from its end, to the
/// middle. `exposure_nanos` is 0 where unknown; `offset_nanos` comes from a calibration.
pub fn taken(filled: &Filled, arrival_nanos: i64, exposure_nanos: u64, offset_nanos: i64) -> Taken {
    let is_monotonic = filled.flags & FLAG_TIMESTAMP_MASK == FLAG_TIMESTAMP_MONOTONIC;
    let is_stamped = is_monotonic && filled.stamp_nanos.abs_diff(arrival_nanos) <= PLAUSIBLE_NANOS;
    let is_start = is_stamped && filled.flags & FLAG_STAMP_SOURCE_MASK == FLAG_STAMP_START;
    let half = i64::try_from(exposure_nanos / 2).unwrap_or(0);
    let to_middle = if is_start { half } else { -half };
    let stamp = if is_stamped { filled.stamp_nanos } else { arrival_nanos };
    Taken { nanos: stamp.saturating_add(to_middle).saturating_add(offset_nanos), is_stamped }
}

/// Numbers that never go back, from a driver's numbers, which restart with every stream.
#[derive(Debug, Clone, Copy, Default)]
pub struct FrameNumbers {
    next: u64,
    last: Option<u32>,
}

/// Frames whose stamps go back are refused; after this many in a row, a third of a second, the clock is taken to have
/// stepped.
pub const MAX_REFUSED_IN_A_ROW: u32 = 10;

/// A larger step of the driver's number is a restart, not a loss: ten minutes at 60 Hz.
const MAX_STEP: u32 = 36_000;

impl FrameNumbers {
    /// Returns the number of a frame, and how many frames are missing before it.
    pub fn number(&mut self, sequence: u32) -> (u64, u64) {
        let step = match self.last {
            None => 1,
            // The driver's number wraps.
            Some(last) => match sequence.wrapping_sub(last) {
                step @ 1..=MAX_STEP => step,
                _ => 1,
            },
        };
        self.last = Some(sequence);
        let missing = u64::from(step - 1);
        let number = self.next.saturating_add(missing);
        self.next = number.saturating_add(1);
        (number, missing)
    }

    /// Begins a new stream: how many frames were missed is unknown, so one number is skipped.
    pub fn restart(&mut self) {
        if self.last.take().is_some() {
            self.next = self.next.saturating_add(1);
        }
    }
}

/// Refuses stamps that are not later than the last one accepted, until [`MAX_REFUSED_IN_A_ROW`] were refused.
#[derive(Debug, Clone, Copy, Default)]
pub struct StampOrder {
    last_nanos: Option<i64>,
    refused_in_a_row: u32,
}

impl StampOrder {
    /// Whether the frame with this stamp is accepted.
    pub fn accepts(&mut self, nanos: i64) -> bool {
        let is_old = self.last_nanos.is_some_and(|last| nanos <= last);
        if is_old && self.refused_in_a_row < MAX_REFUSED_IN_A_ROW {
            self.refused_in_a_row += 1;
            return false;
        }
        (self.last_nanos, self.refused_in_a_row) = (Some(nanos), 0);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ARRIVAL: i64 = 50_000_000_000;
    const MONOTONIC: u32 = FLAG_TIMESTAMP_MONOTONIC;

    fn filled(stamp_nanos: i64, flags: u32) -> Filled {
        Filled { stamp_nanos, flags, ..Filled::default() }
    }

    #[test]
    fn stamps_move_to_the_middle_of_the_exposure() {
        let stamp = ARRIVAL - 20_000_000;
        let exposure = 8_000_000;
        let end = taken(&filled(stamp, MONOTONIC), ARRIVAL, exposure, 0);
        assert_eq!(end, Taken { nanos: stamp - 4_000_000, is_stamped: true });
        let start = taken(&filled(stamp, MONOTONIC | FLAG_STAMP_START), ARRIVAL, exposure, 0);
        assert_eq!(start, Taken { nanos: stamp + 4_000_000, is_stamped: true });
        let unknown = taken(&filled(stamp, MONOTONIC), ARRIVAL, 0, -1_500_000);
        assert_eq!(unknown.nanos, stamp - 1_500_000);
    }

    #[test]
    fn stamps_of_other_clocks_are_replaced_by_the_arrival() {
        let exposure = 8_000_000;
        for (stamp, flags) in [
            (ARRIVAL - 1, 0),
            (ARRIVAL - 1, 0x4000),
            (1_700_000_000_000_000_000, MONOTONIC),
            (0, MONOTONIC | FLAG_STAMP_START),
            (i64::MIN, MONOTONIC),
            (ARRIVAL + 1_000_000_001, MONOTONIC),
        ] {
            let found = taken(&filled(stamp, flags), ARRIVAL, exposure, 0);
            assert_eq!(found, Taken { nanos: ARRIVAL - 4_000_000, is_stamped: false }, "{stamp}");
        }
        // A frame period in the future, as vivid stamps it.
        assert!(taken(&filled(ARRIVAL + 34_000_000, MONOTONIC), ARRIVAL, 0, 0).is_stamped);
        let hostile = taken(&filled(i64::MAX, MONOTONIC), i64::MAX, u64::MAX, i64::MAX);
        assert_eq!(hostile.nanos, i64::MAX);
    }

    #[test]
    fn numbers_never_go_back_and_gaps_are_counted() {
        let mut numbers = FrameNumbers::default();
        let mut take = |sequences: &[u32]| {
            sequences.iter().map(|&sequence| numbers.number(sequence)).collect::<Vec<_>>()
        };
        assert_eq!(take(&[5, 6, 9]), [(0, 0), (1, 0), (4, 2)], "the first is number 0");
        assert_eq!(take(&[9]), [(5, 0)], "a repeated number is a new frame");
        assert_eq!(take(&[3]), [(6, 0)], "a number that goes back is a new beginning");
        assert_eq!(take(&[4_000_000_000]), [(7, 0)], "so is one far ahead");
        assert_eq!(take(&[u32::MAX - 294_967_294]), [(8, 0)]);
        let mut wrapped = FrameNumbers::default();
        wrapped.number(u32::MAX);
        assert_eq!(wrapped.number(1), (2, 1), "the driver's number wraps");
        wrapped.restart();
        wrapped.restart();
        assert_eq!(wrapped.number(0), (4, 0), "a new stream leaves one number out");
    }
}
