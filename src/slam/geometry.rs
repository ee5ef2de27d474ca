//! Rigid and similarity transforms, camera intrinsics, lenses and rectification.

pub mod camera_model;
pub mod intrinsics;
pub mod rectification;
pub mod se3;
pub mod sim3;
