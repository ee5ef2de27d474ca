//! The map as a point cloud, binary PCD v0.7: the same points as in the PLY.

use std::io::{self, Write};
use std::path::Path;

use crate::service::atomic_file::write_atomically;
use crate::service::results::ply::CloudPoint;

/// Writes the cloud.
pub fn write_pcd(path: &Path, cloud: &[CloudPoint]) -> io::Result<()> {
    write_atomically(path, |file| {
        write!(
            file,
            "# .PCD v0.7 - x y z in map units, variance of the inverse depth in keyframe units\n\
             VERSION 0.7\n\
             FIELDS x y z intensity variance keyframe\n\
             SIZE 4 4 4 4 4 4\n\
             TYPE F F F F F U\n\
             COUNT 1 1 1 1 1 1\n\
             WIDTH {count}\n\
             HEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\n\
             POINTS {count}\n\
             DATA binary\n",
            count = cloud.len()
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
