//! Reads a map folder: the manifest, and the files it lists.

use std::io;
use std::path::Path;

use rayon::prelude::*;

use crate::capture::input_file;
use crate::service::map_folder::depth_file::{
    DepthFileError, checksum_of, decode_into, max_file_bytes,
};
use crate::service::map_folder::manifest::{DepthFile, Listed, Manifest, ManifestError};
use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::slam::map::Map;

/// Names in the folder.
pub(super) const MANIFEST: &str = "manifest";
pub(super) const BEFORE: &str = "manifest.before";
pub(super) const KEYFRAMES: &str = "keyframes";
/// Largest manifest, bytes; that of the most keyframes has 80 MB.
const MAX_MANIFEST_BYTES: u64 = 128 << 20;
/// How often a map is read in all if its files are replaced meanwhile.
const MAX_READS: usize = 3;

/// A map as read from its folder.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// The manifest of the folder.
    pub manifest: Manifest,
    /// The map. Keyframes beyond the memory limit have only their poses.
    pub map: Map,
    /// Keyframes left without depth for want of memory.
    pub without_memory: usize,
    /// Damage, one line per file.
    pub problems: Vec<String>,
}

/// Reads a map, with image and depth of the newest keyframes that take at most `max_bytes`, with the threads of the
/// pool it is called in.
pub fn load(folder: &Path, max_bytes: usize) -> Result<Loaded, MapFolderError> {
    let mut reads = 0;
    loop {
        reads += 1;
        let (manifest, mut problems) = read_manifest(folder)?;
        let (map, without_memory, files) = read_keyframes(folder, &manifest, max_bytes);
        // Another process may have saved meanwhile and removed listed files.
        let is_replaced = !files.is_empty() && read_manifest(folder)?.0 != manifest;
        if !is_replaced || reads == MAX_READS {
            problems.extend(files);
            return Ok(Loaded { manifest, map, without_memory, problems });
        }
    }
}

/// The manifest of a map, or the previous one where that is damaged, and the problems found.
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
    refuse_file(folder)?;
    // A map that a newer program wrote must not be replaced by one that an older program left next to it.
    if let MapFolderError::Manifest {
        source: ManifestError::Version(_) | ManifestError::Section(_),
        ..
    } = error
    {
        return Err(error);
    }
    match read(BEFORE) {
        Ok(manifest) => Ok((manifest, vec![format!("{error}; using the previous save")])),
        Err(before) if is_missing(&before) && is_missing(&error) => {
            Err(MapFolderError::Missing(folder.to_owned()))
        }
        Err(_) => Err(error),
    }
}

/// Refuses a path that is not a folder: the system's errors on files below it would not tell.
pub(super) fn refuse_file(folder: &Path) -> Result<(), MapFolderError> {
    match folder.metadata() {
        Ok(metadata) if !metadata.is_dir() => Err(MapFolderError::File(folder.to_owned())),
        _ => Ok(()),
    }
}

/// The keyframes of a manifest with their depth, how many are without it for want of memory, and the problems found.
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

/// Gives a keyframe the contents of its file; otherwise returns a line that names the damaged file and the fault.
fn read_depth(folder: &Path, file: &DepthFile, keyframe: &mut Keyframe) -> Result<(), String> {
    let path = folder.join(KEYFRAMES).join(file.name(keyframe.keyframe_id));
    let id = keyframe.keyframe_id;
    let told = |why: &dyn std::fmt::Display| {
        format!("{}: {why}; keyframe {id} keeps its pose and loses its depth", path.display())
    };
    let num_pixels = keyframe.intrinsics.width * keyframe.intrinsics.height;
    let mut bytes = Vec::with_capacity(usize::try_from(file.bytes).unwrap_or(0));
    input_file::read_into(&path, max_file_bytes(num_pixels) as u64, &mut bytes)
        .map_err(|error| told(&error))?;
    // An intact file of another save has a valid checksum too.
    if checksum_of(&bytes) != file.checksum {
        return Err(told(&DepthFileError::Checksum));
    }
    decode_into(&bytes, keyframe).map_err(|error| told(&error))
}
