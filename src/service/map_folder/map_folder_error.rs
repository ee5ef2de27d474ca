//! Why a map on disk cannot be used.

use std::io;
use std::path::{Path, PathBuf};

use crate::service::map_folder::manifest::ManifestError;
use crate::slam::geometry::intrinsics::Intrinsics;

/// Why a map cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MapFolderError {
    /// The folder holds no map.
    #[error(
        "{0} holds no map: check the path, or start one there with `semidense run SOURCE --map {0}`"
    )]
    Missing(PathBuf),
    /// The path is a file.
    #[error("{0} is a file; name a folder")]
    File(PathBuf),
    /// The folder holds other things.
    #[error(
        "{0} is not a map, and not empty: name an empty folder, or one that does not exist yet"
    )]
    Foreign(PathBuf),
    /// The folder holds a map that would be lost.
    #[error("{0} already holds a map: name another folder")]
    Taken(PathBuf),
    /// The map has no keyframe yet.
    #[error("there is no map yet: no keyframe has been created")]
    Empty,
    /// It cannot be read.
    #[error("{path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// Its manifest cannot be used.
    #[error("{path}: {source}")]
    Manifest {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: ManifestError,
    },
    /// It was taken with another camera.
    #[error(
        "{folder} is a map of another camera ({}): this one is {}; a map belongs to one camera and its calibration, so \
         name another folder",
        camera_text(map),
        camera_text(camera)
    )]
    Camera {
        /// The map.
        folder: PathBuf,
        /// Its camera.
        map: Box<Intrinsics>,
        /// The present camera.
        camera: Box<Intrinsics>,
    },
    /// Two maps of different cameras cannot be merged.
    #[error(
        "{first} and {second} are maps of different cameras ({} and {}): only maps of one camera and its calibration can \
         be merged",
        camera_text(&cameras[0]),
        camera_text(&cameras[1])
    )]
    Cameras {
        /// The first map.
        first: PathBuf,
        /// The second map.
        second: PathBuf,
        /// Their cameras.
        cameras: Box<[Intrinsics; 2]>,
    },
    /// Another process is writing it.
    #[error("{folder} is being written by another process{by}: wait for it, or use --read-only")]
    Held {
        /// The map.
        folder: PathBuf,
        /// The other process, where known.
        by: String,
    },
    /// It cannot be written.
    #[error(
        "{path}: cannot write the map ({source}); free space on the disk, or name another folder"
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
}

/// Refuses a map in `folder` that was taken with another camera.
pub(super) fn check_same_camera(
    folder: &Path,
    map: &Intrinsics,
    camera: &Intrinsics,
) -> Result<(), MapFolderError> {
    if map == camera {
        return Ok(());
    }
    let (map, camera) = (Box::new(*map), Box::new(*camera));
    Err(MapFolderError::Camera { folder: folder.to_owned(), map, camera })
}

fn camera_text(camera: &Intrinsics) -> String {
    let Intrinsics { width, height, fx, fy, cx, cy } = camera;
    format!("{width}x{height}, fx {fx:.3}, fy {fy:.3}, cx {cx:.3}, cy {cy:.3}")
}
