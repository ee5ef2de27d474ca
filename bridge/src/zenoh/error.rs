//! Why sending or receiving ends early.

use semidense::wire::place_error::PlaceError;
use semidense::wire::port::{OpenError, SendError, WaitError};

use crate::session::SessionError;

/// Why sending or receiving ends early.
#[derive(Debug, thiserror::Error)]
pub enum ZenohError {
    /// The configuration that was made for Zenoh is refused.
    #[error("Zenoh does not take {key} = {value}: {reason}")]
    Config {
        /// Key of Zenoh's configuration.
        key: &'static str,
        /// Its value.
        value: String,
        /// What Zenoh says.
        reason: String,
    },
    /// The session cannot be opened.
    #[error(
        "cannot open {endpoints}: {reason}; is the port taken (ss -ltnp), is the address one of this machine?"
    )]
    Open {
        /// Where it should listen or connect to.
        endpoints: String,
        /// What Zenoh says.
        reason: String,
    },
    /// A topic cannot be declared.
    #[error("Zenoh does not declare {key}: {reason}")]
    Declare {
        /// The key.
        key: String,
        /// What Zenoh says.
        reason: String,
    },
    /// The file with the password.
    #[error(
        "{path}: {reason}; the file has one line `user:password` and is read by its owner alone (chmod 600)"
    )]
    Password {
        /// The file.
        path: String,
        /// What is wrong.
        reason: String,
    },
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
