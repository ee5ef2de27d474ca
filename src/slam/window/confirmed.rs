//! The window's points for display: where each is, and how many keyframes confirm it.

use crate::slam::map::{ConfirmedPoint, Map};
use crate::slam::window::Window;

impl Window {
    /// Returns the points that some keyframe confirms, by host; hosts that `map` does not hold are left out.
    pub fn confirmed_points(&self, map: &Map) -> Vec<ConfirmedPoint> {
        let hosts =
            self.keyframes.iter().filter_map(|host| Some((host, map.get(host.keyframe_id)?)));
        let of_host = hosts.flat_map(|(host, keyframe)| {
            let alive =
                host.points.iter().filter(|point| point.is_alive && point.confirmations > 0);
            alive.filter_map(move |point| {
                let pixel = usize::from(point.v) * keyframe.intrinsics.width + usize::from(point.u);
                Some(ConfirmedPoint {
                    keyframe_id: host.keyframe_id,
                    u: point.u,
                    v: point.v,
                    confirmations: point.confirmations,
                    inverse_depth: (point.inverse_depth * keyframe.map_from_keyframe.scale) as f32,
                    intensity: f32::from(*host.images.first()?.pixels().get(pixel)?),
                })
            })
        });
        of_host
            .filter(|point| point.inverse_depth.is_finite() && point.inverse_depth > 0.0)
            .collect()
    }
}
