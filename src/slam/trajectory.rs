//! Trajectories: poses with stamps.

use std::collections::BTreeMap;

use crate::slam::geometry::se3::SE3;

/// The pose of a camera at an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedPose {
    /// Stamp in nanoseconds, of the recording's clock.
    pub nanos: i64,
    /// Camera pose, optical axes.
    pub world_from_camera: SE3,
}

/// A pose, and the epoch whose origin and unit of length it has.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochPose {
    /// The epoch.
    pub epoch: u32,
    /// The pose.
    pub pose: StampedPose,
}

/// The poses of each epoch, in their order; an epoch may have been left and taken up again.
pub fn by_epoch(poses: &[EpochPose]) -> BTreeMap<u32, Vec<StampedPose>> {
    let mut epochs: BTreeMap<u32, Vec<StampedPose>> = BTreeMap::new();
    poses.iter().for_each(|of| epochs.entry(of.epoch).or_default().push(of.pose));
    epochs
}
