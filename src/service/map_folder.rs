//! The map on disk: a folder that a run begins or goes on with, and that the next one finds the camera in.
//!
//! ```text
//! DIR/manifest           camera, poses, units and covariances of all keyframes, and which file each one's depth is in
//! DIR/manifest.before    the one before
//! DIR/keyframes/ID.REV   image and depth of keyframe ID, at revision REV
//! ```
//!
//! A file is written under another name, synchronised and renamed; a changed keyframe gets a file of another name, the
//! manifest that lists it comes after it, and a file is removed when neither manifest lists it. So the folder is a
//! whole map at every instant: the last that was saved. Every file has a checksum; a keyframe whose file is damaged
//! keeps its pose and loses its depth, and a damaged manifest costs what was saved last.
//!
//! It stands beside the [checkpoint](crate::service::checkpoint), which is of an instant and not of a map: the active
//! keyframe in the middle of its depth, several times a second, in memory, for the one process that comes after. Both,
//! the journal and the recorder's map write the numbers of a keyframe alike ([`map_file`](crate::service::map_file)).

pub mod depth_file;
pub mod keeper;
pub mod manifest;
pub mod merge;
pub mod numbering;
pub mod report;
pub mod session;
pub mod writer;

use std::io;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::capture::input_file;
use crate::service::map_folder::depth_file::{
    DepthFileError, MapDetail, checksum_of, decode_into, most_bytes,
};
use crate::service::map_folder::keeper::{head_of, is_kept};
use crate::service::map_folder::manifest::{DepthFile, Listed, Manifest, ManifestError};
use crate::service::map_folder::writer::{MapHead, MapWriter};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::slam::map::Map;
use crate::slam::mapper::Mapper;

/// Names in the folder.
const MANIFEST: &str = "manifest";
const BEFORE: &str = "manifest.before";
const KEYFRAMES: &str = "keyframes";
/// Largest manifest: that of the most keyframes has 80 MB.
const MAX_MANIFEST_BYTES: u64 = 128 << 20;
/// How often a map is read again whose files were replaced meanwhile.
const MAX_READS: usize = 3;

/// Why a map cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MapFolderError {
    /// There is none.
    #[error(
        "{0} holds no map: check the path, or begin one there with `semidense run SOURCE --map {0}`"
    )]
    Missing(PathBuf),
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

fn camera_text(camera: &Intrinsics) -> String {
    let Intrinsics { width, height, fx, fy, cx, cy } = camera;
    format!("{width}x{height}, fx {fx:.3}, fy {fy:.3}, cx {cx:.3}, cy {cy:.3}")
}

/// A map that was read.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// What the folder says.
    pub manifest: Manifest,
    /// The map. Keyframes beyond the memory it may take have only their poses.
    pub map: Map,
    /// Keyframes that are left without depth, since it would take more memory.
    pub without_memory: usize,
    /// What is damaged, a line for each file.
    pub problems: Vec<String>,
}

/// Reads a map. Image and depth of the newest keyframes that take at most `max_bytes` are read, with the threads of the
/// pool it is called in.
pub fn load(folder: &Path, max_bytes: usize) -> Result<Loaded, MapFolderError> {
    let mut reads = 0;
    loop {
        reads += 1;
        let (manifest, mut problems) = read_manifest(folder)?;
        let (map, without_memory, files) = read_keyframes(folder, &manifest, max_bytes);
        // Another process may have saved meanwhile, and removed what was listed.
        let is_replaced = !files.is_empty() && read_manifest(folder)?.0 != manifest;
        if !is_replaced || reads == MAX_READS {
            problems.extend(files);
            return Ok(Loaded { manifest, map, without_memory, problems });
        }
    }
}

/// Writes the map of a mapper into a folder that holds none. `each` is called before each keyframe.
pub fn save_copy(
    folder: &Path,
    mapper: &Mapper,
    detail: MapDetail,
    each: &mut dyn FnMut(),
) -> Result<(), MapFolderError> {
    let camera = mapper.keyframe().or(mapper.map().keyframes.last()).map(|of| of.intrinsics);
    let camera = camera.ok_or(MapFolderError::Empty)?;
    write_new(folder, &camera, detail, mapper.map(), head_of(mapper), each)
}

/// Writes a map into a folder that holds none.
pub fn write_new(
    folder: &Path,
    camera: &Intrinsics,
    detail: MapDetail,
    map: &Map,
    head: MapHead,
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
    writer.save(camera, head)
}

