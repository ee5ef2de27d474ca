//! Why a run, or one of its processes, fails.

use std::io;

use crate::capture::source_error::SourceError;
use crate::capture::source_name::SourceName;
use crate::service::map_folder::session::MapSessionError;
use crate::slam::parameter::ParameterError;
use crate::wire::command::CommandError;
use crate::wire::keyframe_inbox::InboxError;
use crate::wire::place_error::PlaceError;
use crate::wire::port::{OpenError, ReceiveError, SendError, WaitError};

/// Why a run does not start, its record cannot be made, or one of its processes ends early.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The place is invalid or taken.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A topic cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The source cannot be opened, or gave no frame.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// A message cannot be sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// Messages of the other processes cannot be received.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// Keyframes cannot be received.
    #[error(transparent)]
    Inbox(#[from] InboxError),
    /// A command cannot be answered.
    #[error(transparent)]
    Command(#[from] CommandError),
    /// Waiting failed.
    #[error(transparent)]
    Wait(#[from] WaitError),
    /// The map on disk cannot be used.
    #[error(transparent)]
    Map(#[from] MapSessionError),
    /// The configuration of tracking or mapping does not fit the frames.
    #[error("{0}: {1}")]
    Parameter(&'static str, ParameterError),
    /// Size and intrinsics are not those of a camera.
    #[error("{0}: invalid image size or intrinsics; check its camera file or rig")]
    Intrinsics(SourceName),
    /// The thread for this task cannot be started.
    #[error("cannot start the thread that {0} ({1})")]
    Thread(&'static str, io::Error),
    /// The mapper's threads cannot be started.
    #[error("cannot start {threads} mapper threads ({reason}); lower mapper.threads")]
    Pool {
        /// Number of threads requested.
        threads: usize,
        /// The system's error.
        reason: String,
    },
    /// A required process is not ready.
    #[error(
        "{process} was not ready within {seconds} s; start it, or raise capture.connect_timeout_s"
    )]
    NotReady {
        /// Which process.
        process: &'static str,
        /// The longest wait.
        seconds: f64,
    },
    /// The mapper does not take in a frame.
    #[error(
        "the mapper did not finish frame {sequence} within {seconds} s; raise capture.step_timeout_s if it is just slow"
    )]
    NoStep {
        /// Which frame.
        sequence: u64,
        /// The longest wait.
        seconds: f64,
    },
    /// A signal arrived before the end.
    #[error("interrupted")]
    Interrupted,
    /// A process cannot be started or watched.
    #[error("{process}: cannot be started or watched ({source})")]
    Child {
        /// Which process.
        process: &'static str,
        /// The cause.
        source: io::Error,
    },
}
