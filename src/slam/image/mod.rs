//! Images, pyramids and gradients.

pub mod buffer;
pub mod pyramid;