/// The manifest of a map, or the one before where that is damaged, and then what is.
pub fn read_manifest(folder: &Path) -> Result<(Manifest, Vec<String>), MapFolderError> {
    let read = |name: &str| {
        let path = folder.join(name);
        let mut bytes = Vec::new();
        match input_file::read_into(&path, MAX_MANIFEST_BYTES, &mut bytes) {
            Ok(()) => Manifest::from_bytes(&bytes)
                .map_err(|source| MapFolderError::Manifest { path, source }),
            Err(source) => Err(MapFolderError::Read { path, source }),
        }
    };
    let is_missing = |error: &MapFolderError| matches!(error, MapFolderError::Read { source, .. } if source.kind() == io::ErrorKind::NotFound);
    let error = match read(MANIFEST) {
        Ok(manifest) => return Ok((manifest, Vec::new())),
        Err(error) => error,
    };
    // What a newer program has written is not to be taken for what an older one has left beside it.
    if let MapFolderError::Manifest {
        source: ManifestError::Version(_) | ManifestError::Section(_),
        ..
    } = error
    {
        return Err(error);
    }
    match read(BEFORE) {
        Ok(manifest) => Ok((manifest, vec![format!("{error}: the map is the one saved before")])),
        Err(before) if is_missing(&before) && is_missing(&error) => {
            Err(MapFolderError::Missing(folder.to_owned()))
        }
        Err(_) => Err(error),
    }
}

/// The keyframes of a manifest with their depth, how many are left without it for want of memory, and what is damaged.
fn read_keyframes(
    folder: &Path,
    manifest: &Manifest,
    max_bytes: usize,
) -> (Map, usize, Vec<String>) {
    let num_pixels = manifest.camera.width * manifest.camera.height;
    let in_memory =
        |file: &DepthFile| num_pixels + file.num_points as usize * size_of::<DepthPoint>();
    let mut bytes = 0;
    let mut fits = Vec::with_capacity(manifest.keyframes.len());
    for listed in manifest.keyframes.iter().rev() {
        bytes += listed.file.as_ref().map_or(0, in_memory);
        fits.push(bytes <= max_bytes);
    }
    fits.reverse();
    let read = |(listed, fits): (&Listed, &bool)| {
        let mut keyframe = listed.keyframe.clone();
        let problem = match (&listed.file, fits) {
            (Some(file), true) => read_depth(folder, file, &mut keyframe).err(),
            _ => None,
        };
        (keyframe, problem)
    };
    let pairs = manifest.keyframes.par_iter().zip(fits.par_iter());
    let read: Vec<(Keyframe, Option<String>)> = pairs.map(read).collect();
    let has_file = manifest.keyframes.iter().map(|listed| listed.file.is_some());
    let without_memory = has_file.zip(&fits).filter(|(has_file, fits)| *has_file && !**fits);
    let without_memory = without_memory.count();
    let (keyframes, problems): (Vec<_>, Vec<_>) = read.into_iter().unzip();
    let map = Map {
        keyframes,
        loops: manifest.loops.clone(),
        revision: manifest.revision,
        free_epoch: manifest.free_epoch,
        ..Map::default()
    };
    (map, without_memory, problems.into_iter().flatten().collect())
}

/// Gives a keyframe what its file holds; otherwise a line that says which file is damaged, and how.
fn read_depth(folder: &Path, file: &DepthFile, keyframe: &mut Keyframe) -> Result<(), String> {
    let path = folder.join(KEYFRAMES).join(file.name(keyframe.keyframe_id));
    let id = keyframe.keyframe_id;
    let told = |why: &dyn std::fmt::Display| {
        format!("{}: {why}; keyframe {id} keeps its pose and loses its depth", path.display())
    };
    let num_pixels = keyframe.intrinsics.width * keyframe.intrinsics.height;
    let mut bytes = Vec::with_capacity(usize::try_from(file.bytes).unwrap_or(0));
    input_file::read_into(&path, most_bytes(num_pixels) as u64, &mut bytes)
        .map_err(|error| told(&error))?;
    // A whole file of another time has a right checksum of its own.
    if checksum_of(&bytes) != file.checksum {
        return Err(told(&DepthFileError::Checksum));
    }
    decode_into(&bytes, keyframe).map_err(|error| told(&error))
}

#[cfg(test)]
mod tests;
