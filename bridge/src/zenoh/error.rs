//! Why sending or receiving ends early.

use semidense::wire::place_error::PlaceError;
use semidense::wire::port::{OpenError, SendError, WaitError};

use crate::session::SessionError;

/// Why sending or receiving ends early.
#[derive(Debug, thiserror::Error)]
pub enum ZenohError {
    /// What Zenoh does not take, or a file with a password: what, why, what to do.
    #[error("{0}")]
    Link(String),
    /// Reading the local instance.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The place of the instance that is published.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A topic in shared memory.
    #[error(transparent)]
    Shared(#[from] OpenError),
    /// Publishing in shared memory.
    #[error(transparent)]
    Publish(#[from] SendError),
    /// Waiting failed.
    #[error(transparent)]
    Wait(#[from] WaitError),
    /// A thread or a descriptor cannot be made.
    #[error("cannot start a thread or open a descriptor ({0}): look at ulimit -u and ulimit -n")]
    Resource(#[from] std::io::Error),
}
