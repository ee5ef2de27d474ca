//! Rigid and similarity transforms, camera intrinsics, lenses and rectification.

pub mod intrinsics;
pub mod se3;
pub mod sim3;
