//! The mapper's phases from frame to frame, with the state that each needs.

use crate::slam::mapper::consistency::{Consistency, Contradiction};

/// Longest time that is counted between two frames: the period of the slowest camera.
const LONGEST_STEP_NANOS: i64 = 5_000_000_000;

/// What the mapper does with the next frame.
#[derive(Debug, Clone, Copy, Default)]
pub(super) enum Phase {
    /// There is no map: the frame is used to start one.
    #[default]
    Starting,
    /// Depth is observed in it.
    Mapping,
    /// The camera is lost: keyframes of all epochs are searched for it.
    Lost(Loss),
    /// The map contradicted itself: other keyframes are searched for the camera.
    Rejected(Contradiction, Loss),
    /// The camera has been lost for long: the search continues, and the frame is also used to start a new epoch.
    /// Whichever succeeds first wins.
    Restarting(Loss),
}

/// Time by the frames' stamps since the first of several frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct ElapsedTime {
    /// Stamp of the last frame.
    last_nanos: Option<i64>,
    nanos: i64,
}

/// How long the camera has been lost, and how far the search has got.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Loss {
    /// Since the first lost frame.
    pub(super) elapsed: ElapsedTime,
    /// Keyframes searched since then.
    pub(super) searched: usize,
    /// Keyframes that were compared with turned views.
    pub(super) compared: usize,
}

impl Phase {
    /// The current loss, or a new one.
    pub(super) fn loss(&self) -> Loss {
        match *self {
            Self::Lost(loss) | Self::Rejected(_, loss) | Self::Restarting(loss) => loss,
            Self::Starting | Self::Mapping => Loss::default(),
        }
    }

    /// The phase with this loss; one without a loss becomes `Lost`.
    pub(super) fn with_loss(self, loss: Loss) -> Self {
        match self {
            Self::Restarting(_) => Self::Restarting(loss),
            Self::Rejected(why, _) => Self::Rejected(why, loss),
            Self::Starting | Self::Mapping | Self::Lost(_) => Self::Lost(loss),
        }
    }
}

impl ElapsedTime {
    /// Adds a frame and returns the time so far, seconds. A step of the clock adds nothing if it is backwards, and no
    /// more than the longest time between frames if it is forwards.
    pub(super) fn secs(&mut self, nanos: i64) -> f64 {
        let step = nanos.saturating_sub(self.last_nanos.replace(nanos).unwrap_or(nanos));
        self.nanos = self.nanos.saturating_add(step.clamp(0, LONGEST_STEP_NANOS));
        self.nanos as f64 * 1e-9
    }
}

/// The keyframe that frames are tracked on and whose depth is observed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Active {
    /// Its index in the map.
    pub(super) index: usize,
    /// Number of frames observed on it.
    pub(super) frames: u64,
    /// State of its consistency checks.
    pub(super) consistency: Consistency,
}

impl Active {
    /// The keyframe at `index`, before its first frame.
    pub(super) fn new(index: usize) -> Self {
        Self { index, frames: 0, consistency: Consistency::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_of_the_clock_neither_delay_nor_end_a_search() {
        const SECOND: i64 = 1_000_000_000;
        let mut elapsed = ElapsedTime::default();
        let mut secs = |stamp: i64| elapsed.secs(stamp);
        assert_eq!(secs(100 * SECOND), 0.0);
        assert_eq!(secs(101 * SECOND), 1.0);
        // An hour back, and on from there.
        assert_eq!(secs(-3500 * SECOND), 1.0);
        assert_eq!(secs(-3499 * SECOND), 2.0);
        assert_eq!(secs(i64::MIN), 2.0);
        assert_eq!(secs(i64::MAX), 7.0, "a leap counts as the longest period");
    }
}
