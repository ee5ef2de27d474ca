//! Why a map on disk cannot be used.

use std::io;
use std::path::{Path, PathBuf};

use crate::service::map_folder::manifest::ManifestError;
use crate::slam::geometry::intrinsics::Intrinsics;

/// Why a map cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MapFolderError {
    /// There is none.
    #[error(
        "{0} holds no map: check the path, or begin one there with `semidense run SOURCE --map {0}`"
    )]
    Missing(PathBuf),
    /// There is a file in its place.
    #[error("{0} is a file; name a folder")]
    File(PathBuf),
    /// The folder is full of other things.
    #[error(
        "{0} is not a map, and not empty: name an empty folder, or one that does not exist yet"
    )]
    Foreign(PathBuf),
    /// The folder holds a map that would be lost.
    #[error("{0} holds a map already: name another folder")]
    Taken(PathBuf),
    /// There is nothing to be written.
    #[error("there is no map yet: no keyframe has been made")]
    Empty,
    /// It cannot be read.
    #[error("{path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// What it holds cannot be used.
    #[error("{path}: {source}")]
    Manifest {
        /// The file.
        path: PathBuf,
        /// Why.
        source: ManifestError,
    },
    /// Another camera took it.
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
        /// Ours.
        camera: Box<Intrinsics>,
    },
    /// Another process writes it.
    #[error("{folder} is being written by another process{by}: wait for it, or use --read-only")]
    Held {
        /// The map.
        folder: PathBuf,
        /// Who, where that is known.
        by: String,
    },
    /// It cannot be written.
    #[error(
        "{path}: cannot write the map ({source}); free space on the disk, or name another folder"
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

/// Refuses a map in `folder` that another camera than this one took.
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
