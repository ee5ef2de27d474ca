//! ROS 2 without ROS: a node of its own over DDS that publishes what semidense knows, and takes images in.
//!
//! [`network`] says how far it reaches, [`node`] is the node, [`publishing`] makes messages of what a session reads and
//! [`outbox`] keeps a slow network from holding that up. [`camera`] is the other direction.

pub mod camera;
pub mod camera_rig;
pub mod image_source;
pub mod network;
pub mod node;
pub mod outbox;
pub mod publishing;
