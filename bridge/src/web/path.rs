//! The camera's path so far, each pose relative to its keyframe, so that it follows corrections of the map.

use semidense::slam::pose::NO_KEYFRAME;
use zerocopy::{Immutable, IntoBytes};

use crate::session::Pose;

/// Upper limit for the poses kept: half an hour at 30 Hz. Beyond it, every second one is removed.
const MAX_POSES: usize = 1 << 16;

/// A pose of the path, as it is in a message.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, IntoBytes, Immutable)]
struct PathPose {
    secs: f64,
    position_in_keyframe: [f32; 3],
    keyframe_id: u32,
    epoch: u32,
    state: u32,
}

/// The camera's path.
#[derive(Debug, Default)]
pub struct Path {
    poses: Vec<PathPose>,
    /// One of this many incoming poses is kept.
    every: u64,
    seen: u64,
    /// Number of thinnings: each invalidates what was sent before.
    pub generation: u64,
}

impl Path {
    /// Appends a pose.
    pub fn push(&mut self, pose: &Pose) {
        let message = &pose.message;
        if message.keyframe_id == NO_KEYFRAME {
            return;
        }
        self.seen += 1;
        let [.., x, y, z] = message.keyframe_from_camera;
        let is_same_state = self.poses.last().is_some_and(|last| last.state == message.state);
        if is_same_state && !self.seen.is_multiple_of(self.every.max(1)) {
            return;
        }
        self.poses.push(PathPose {
            secs: message.capture_nanos as f64 * 1e-9,
            position_in_keyframe: [x, y, z].map(|x| x as f32),
            keyframe_id: message.keyframe_id as u32,
            epoch: message.epoch,
            state: message.state,
        });
        if self.poses.len() >= MAX_POSES {
            let mut index = 0;
            self.poses.retain(|_| {
                index += 1;
                index % 2 == 0
            });
            self.every = 2 * self.every.max(1);
            self.generation += 1;
        }
    }

    /// The number of poses.
    pub fn num_poses(&self) -> usize {
        self.poses.len()
    }

    /// The poses from index `from`: seconds f64, position f32 x 3, keyframe, epoch and state u32.
    pub fn bytes_from(&self, from: usize) -> Vec<u8> {
        self.poses.get(from..).unwrap_or_default().as_bytes().to_vec()
    }
}
