//! The unit of a window that only one keyframe holds: no image observes it, so that it would drift.

use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::plane::median;
use crate::slam::window::system::Members;

/// The depths of the only fixed keyframe, before an adjustment.
pub(super) struct Unit {
    anchor: usize,
    inverse_depths: Vec<f64>,
}

impl Unit {
    /// Takes the depths where exactly one keyframe is fixed; `None` otherwise.
    pub(super) fn of(keyframes: &[WindowKeyframe], members: &Members<'_>) -> Option<Self> {
        let pairs = members.members.iter().zip(members.free);
        let mut fixed = pairs.filter(|(_, free)| free.is_none()).map(|(&member, _)| member);
        let (Some(anchor), None) = (fixed.next(), fixed.next()) else { return None };
        let points = keyframes[anchor].points.iter();
        Some(Self { anchor, inverse_depths: points.map(|point| point.inverse_depth).collect() })
    }

    /// Scales depths and poses about that keyframe, so that the median of its depths is unchanged; returns the
    /// similarity that moves the map. `None`, with nothing changed, where no depth is left.
    pub(super) fn restore(
        &self,
        keyframes: &mut [WindowKeyframe],
        members: &[usize],
    ) -> Option<Sim3> {
        let points = keyframes[self.anchor].points.iter().zip(&self.inverse_depths);
        let alive = points.filter(|(point, _)| point.is_alive);
        // 0 where no point is left.
        let factor = median(alive.map(|(now, before)| now.inverse_depth / before).collect());
        if !(factor.is_finite() && factor > 0.0) {
            return None;
        }
        let anchor_from_map = keyframes[self.anchor].camera_from_map;
        let map_from_anchor = anchor_from_map.inverse();
        for &member in members {
            let keyframe = &mut keyframes[member];
            keyframe.points.iter_mut().for_each(|point| point.inverse_depth /= factor);
            if member != self.anchor {
                let mut camera_from_anchor = keyframe.camera_from_map * map_from_anchor;
                camera_from_anchor.translation *= factor;
                keyframe.camera_from_map = camera_from_anchor * anchor_from_map;
            }
        }
        let about = Sim3::new(SE3::identity(), factor);
        Some(Sim3::new(map_from_anchor, 1.0) * about * Sim3::new(anchor_from_map, 1.0))
    }
}
