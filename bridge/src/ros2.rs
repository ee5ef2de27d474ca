//! ROS 2 without ROS: a DDS node that publishes the outputs of semidense and accepts images.
//!
//! [`network`] sets the reach of the node, [`node`] implements it, [`publishing`] makes messages from a session's
//! events and [`outbox`] keeps a slow network from delaying that. [`camera`] is the other direction.

pub mod camera;
pub mod camera_rig;
pub mod image_source;
pub mod network;
pub mod node;
pub mod outbox;
pub mod publishing;
