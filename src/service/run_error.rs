//! Why a supervised run comes to nothing.

use std::io;

use crate::capture::source_error::SourceError;
use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::wire::place_error::PlaceError;
use crate::wire::port::{OpenError, ReceiveError, WaitError};

/// Why a run does not start, or its record cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The place is not right, or taken.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A topic cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The map is another camera's, or cannot be read.
    #[error(transparent)]
    Map(#[from] MapFolderError),
    /// The source cannot be opened.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// Poses cannot be received.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// Waiting failed.
    #[error(transparent)]
    Wait(#[from] WaitError),
    /// A process cannot be started or watched.
    #[error("{process}: cannot be started or watched ({source})")]
    Child {
        /// Which.
        process: &'static str,
        /// Why.
        source: io::Error,
    },
}
