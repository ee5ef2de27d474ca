//! Shared memory between the processes; the only module that names iceoryx2.
//!
//! [`message`] defines the bytes, [`conversion`] checks them, [`topic`] lists every topic with its publisher, [`place`]
//! is where an instance lives, [`port`] sends, receives and waits, [`command`] carries requests to the mapper.

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
mod unfinished;
mod version;
