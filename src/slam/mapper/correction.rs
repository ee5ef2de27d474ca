//! Corrections of the map from outside a step: poses, units, depth and joined epochs, applied consistently at once.
//!
//! Nothing else needs to be notified: frames are stored relative to their keyframes, odometry keeps the camera's pose,
//! and the tracker receives the keyframe as a new revision.

use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::map::{Correction, CorrectionError, KeyframeCorrection};
use crate::slam::mapper::{Mapper, StepOutcome};

impl Mapper {
    /// Applies a correction between two frames and returns what must be published. Rejects it as a whole where a value
    /// is invalid. Keyframes that the map does not hold are left out.
    pub fn apply(&mut self, correction: &Correction) -> Result<StepOutcome, CorrectionError> {
        correction.validate()?;
        // The depth of the previous keyframe may still have to be written from the buffers into the map.
        let finished = self.finish_keyframe();
        let epoch = self.keyframe().map(|keyframe| keyframe.epoch);
        let before = self.last_map_from_camera();
        self.revision += 1;
        self.map.correct(&self.thinning.follow(&self.map, correction), self.revision)?;
        self.depth.maturing.correct(correction, &self.intrinsics);
        let (Some(before), Some(after)) = (before, self.last_map_from_camera()) else {
            return Ok(StepOutcome { graph_changed: true, ..finished });
        };
        if let Some(corrected) = self.active_correction(correction) {
            self.depth.correct(&corrected.depth, &self.intrinsics);
            if let Some(modes) = &corrected.modes {
                self.modes.enter(modes, &self.params.modes);
            }
        }
        // Odometry keeps the camera's pose and its own unit.
        let world_from_camera = self.world_from_map.transform_pose(&before);
        let joined = correction.joins.iter().filter(|join| Some(join.epoch) == epoch);
        let unit = joined.map(|join| join.into_from_epoch.scale).product::<f64>()
            * correction.unit.unwrap_or(1.0);
        let scale = self.world_from_map.scale / unit;
        self.world_from_map = Sim3::between(&after, &world_from_camera, scale);
        self.publish_pose();
        // A joined keyframe has another epoch, and so has its image.
        let keyframe_restored = correction.joins.iter().any(|join| Some(join.epoch) == epoch);
        Ok(StepOutcome {
            keyframe_changed: true,
            graph_changed: true,
            keyframe_restored,
            ..finished
        })
    }

    /// Pose in the map of the last frame tracked in the active epoch, or else of the active keyframe.
    fn last_map_from_camera(&self) -> Option<SE3> {
        let active = self.keyframe()?;
        let of_epoch = |id: u64| self.map.get(id).filter(|known| known.epoch == active.epoch);
        let tracked = self.last_tracked.filter(|(id, _)| of_epoch(*id).is_some());
        let (keyframe_id, at) = tracked.unwrap_or((active.keyframe_id, SE3::identity()));
        self.map.frame_pose(keyframe_id, &at)
    }

    /// The correction of the active keyframe; `None` where it is not corrected.
    fn active_correction<'a>(&self, correction: &'a Correction) -> Option<&'a KeyframeCorrection> {
        let keyframe_id = self.keyframe()?.keyframe_id;
        correction.keyframes.iter().find(|k| k.keyframe_id == keyframe_id)
    }

    /// Anchors the map once the camera has been found on a keyframe: places the map in the world such that the camera
    /// keeps its last odometry pose.
    pub(super) fn anchor(&mut self, keyframe_id: u64, keyframe_from_camera: &SE3) {
        self.last_tracked = Some((keyframe_id, *keyframe_from_camera));
        let map_from_camera = self.map.frame_pose(keyframe_id, keyframe_from_camera);
        if let (Some(map), Some(world)) = (map_from_camera, self.last_world_from_camera) {
            self.world_from_map = Sim3::between(&map, &world, self.world_from_map.scale);
        }
    }
}
