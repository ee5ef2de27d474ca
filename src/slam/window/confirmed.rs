//! The window's points for whoever shows the map: where each is, and how many keyframes confirm it.

use crate::slam::map::Map;
use crate::slam::window::Window;

/// A point that several keyframes were estimated from jointly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfirmedPoint {
    /// The keyframe that it was chosen in.
    pub keyframe_id: u64,
    /// Column of its pixel there, level 0.
    pub u: u16,
    /// Row.
    pub v: u16,
    /// Keyframes that agreed with it when it was last estimated, beside its own.
    pub confirmations: u32,
    /// 1/z along the keyframe's optical axis, one over the keyframe's unit.
    pub inverse_depth: f32,
    /// Brightness of its pixel, grey levels.
    pub intensity: f32,
}

impl Window {
    /// The points that something agrees with, by keyframe; those of keyframes that `map` does not hold are left out.
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
