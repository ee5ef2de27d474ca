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
pub(crate) mod repeats;
pub mod shared;
pub mod sums;

/// Grey level of pixels that show nothing of the scene.
pub const NO_DATA: u8 = 0;

/// Grey level of black pixels that show it.
pub const BLACK: u8 = 1;

/// Raises the pixels of an image in which 0 is black.
pub fn raise_black(pixels: &mut [u8]) {
    pixels.iter_mut().for_each(|grey| *grey = (*grey).max(BLACK));
}
