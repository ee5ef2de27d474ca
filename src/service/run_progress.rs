//! Progress of a run, for its display.

use crate::slam::pose::TrackingState;

/// Progress of a run, for an observer.
#[derive(Debug, Clone, PartialEq)]
pub enum RunProgress {
    /// The camera is absent, for this reason; it is used as soon as it appears.
    Waiting(String),
    /// The processes start, and the source is prepared: (done, total) of that work.
    Preparing(u64, u64),
    /// Frames arrive.
    Running {
        /// Poses so far.
        frames: u64,
        /// Frames in all, 0 where unknown.
        total: u64,
        /// State of the last frame.
        state: Option<TrackingState>,
        /// Keyframes in the map.
        keyframes: u64,
    },
}
