//! Why sending or receiving ends early.

use semidense::wire::place_error::PlaceError;
use semidense::wire::port::{OpenError, SendError, WaitError};

use crate::session::SessionError;

/// Why sending or receiving ends early.
#[derive(Debug, thiserror::Error)]
pub enum ZenohError {
    /// Something that Zenoh refuses, or an invalid password file: what, why, what to do.
    #[error("{0}")]
    Link(String),
    /// Reading the local instance failed.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The place of the published instance is invalid.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A topic in shared memory could not be opened.
    #[error(transparent)]
    Shared(#[from] OpenError),
    /// Publishing in shared memory failed.
    #[error(transparent)]
    Publish(#[from] SendError),
    /// Waiting failed.
    #[error(transparent)]
    Wait(#[from] WaitError),
    /// A thread or a descriptor cannot be created.
    #[error("cannot start a thread or open a descriptor ({0}): check ulimit -u and ulimit -n")]
    Resource(#[from] std::io::Error),
}
