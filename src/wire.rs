//! Shared memory: the only place that names iceoryx2.
//!
//! [`message`] are the bytes, [`conversion`] checks them, [`topic`] is the table of who sends what,
//! [`place`] says where an instance lives, [`port`] sends, receives and waits, [`command`] asks.

pub mod command;
pub mod conversion;
pub mod folders;
pub mod keyframe_inbox;
pub(crate) mod limits;
pub mod lock_file;
pub mod message;
pub mod open_error;
pub mod place;
pub mod place_error;
pub mod port;
mod root_folder;
pub(crate) mod shared_memory;
mod tidy;
pub mod topic;
mod version;
