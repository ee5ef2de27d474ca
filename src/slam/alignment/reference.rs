//! The keyframe prepared for alignment: everything that is paid per keyframe and not per frame.

use crate::slam::keyframe::Keyframe;

/// A keyframe prepared for alignment, point clouds by pyramid level.
#[derive(Debug, Clone)]
pub struct Reference {
    keyframe_id: u64,
}

impl Reference {
    /// Prepares `keyframe`.
    pub fn prepare(keyframe: &Keyframe) -> Self {
        Self { keyframe_id: keyframe.keyframe_id }
    }

    /// The keyframe it was prepared from.
    pub fn keyframe_id(&self) -> u64 {
        self.keyframe_id
    }
}
