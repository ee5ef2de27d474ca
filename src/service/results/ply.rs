//! The map as a point cloud, binary little-endian PLY.

use std::io::{self, Write};
use std::path::Path;

use nalgebra::Vector3;

use crate::service::atomic_file::write_atomically;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;

/// A point of the cloud.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CloudPoint {
    /// Position in the world, map units.
    pub position: [f32; 3],
    /// Brightness of its pixel, 0 to 255.
    pub intensity: f32,
    /// Variance of its inverse depth, keyframe units.
    pub variance: f32,
    /// Its keyframe.
    pub keyframe_id: u32,
}

/// Every point of an established keyframe whose σ/d is at most `max_relative_std_dev`.
pub fn point_cloud(map: &Map, max_relative_std_dev: f64) -> Vec<CloudPoint> {
    map.keyframes
        .iter()
        .filter(|k| k.map_state == MapState::Established)
        .flat_map(|k| keyframe_points(k, max_relative_std_dev))
        .collect()
}

fn keyframe_points(
    keyframe: &Keyframe,
    max_relative_std_dev: f64,
) -> impl Iterator<Item = CloudPoint> + '_ {
    let k = keyframe.intrinsics;
    keyframe.points.iter().filter_map(move |point| {
        let d = f64::from(point.inverse_depth);
        let relative_std_dev = f64::from(point.variance).sqrt() / d;
        if !(d > 0.0 && relative_std_dev <= max_relative_std_dev) {
            return None;
        }
        let (u, v) = (f64::from(point.u), f64::from(point.v));
        let in_keyframe = Vector3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0) / d;
        let in_world = keyframe.map_from_keyframe * in_keyframe;
        Some(CloudPoint {
            position: [in_world.x as f32, in_world.y as f32, in_world.z as f32],
            intensity: point.intensity,
            variance: point.variance,
            keyframe_id: keyframe.keyframe_id as u32,
        })
    })
}

/// Writes the cloud.
pub fn write_ply(path: &Path, cloud: &[CloudPoint]) -> io::Result<()> {
    write_atomically(path, |file| {
        write!(
            file,
            "ply\nformat binary_little_endian 1.0\n\
             comment x y z in map units, variance of the inverse depth in keyframe units\n\
             element vertex {}\n\
             property float x\nproperty float y\nproperty float z\n\
             property float intensity\nproperty float variance\nproperty uint keyframe\n\
             end_header\n",
            cloud.len()
        )?;
        for point in cloud {
            for number in point.position.iter().chain([&point.intensity, &point.variance]) {
                file.write_all(&number.to_le_bytes())?;
            }
            file.write_all(&point.keyframe_id.to_le_bytes())?;
        }
        Ok(())
    })
}
