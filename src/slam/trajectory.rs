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

/// A pose, with the epoch that defines its origin and unit of length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochPose {
    /// The epoch.
    pub epoch: u32,
    /// The pose.
    pub pose: StampedPose,
}

/// The poses of each epoch, in order; an epoch may have been left and resumed.
pub fn by_epoch(poses: &[EpochPose]) -> BTreeMap<u32, Vec<StampedPose>> {
    let mut epochs: BTreeMap<u32, Vec<StampedPose>> = BTreeMap::new();
    poses.iter().for_each(|of| epochs.entry(of.epoch).or_default().push(of.pose));
    epochs
}

/// Among the poses of `epoch`, in order, the indices of those that other epochs separate from the one before.
pub fn gaps_in(poses: &[EpochPose], epoch: u32) -> Vec<usize> {
    let at: Vec<usize> = (0..poses.len()).filter(|&i| poses[i].epoch == epoch).collect();
    (1..at.len()).filter(|&i| at[i] > at[i - 1] + 1).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_has_a_gap_where_another_interrupts_it() {
        let pose = StampedPose { nanos: 0, world_from_camera: SE3::identity() };
        let poses = [0, 1, 1, 0, 0, 2, 1].map(|epoch| EpochPose { epoch, pose });
        assert_eq!(
            [0, 1, 2, 3].map(|epoch| gaps_in(&poses, epoch)),
            [vec![1], vec![2], vec![], vec![]]
        );
    }
}
