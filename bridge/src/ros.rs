//! What semidense publishes, as ROS 2 messages: the same bytes for DDS, for recordings and for Foxglove.
//!
//! [`converter`] makes them of what a [`session`](crate::session) reads; [`axes`] is the one place where our axes
//! become ROS's.

pub mod axes;
pub mod cdr;
pub mod converter;
pub mod diagnostics;
pub mod encoder;
pub mod frame_ids;
pub mod images;
pub mod keyframe_cloud;
pub mod message;
pub mod own_message;
pub mod schema;
pub mod topic;
