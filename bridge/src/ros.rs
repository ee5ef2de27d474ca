//! What semidense publishes, as ROS 2 messages: the same bytes for DDS, recordings and Foxglove.
//!
//! [`converter`] makes them from the events of a [`session`](crate::session); [`axes`] is the only place
//! where our axes are converted to those of ROS.

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
