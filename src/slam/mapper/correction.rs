//! Corrections of the map from outside the step: poses, units, depth and joined epochs, consistent everywhere at
//! once.
//!
//! Nothing else has to be told: frames are kept relative to their keyframes, the odometry's place of the active
//! keyframe stands still, and the tracker gets the keyframe as another revision.

use crate::slam::map::{Correction, CorrectionError, LogPlane};
use crate::slam::mapper::{Mapper, StepOutcome};

impl Mapper {
    /// Applies a correction between two frames; what is to be published then. Refused as a whole where a number
    /// is broken. Keyframes that the map does not hold are left out.
    pub fn apply(&mut self, correction: &Correction) -> Result<StepOutcome, CorrectionError> {
        correction.validate()?;
        // The depth of the keyframe before is on its way from the buffers into the map.
        let finished = self.finish_keyframe();
        let before = self.keyframe().map(|keyframe| keyframe.map_from_keyframe);
        self.revision += 1;
        self.map.correct(correction, self.revision)?;
        let Some(before) = before else {
            return Ok(StepOutcome { graph_changed: true, ..finished });
        };
        if let Some(plane) = self.active_plane(correction) {
            self.depth.correct(&plane, &self.intrinsics);
        }
        if let Some(active) = self.keyframe() {
            // The active keyframe stays where odometry has it, in the unit that it has there.
            self.world_from_map = self.world_from_map * before * active.map_from_keyframe.inverse();
        }
        self.publish_place();
        Ok(StepOutcome { keyframe_changed: true, graph_changed: true, ..finished })
    }

    /// What the correction does to the active keyframe's depth; `None` where it is not in it.
    fn active_plane(&self, correction: &Correction) -> Option<LogPlane> {
        let keyframe_id = self.keyframe()?.keyframe_id;
        let corrected = correction.keyframes.iter().find(|k| k.keyframe_id == keyframe_id);
        corrected.map(|corrected| corrected.depth)
    }
}
