//! Every point of every keyframe as a point cloud, binary little-endian PLY: the input of the map's surface.

use std::io::{self, Write};
use std::path::Path;

use zerocopy::IntoBytes;

use crate::service::atomic_file::write_atomically;
use crate::service::results::pictures::is_known;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};
use crate::slam::map::Map;

/// Bytes of a point in the file.
pub const FULL_POINT_BYTES: usize = 24;
/// Beginning of the file.
pub const BEGINNING: &str =
    "ply\nformat binary_little_endian 1.0\ncomment every point of every keyframe";

/// Points of established keyframes whose σ/d is at most `max_relative_std_dev`.
pub fn num_points(map: &Map, max_relative_std_dev: f64) -> usize {
    points(map, max_relative_std_dev).count()
}

fn points(map: &Map, max_relative_std_dev: f64) -> impl Iterator<Item = (&Keyframe, &DepthPoint)> {
    let established = map.keyframes.iter().filter(|k| k.map_state == MapState::Established);
    let all = established.flat_map(|keyframe| keyframe.points.iter().map(move |p| (keyframe, p)));
    all.filter(move |(_, point)| is_known(point, max_relative_std_dev))
}

/// Position in the map of the pixel (u, v) of a keyframe with this inverse depth, map units.
pub(super) fn in_map(keyframe: &Keyframe, [u, v]: [u16; 2], inverse_depth: f32) -> [f32; 3] {
    let ray = keyframe.intrinsics.ray(f64::from(u), f64::from(v));
    let place = keyframe.map_from_keyframe * (ray / f64::from(inverse_depth));
    [place.x as f32, place.y as f32, place.z as f32]
}

/// Writes them for all epochs: each has its own world and unit, and `keyframes.txt` has the epoch of each keyframe.
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
        points(map, max_relative_std_dev).try_for_each(|(keyframe, point)| {
            let [x, y, z] = in_map(keyframe, [point.u, point.v], point.inverse_depth);
            file.write_all([x, y, z, point.intensity, point.variance].as_bytes())?;
            file.write_all((keyframe.keyframe_id as u32).as_bytes())
        })
    })
}
