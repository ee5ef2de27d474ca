//! The map as a point cloud, binary little-endian PLY.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use zerocopy::IntoBytes;

use crate::service::atomic_file::write_atomically;
use crate::service::bytes::take;
use crate::slam::fusion::SurfacePoint;

/// Bytes of a point of the surface in the file.
pub const SURFACE_POINT_BYTES: usize = 32;
/// Beginning of each file.
pub const BEGINNING: &str =
    "ply\nformat binary_little_endian 1.0\ncomment x y z in map units, sigma";
/// The properties of a point, in order.
const PROPERTIES: &str = "property float x\nproperty float y\nproperty float z\n\
     property float nx\nproperty float ny\nproperty float nz\n\
     property uchar red\nproperty uchar green\nproperty uchar blue\n\
     property float sigma\nproperty uchar keyframes\n\
     end_header\n";

/// Writes the surface of the map so that most programs open it.
pub fn write_surface(path: &Path, surface: &[SurfacePoint]) -> io::Result<()> {
    write_atomically(path, |file| {
        write!(
            file,
            "{BEGINNING} along the ray in map units, keyframes that agree; normal 0 0 0: unknown\n\
             comment any prefix of the list covers the whole map\n\
             element vertex {}\n{PROPERTIES}",
            surface.len()
        )?;
        surface.iter().try_for_each(|point| {
            file.write_all([point.position, point.normal].as_bytes())?;
            file.write_all(&[point.grey; 3])?;
            file.write_all(point.sigma.as_bytes())?;
            file.write_all(&[point.keyframes])
        })
    })
}

/// Why a surface cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadSurfaceError {
    /// The file cannot be read, or ends too early.
    #[error("{path}: {source}; the map's points cannot be read")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// It is not a `map.ply` of this version.
    #[error("{0} is not a map.ply of this version of semidense: write it again")]
    Foreign(PathBuf),
}

/// Reads the first points of a `map.ply`, at most `most`: they show the whole map, coarser the fewer they are. Points
/// that are not finite are left out.
pub fn read_surface(path: &Path, most: usize) -> Result<Vec<SurfacePoint>, ReadSurfaceError> {
    let failed = |source| ReadSurfaceError::Read { path: path.to_owned(), source };
    let mut file = BufReader::new(File::open(path).map_err(failed)?);
    let count = read_header(&mut file).map_err(failed)?;
    let count = count.ok_or_else(|| ReadSurfaceError::Foreign(path.to_owned()))?.min(most);
    let mut points = Vec::new();
    let mut bytes = [0; SURFACE_POINT_BYTES];
    for _ in 0..count {
        file.read_exact(&mut bytes).map_err(failed)?;
        points.extend(point_of(&bytes));
    }
    Ok(points)
}

/// The number of points that follow; `None` for another file.
fn read_header(file: &mut impl BufRead) -> io::Result<Option<usize>> {
    /// Longer than any header written here.
    const LONGEST: usize = 1000;
    const END: &[u8] = b"\nend_header\n";
    let mut header = Vec::new();
    let mut file = file.take(LONGEST as u64);
    while !header.ends_with(END) && file.read_until(b'\n', &mut header)? > 0 {}
    let header = String::from_utf8(header).unwrap_or_default();
    let count = header
        .strip_suffix(PROPERTIES)
        .filter(|header| header.starts_with(BEGINNING))
        .and_then(|header| header.trim_end().rsplit_once("element vertex "))
        .and_then(|(_, count)| count.parse().ok());
    Ok(count)
}

fn point_of(mut bytes: &[u8]) -> Option<SurfacePoint> {
    let bytes = &mut bytes;
    let ([position, normal], [grey, ..]) = (take(bytes)?, take::<[u8; 3]>(bytes)?);
    let (sigma, keyframes) = (take(bytes)?, take(bytes)?);
    let point = SurfacePoint { position, normal, grey, sigma, keyframes };
    let numbers = || point.position.iter().chain(&point.normal).chain([&point.sigma]);
    numbers().all(|number| number.is_finite()).then_some(point)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_surface_is_read_back_and_a_short_or_foreign_file_is_refused() {
        let point = |i: u8| SurfacePoint {
            position: [f32::from(i), 0.5, -1.25],
            normal: [0.0, f32::from(i % 2), 0.0],
            grey: i,
            sigma: 0.25,
            keyframes: 255 - i,
        };
        let points: Vec<SurfacePoint> = (0..100).map(point).collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        write_surface(&path, &points).unwrap();
        assert_eq!(read_surface(&path, usize::MAX).unwrap(), points);
        assert_eq!(read_surface(&path, 7).unwrap(), points[..7]);
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..whole.len() - 1]).unwrap();
        assert!(matches!(read_surface(&path, 100), Err(ReadSurfaceError::Read { .. })));
        assert_eq!(read_surface(&path, 99).unwrap().len(), 99);
        for foreign in [&b""[..], b"ply\nformat ascii 1.0\n", &[b'x'; 5000], &whole[40..]] {
            std::fs::write(&path, foreign).unwrap();
            assert!(matches!(read_surface(&path, 9), Err(ReadSurfaceError::Foreign(_))));
        }
        let mut hostile = points.clone();
        (hostile[3].position[1], hostile[4].sigma) = (f32::NAN, f32::INFINITY);
        write_surface(&path, &hostile).unwrap();
        assert_eq!(read_surface(&path, usize::MAX).unwrap().len(), 98);
    }
}
