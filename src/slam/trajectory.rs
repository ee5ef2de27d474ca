//! Trajectories: poses with stamps.

use crate::slam::geometry::se3::SE3;

/// The pose of a camera at an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedPose {
    /// Stamp in nanoseconds, of the recording's clock.
    pub nanos: i64,
    /// Camera pose, optical axes.
    pub world_from_camera: SE3,
}
