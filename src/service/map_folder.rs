//! The map on disk: a folder that a run begins or continues, and in which the next run locates the camera.
//!
//! ```text
//! DIR/manifest           camera, poses, units and covariances of all keyframes, and which file each one's depth is in
//! DIR/manifest.before    the one before
//! DIR/keyframes/ID.REV   image and depth of keyframe ID, at revision REV
//! ```
//!
//! A file is written under another name, synchronised and renamed; a changed keyframe gets a file of another name, the
//! manifest that lists it is written after it, and a file is removed once neither manifest lists it. The folder is
//! therefore a whole map at every instant: the one saved last. Every file has a checksum; a keyframe whose file is
//! damaged keeps its pose and loses its depth, and a damaged manifest costs the last save.
//!
//! It is separate from the checkpoint, which records an instant rather than a map: the active keyframe in the middle of
//! its depth, about once a second, in memory, for the one successor. Both, the journal and the recorder's map write the
//! numbers of a keyframe alike ([`map_file`](crate::service::map_file)).

pub mod depth_file;
pub(crate) mod keeper;
pub mod manifest;
pub mod map_folder_error;
pub(crate) mod merge;
pub(crate) mod numbering;
pub mod reading;
pub(crate) mod report;
pub(crate) mod session;
pub mod writer;

use std::path::Path;

use crate::service::map_folder::depth_file::MapDetail;
use crate::service::map_folder::keeper::is_kept;
use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::service::map_folder::writer::{MapWriter, head_of};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::map::Map;
use crate::slam::mapper::Mapper;

/// Writes the map of a mapper into a folder that holds none. Calls `each` before each keyframe.
pub fn save_copy(
    folder: &Path,
    mapper: &Mapper,
    detail: MapDetail,
    each: &mut dyn FnMut(),
) -> Result<(), MapFolderError> {
    let camera = mapper.keyframe().or(mapper.map().keyframes.last()).map(|of| of.intrinsics);
    let camera = camera.ok_or(MapFolderError::Empty)?;
    write_new(folder, &camera, detail, mapper.map(), mapper.free_epoch(), each)
}

/// Writes a map into a folder that holds none.
pub fn write_new(
    folder: &Path,
    camera: &Intrinsics,
    detail: MapDetail,
    map: &Map,
    free_epoch: u32,
    each: &mut dyn FnMut(),
) -> Result<(), MapFolderError> {
    let mut writer = MapWriter::open(folder, detail)?;
    if writer.camera().is_some() {
        return Err(MapFolderError::Taken(folder.to_owned()));
    }
    for keyframe in map.keyframes.iter().filter(|of| is_kept(of, camera)) {
        each();
        writer.put(keyframe)?;
    }
    writer.save(camera, head_of(map, free_epoch))
}

#[cfg(test)]
mod tests;
