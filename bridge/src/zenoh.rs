//! A second machine: what an instance publishes goes over Zenoh, and back into shared memory at the other end, where every
//! subscriber is the same program as on the robot.
//!
//! [`sender`] reads the topics of the local instance and puts them on Zenoh; [`receiver`] takes them there and publishes
//! them through [`mirror`] under the name of an instance. [`envelope`] is what goes over the network.
//!
//! Nothing of this is on the reading thread of the pipeline: queues are bounded, the newest wins, and what is dropped is
//! counted.

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
