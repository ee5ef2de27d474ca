//! Every point of every keyframe as a point cloud, binary little-endian PLY: what the map's surface is made from.

use std::io::{self, Write};
use std::path::Path;

use crate::service::atomic_file::write_atomically;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;

/// A point of a keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
struct FullPoint {
    /// Position in the world, map units.
    position: [f32; 3],
    /// Brightness of its pixel, 0 to 255.
    intensity: f32,
    /// Variance of its inverse depth, keyframe units.
    variance: f32,
    /// Its keyframe.
    keyframe_id: u32,
}

/// Bytes of a point in the file.
pub const FULL_POINT_BYTES: usize = 24;
/// What the file begins with.
pub const BEGINNING: &str =
    "ply\nformat binary_little_endian 1.0\ncomment every point of every keyframe";

/// Points of established keyframes whose σ/d is at most `max_relative_std_dev`.
pub fn num_points(map: &Map, max_relative_std_dev: f64) -> usize {
    points(map, max_relative_std_dev).count()
}

fn points(map: &Map, max_relative_std_dev: f64) -> impl Iterator<Item = FullPoint> + '_ {
    let established = map.keyframes.iter().filter(|k| k.map_state == MapState::Established);
    established.flat_map(move |k| keyframe_points(k, max_relative_std_dev))
}

fn keyframe_points(
    keyframe: &Keyframe,
    max_relative_std_dev: f64,
) -> impl Iterator<Item = FullPoint> + '_ {
    let k = keyframe.intrinsics;
    keyframe.points.iter().filter_map(move |point| {
        let d = f64::from(point.inverse_depth);
        let relative_std_dev = f64::from(point.variance).sqrt() / d;
        if !(d > 0.0 && relative_std_dev <= max_relative_std_dev) {
            return None;
        }
        let (u, v) = (f64::from(point.u), f64::from(point.v));
        let in_keyframe = k.ray(u, v) / d;
        let in_world = keyframe.map_from_keyframe * in_keyframe;
        Some(FullPoint {
            position: [in_world.x as f32, in_world.y as f32, in_world.z as f32],
            intensity: point.intensity,
            variance: point.variance,
            keyframe_id: keyframe.keyframe_id as u32,
        })
    })
}

/// Writes them, of all epochs: each has a place and a unit of its own, and `keyframes.txt` says which keyframe is of which.
pub fn write_full_points(path: &Path, map: &Map, max_relative_std_dev: f64) -> io::Result<()> {
    let count = num_points(map, max_relative_std_dev);
    write_atomically(path, |file| {
        write!(
            file,
            "{BEGINNING}: x y z in map units, variance of the inverse depth in keyframe units\n\
             element vertex {count}\n\
             property float x\nproperty float y\nproperty float z\n\
             property float intensity\nproperty float variance\nproperty uint keyframe\n\
             end_header\n"
        )?;
        points(map, max_relative_std_dev).try_for_each(|point| {
            for number in point.position.iter().chain([&point.intensity, &point.variance]) {
                file.write_all(&number.to_le_bytes())?;
            }
            file.write_all(&point.keyframe_id.to_le_bytes())
        })
    })
}
