//! Switches a running mapper to another map of its camera: a second mapper replaces it.

use crate::slam::keyframe::Keyframe;
use crate::slam::mapper::Mapper;
use crate::slam::pose::PoseEstimate;

impl Mapper {
    /// The first keyframe id that has not been assigned.
    pub fn free_keyframe_id(&self) -> u64 {
        self.next_keyframe_id
    }

    /// Replaces `before`, a mapper of the same camera; this mapper must have started in a map that holds none of the
    /// numbers that `before` has assigned. Keyframes mapped before keep only their poses, which place their frames: the
    /// camera is not searched for there. Odometry continues from its pose of the camera.
    pub fn replace_mapper(&mut self, before: Self) {
        let mut keyframes: Vec<Keyframe> =
            before.map.keyframes.iter().map(Keyframe::without_depth).collect();
        keyframes.append(&mut self.map.keyframes);
        self.map.keyframes = keyframes;
        self.map.frames = before.map.frames;
        self.map.revision = self.map.revision.max(before.map.revision);
        self.revision = self.revision.max(before.revision);
        self.next_keyframe_id = self.next_keyframe_id.max(before.next_keyframe_id);
        self.first_free_epoch = self.first_free_epoch.max(before.first_free_epoch);
        self.last_world_from_camera = before.last_world_from_camera;
    }

    /// Follows odometry, also on a keyframe of the map before this one, or on an earlier one than the active.
    pub(super) fn follow_odometry(&mut self, pose: &PoseEstimate) {
        if pose.state.is_tracked() && pose.world_from_camera.is_finite() {
            self.last_world_from_camera = Some(pose.world_from_camera);
        }
    }
}
