//! Images, pyramids and gradients.

pub mod brightening;
pub mod buffer;
pub mod gray;
pub mod noise;
pub(crate) mod pyramid;
pub mod quads;
pub mod quads_kernel;
pub mod shared;
pub mod sums;
