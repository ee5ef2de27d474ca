//! Outputs of semidense beyond its shared memory: each is a separate process that reads the topics like any
//! other subscriber and may be slow, die or be absent without affecting the pipeline.
//!
//! [`session`] reads the topics of a running instance; every output is a module next to it.

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
