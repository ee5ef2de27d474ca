//! Images, pyramids and gradients.
//!
//! The grey level [`NO_DATA`] marks pixels that show nothing of the scene: the robot's own parts, hidden by a mask.
//! Nothing is compared with them, chosen on them or averaged with them.

pub mod brightening;
pub mod buffer;
pub mod gray;
pub mod noise;
pub(crate) mod pyramid;
pub mod quads;
pub mod quads_kernel;
pub mod shared;
pub mod sums;

/// Grey level of pixels that show nothing of the scene. Black ones that do are 1.
pub const NO_DATA: u8 = 0;
