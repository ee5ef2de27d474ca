//! A second machine: the topics of an instance are sent over Zenoh and published in shared memory at the
//! other end, where subscribers run unmodified.
//!
//! [`sender`] reads the topics of the local instance and publishes them on Zenoh; [`receiver`] receives them and
//! publishes them through [`mirror`] under the name of an instance. [`envelope`] is the format on the network.
//!
//! None of this runs on the pipeline's reading thread: queues are bounded, the newest item wins, and drops
//! are counted.

pub mod clock_offset;
pub mod envelope;
pub mod error;
pub mod kind;
pub mod link;
pub mod mirror;
pub mod outlet;
pub mod packing;
pub mod poll;
pub mod rate;
pub mod receiver;
pub mod remote;
pub mod sender;
pub mod shared;
pub mod stamps;
pub mod traffic;
pub mod unpack;
