//! Recordings: everything that a session reads, as ROS 2's messages in an MCAP file.
//!
//! [`recorder`] takes events and never waits; a thread of its own encodes and writes them. What comes faster than the
//! disk takes it is dropped and counted.

pub mod file;
pub mod qos;
pub mod queue;
pub mod recorder;
