//! Recordings: every event of a session, as ROS 2 messages in an MCAP file.
//!
//! [`queue`] accepts events without waiting; [`recorder`] encodes and writes them on a separate thread.
//! Events that arrive faster than the disk can write are dropped and counted.

pub mod file;
pub mod qos;
pub mod queue;
pub mod recorder;
