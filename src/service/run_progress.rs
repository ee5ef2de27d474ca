//! How far a run is, for whoever shows it.

use crate::service::results::record::EndOfRun;
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

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ended {
    /// With the end of the source.
    Finished,
    /// By a signal.
    Interrupted,
    /// Because a process failed; says which and why.
    Failed(String),
}

impl From<&Ended> for EndOfRun {
    fn from(ended: &Ended) -> Self {
        match ended {
            Ended::Finished => Self::Finished,
            Ended::Interrupted => Self::Interrupted,
            Ended::Failed(cause) => Self::Failed(cause.clone()),
        }
    }
}
