//! How far a run is, for whoever shows it.

use crate::slam::pose::TrackingState;

/// How far a run is, for whoever watches.
#[derive(Debug, Clone, PartialEq)]
pub enum RunProgress {
    /// There is no camera, for this reason; it is used as soon as it is there.
    Waiting(String),
    /// The processes start, and the source is prepared: (done, total) of that work.
    Preparing(u64, u64),
    /// Frames come.
    Running {
        /// Poses so far.
        frames: u64,
        /// Frames there will be, 0 where unknown.
        total: u64,
        /// State of the last frame.
        state: Option<TrackingState>,
        /// Keyframes in the map.
        keyframes: u64,
    },
}
