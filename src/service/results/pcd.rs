//! The surface of the map as a point cloud, binary PCD v0.7: the points of the PLY, with the field names of PCL.

use std::io::{self, Write};
use std::path::Path;

use zerocopy::IntoBytes;

use crate::service::atomic_file::write_atomically;
use crate::slam::fusion::SurfacePoint;

/// Beginning of the file.
pub const BEGINNING: &str = "# .PCD v0.7 - x y z in map units";

/// Writes the surface of the map.
pub fn write_pcd(path: &Path, surface: &[SurfacePoint]) -> io::Result<()> {
    write_atomically(path, |file| {
        write!(
            file,
            "{BEGINNING}, sigma along the ray in map units, keyframes that agree\n\
             VERSION 0.7\n\
             FIELDS x y z normal_x normal_y normal_z rgb sigma keyframes\n\
             SIZE 4 4 4 4 4 4 4 4 1\n\
             TYPE F F F F F F F F U\n\
             COUNT 1 1 1 1 1 1 1 1 1\n\
             WIDTH {count}\n\
             HEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\n\
             POINTS {count}\n\
             DATA binary\n",
            count = surface.len()
        )?;
        surface.iter().try_for_each(|point| {
            file.write_all([point.position, point.normal].as_bytes())?;
            // PCL packs blue, green and red into the bytes of a number.
            file.write_all(&[point.grey, point.grey, point.grey, 0])?;
            file.write_all(point.sigma.as_bytes())?;
            file.write_all(&[point.keyframes])
        })
    })
}
