//! Outputs of semidense beyond its shared memory: each is one more process that reads the topics like anybody else, and
//! may be slow, die or be absent without the pipeline noticing.
//!
//! [`session`] reads the topics of a running instance; every output is a folder beside it.

pub mod command;
pub mod feed;
pub mod foxglove;
pub mod jpeg;
pub mod keyframe_pace;
pub mod last_time;
pub mod record;
pub mod ros;
#[cfg(feature = "ros2")]
pub mod ros2;
pub mod session;
pub mod slots;
pub mod web;
#[cfg(feature = "zenoh")]
pub mod zenoh;
