//! When a new keyframe is asked for.

use crate::slam::alignment::align::Alignment;
use crate::slam::alignment::reference::Reference;
use crate::slam::pose::{Brightness, Quality};
use crate::slam::tracker::Tracker;

impl Tracker {
    /// Whether the camera is so far from the keyframe that a new one is due.
    pub(super) fn proposes_keyframe(
        &self,
        reference: &Reference,
        alignment: &Alignment,
        quality: &Quality,
    ) -> bool {
        let translation = alignment.state.current_from_keyframe.translation.norm();
        let in_mean_depths = translation * reference.mean_inverse_depth();
        self.params.keyframe_distance().distance(in_mean_depths, quality.in_view_ratio) > 1.0
            || self.has_other_light(reference, &alignment.state.brightness)
    }

    /// Whether what has the mean grey value in the keyframe is so much brighter or darker in a frame.
    fn has_other_light(&self, reference: &Reference, brightness: &Brightness) -> bool {
        /// Below a few grey levels a ratio is one of noise.
        const LEAST_GREY: f64 = 5.0;
        let in_keyframe = reference.mean_grey().max(LEAST_GREY);
        let in_frame = (brightness.a.exp() * in_keyframe + brightness.b).max(LEAST_GREY);
        (in_frame / in_keyframe).ln().abs() > self.params.keyframe_brightness_ratio.ln()
    }
}
