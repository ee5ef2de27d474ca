//! A running mapper goes over to another map of its camera: another mapper takes its place.

use crate::slam::keyframe::Keyframe;
use crate::slam::mapper::Mapper;
use crate::slam::pose::PoseEstimate;

impl Mapper {
    /// Ids of keyframes from here on are given to nobody yet.
    pub fn free_keyframe_id(&self) -> u64 {
        self.next_keyframe_id
    }

    /// Takes the place of a mapper of this camera, having begun in a map none of whose numbers that has given. What was
    /// mapped before keeps its places alone, which frames are placed by: the camera is not looked for there. Odometry goes
    /// on where it has the camera.
    pub fn take_the_place_of(&mut self, before: Self) {
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

    /// The camera was not found yet in this map, but the tracker still knows where it is on a keyframe before it.
    pub(super) fn follow_odometry(&mut self, pose: &PoseEstimate) {
        if pose.state.is_tracked() && pose.world_from_camera.is_finite() {
            self.last_world_from_camera = Some(pose.world_from_camera);
        }
    }
}
