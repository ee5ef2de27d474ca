//! Points of the joint estimation as a point cloud, binary little-endian PLY: the sparse part of the map that many
//! keyframes agree on.

use std::io::{self, Write};
use std::path::Path;

use zerocopy::IntoBytes;

use crate::service::atomic_file::write_atomically;
use crate::service::results::full_points::in_map;
use crate::slam::map::{ConfirmedPoint, Map};

/// Writes the points of a map.
pub fn write_points(path: &Path, map: &Map) -> io::Result<()> {
    let placed = map.confirmed.iter().filter_map(|point| Some((position(map, point)?, point)));
    let points: Vec<([f32; 3], &ConfirmedPoint)> = placed.collect();
    write_atomically(path, |file| {
        write!(
            file,
            "ply\nformat binary_little_endian 1.0\n\
             comment points of the joint estimation: x y z in map units, confirmations: keyframes that agree\n\
             element vertex {}\n\
             property float x\nproperty float y\nproperty float z\n\
             property float intensity\nproperty uint confirmations\nproperty uint keyframe\n\
             end_header\n",
            points.len()
        )?;
        points.iter().try_for_each(|([x, y, z], point)| {
            file.write_all([*x, *y, *z, point.intensity].as_bytes())?;
            file.write_all([point.confirmations, point.keyframe_id as u32].as_bytes())
        })
    })
}

/// Position of a point in the map, map units; `None` where its keyframe is gone.
fn position(map: &Map, point: &ConfirmedPoint) -> Option<[f32; 3]> {
    let keyframe = map.get(point.keyframe_id)?;
    let position = in_map(keyframe, [point.u, point.v], point.inverse_depth);
    position.iter().all(|x| x.is_finite()).then_some(position)
}
