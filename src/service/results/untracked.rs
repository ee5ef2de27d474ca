//! Why a run has tracked nothing, from what its start has seen.

use std::fmt;

use crate::service::results::{RunMode, RunRecord};
use crate::slam::evaluation::statistics::percentile;
use crate::slam::mapper::situation::StartFrame;

/// Fewest frames from which a map can begin and one be tracked on it: a start is confirmed by its third.
const FEWEST_FRAMES: u64 = 5;

/// What frames came to while there was no map, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StartTally {
    /// Frames without texture that were dark.
    pub dark: u64,
    /// Frames without texture that were overexposed.
    pub overexposed: u64,
    /// Other frames without texture.
    pub textureless: u64,
    /// Frames that did not show what the first of the start does.
    pub unmatched: u64,
    /// Frames in which the camera had not moved.
    pub still: u64,
    /// Frames that a rotation explains.
    pub turned: u64,
    /// Frames with too little parallax.
    pub little_parallax: u64,
}

impl StartTally {
    /// Counts a frame.
    pub fn count(&mut self, frame: Option<StartFrame>) {
        match frame {
            None | Some(StartFrame::Begun) => {}
            Some(StartFrame::Dark) => self.dark += 1,
            Some(StartFrame::Overexposed) => self.overexposed += 1,
            Some(StartFrame::Textureless) => self.textureless += 1,
            Some(StartFrame::Unmatched) => self.unmatched += 1,
            Some(StartFrame::Still) => self.still += 1,
            Some(StartFrame::Turned) => self.turned += 1,
            Some(StartFrame::LittleParallax) => self.little_parallax += 1,
        }
    }

    fn sum(&self) -> u64 {
        let without_texture = self.dark + self.overexposed + self.textureless;
        without_texture + self.unmatched + self.still + self.turned + self.little_parallax
    }
}

/// Why nothing was tracked, and what to do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Untracked {
    /// There was no frame.
    NoFrame,
    /// There were too few.
    FewFrames(u64),
    /// Too few of them could be handled.
    TooSlow {
        /// Frames that the source gave.
        frames_in: u64,
        /// Of them those that the mapper had no time for.
        skipped: u64,
        /// Median time of the mapper for a frame, milliseconds; 0 where it had none.
        map_ms: f64,
        /// Time between two frames, milliseconds.
        period_ms: f64,
    },
    /// Most frames came to this, so many of so many.
    Seen(StartFrame, u64, u64),
    /// A map began, but no frame could be tracked on it.
    LostAtOnce,
}

impl Untracked {
    /// Why `record` has no tracked frame; `None` where it has one.
    pub fn of(record: &RunRecord) -> Option<Self> {
        if record.poses.iter().any(|pose| pose.estimate.state.is_tracked()) {
            return None;
        }
        let frames_in = record.frames_in.max(record.poses.len() as u64);
        if frames_in == 0 {
            return Some(Self::NoFrame);
        }
        let tally = record.start;
        let most = [
            (tally.dark, StartFrame::Dark),
            (tally.overexposed, StartFrame::Overexposed),
            (tally.textureless, StartFrame::Textureless),
            (tally.unmatched, StartFrame::Unmatched),
            (tally.still, StartFrame::Still),
            (tally.turned, StartFrame::Turned),
            (tally.little_parallax, StartFrame::LittleParallax),
        ];
        let (count, seen) = most.into_iter().max_by_key(|(count, _)| *count)?;
        let handled = record.map_nanos.len() as u64;
        let skipped = frames_in.saturating_sub(handled);
        let is_slow = record.mode == RunMode::Live && 3 * skipped > frames_in;
        // Between frames that are far apart nothing can be proven; what they show of light and of a camera that
        // stands they show all the same.
        let is_far_apart =
            matches!(seen, StartFrame::Unmatched | StartFrame::Turned | StartFrame::LittleParallax);
        if is_slow && (is_far_apart || tally.sum() < FEWEST_FRAMES) {
            return Some(Self::too_slow(record, frames_in, skipped));
        }
        Some(match count {
            _ if frames_in < FEWEST_FRAMES => Self::FewFrames(frames_in),
            0 => Self::LostAtOnce,
            _ => Self::Seen(seen, count, tally.sum()),
        })
    }

    fn too_slow(record: &RunRecord, frames_in: u64, skipped: u64) -> Self {
        let mut times: Vec<f64> = record.map_nanos.iter().map(|&n| n as f64 * 1e-6).collect();
        times.sort_by(f64::total_cmp);
        let period_ms =
            record.recorded_nanos as f64 * 1e-6 / frames_in.saturating_sub(1).max(1) as f64;
        let map_ms = percentile(&times, 0.5).unwrap_or(0.0);
        Self::TooSlow { frames_in, skipped, map_ms, period_ms }
    }
}

impl fmt::Display for Untracked {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NoFrame => f.write_str("the source gave no frame"),
            Self::FewFrames(frames) => write!(
                f,
                "{frames} frames are too few: a map begins once the camera has moved sideways for some frames"
            ),
            Self::TooSlow { frames_in, skipped, map_ms, period_ms } => write!(
                f,
                "the machine is too slow: the mapper had no time for {skipped} of {frames_in} frames \
                 ({map_ms:.1} ms for one, one every {period_ms:.1} ms); lower the rate or the image size, give it more \
                 CPUs, or use --lockstep for a recording"
            ),
            Self::Seen(seen, count, all) => {
                write!(f, "{} ({count} of {all} frames of the start)", advice(seen))
            }
            Self::LostAtOnce => f.write_str(
                "a map began, but no frame could be tracked on it; move the camera more slowly at first",
            ),
        }
    }
}

fn advice(seen: StartFrame) -> &'static str {
    match seen {
        StartFrame::Begun => "the start began anew with every frame",
        StartFrame::Dark => {
            "the images are dark and show no texture; give more light or exposure, and check the lens cap"
        }
        StartFrame::Overexposed => {
            "the images are overexposed and show no texture; lower exposure or gain"
        }
        StartFrame::Textureless => {
            "the images show too little texture; point the camera at something with edges, and check its focus"
        }
        StartFrame::Unmatched => {
            "consecutive images differ too much; move more slowly, or raise the frame rate"
        }
        StartFrame::Still => "the camera stood still; move it sideways",
        StartFrame::Turned => {
            "the camera only turned; move it sideways, as depth comes from parallax"
        }
        StartFrame::LittleParallax => {
            "the camera moved too little, or towards what it sees; move it sideways by a few per cent of the distance"
        }
    }
}
