//! Writes a map folder: changed keyframes first, then the manifest that lists them.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use crate::service::atomic_file::write_durably;
use crate::service::map_folder::depth_file::{MapDetail, checksum_of, encode};
use crate::service::map_folder::manifest::{DepthFile, Listed, Manifest};
use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::service::map_folder::reading::{
    BEFORE, KEYFRAMES, MANIFEST, read_manifest, refuse_file,
};
use crate::service::results::output_lock::lock_output;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;
use crate::wire::lock_file::{LockFile, Locking};

/// The part of a map that its manifest holds: keyframes without image and points, loops, and numbers.
pub fn head_of(map: &Map, free_epoch: u32) -> Map {
    Map {
        keyframes: map.keyframes.iter().map(Keyframe::without_depth).collect(),
        loops: map.loops.clone(),
        revision: map.revision,
        free_epoch,
        ..Map::default()
    }
}

/// A map folder that only this process writes.
#[derive(Debug)]
pub struct MapWriter {
    folder: PathBuf,
    /// The manifest saved last; `None` where nothing has been saved.
    manifest: Option<Manifest>,
    /// Its bytes.
    manifest_bytes: Vec<u8>,
    detail: MapDetail,
    /// Keyframe files that the next manifest lists, by id.
    files: BTreeMap<u64, DepthFile>,
    /// Names of the existing files.
    names: BTreeSet<String>,
    _lock: LockFile,
}

impl MapWriter {
    /// Claims a folder for this process: one that holds a map, is empty, or does not exist yet. An existing map keeps
    /// its detail.
    pub fn open(folder: &Path, detail: MapDetail) -> Result<Self, MapFolderError> {
        let failed = |source| MapFolderError::Write { path: folder.to_owned(), source };
        refuse_file(folder)?;
        fs::create_dir_all(folder).map_err(failed)?;
        let read = || match read_manifest(folder) {
            Ok((manifest, _)) => Ok(Some(manifest)),
            Err(MapFolderError::Missing(_)) if is_free(folder).map_err(failed)? => Ok(None),
            Err(MapFolderError::Missing(_)) => Err(MapFolderError::Foreign(folder.to_owned())),
            Err(error) => Err(error),
        };
        // Someone else's folder gets no file.
        drop(read()?);
        let lock = match lock_output(folder).map_err(failed)? {
            Locking::Locked(lock) => lock,
            Locking::HeldBy(holder) => {
                let by = if holder.is_empty() { holder } else { format!(" ({holder})") };
                return Err(MapFolderError::Held { folder: folder.to_owned(), by });
            }
        };
        // The process that held the folder until now may have saved a last time.
        let manifest = read()?;
        fs::create_dir_all(folder.join(KEYFRAMES)).map_err(failed)?;
        let mut writer = Self {
            folder: folder.to_owned(),
            manifest_bytes: manifest.as_ref().map(Manifest::to_bytes).unwrap_or_default(),
            detail: manifest.as_ref().map_or(detail, |manifest| manifest.detail),
            files: BTreeMap::new(),
            names: BTreeSet::new(),
            manifest,
            _lock: lock,
        };
        writer.tidy().map_err(failed)?;
        Ok(writer)
    }

    /// Removes what a killed process left, and lists the existing files.
    fn tidy(&mut self) -> io::Result<()> {
        let is_unfinished = |name: &str| name.starts_with('.') && name.ends_with(".tmp");
        for entry in fs::read_dir(&self.folder)?.flatten() {
            if is_unfinished(&entry.file_name().to_string_lossy()) {
                drop(fs::remove_file(entry.path()));
            }
        }
        let manifests = self.manifest.iter().flat_map(|manifest| &manifest.keyframes);
        let files = manifests.filter_map(|of| Some((of.keyframe.keyframe_id, of.file?)));
        self.files = files.collect();
        for entry in fs::read_dir(self.folder.join(KEYFRAMES))?.flatten() {
            self.names.insert(entry.file_name().to_string_lossy().into_owned());
        }
        Ok(())
    }

    /// The camera of the existing map.
    pub fn camera(&self) -> Option<&Intrinsics> {
        self.manifest.as_ref().map(|manifest| &manifest.camera)
    }

    /// Writes image and depth of a keyframe, unless they are unchanged on disk. They enter the map with the next
    /// [`Self::save`].
    pub fn put(&mut self, keyframe: &Keyframe) -> Result<(), MapFolderError> {
        let bytes = encode(keyframe, self.detail);
        let file = DepthFile {
            revision: keyframe.revision,
            bytes: bytes.len() as u64,
            checksum: checksum_of(&bytes),
            num_points: keyframe.points.len() as u32,
        };
        // A new revision may change only the pose.
        let is_same =
            |known: &DepthFile| (known.bytes, known.checksum) == (file.bytes, file.checksum);
        if self.files.get(&keyframe.keyframe_id).is_some_and(is_same) {
            return Ok(());
        }
        let name = file.name(keyframe.keyframe_id);
        let path = self.folder.join(KEYFRAMES).join(&name);
        write_durably(&path, |to| to.write_all(&bytes))
            .map_err(|source| MapFolderError::Write { path, source })?;
        self.names.insert(name);
        self.files.insert(keyframe.keyframe_id, file);
        Ok(())
    }

    /// Writes the manifest with a [`head_of`] a map, which makes this the map. Keyframes of another camera, those that
    /// contradicted themselves and those whose depth was never written are left out.
    pub fn save(&mut self, camera: &Intrinsics, head: Map) -> Result<(), MapFolderError> {
        let is_kept = |keyframe: &Keyframe| {
            keyframe.intrinsics == *camera && keyframe.map_state == MapState::Established
        };
        let keyframes = head.keyframes.into_iter().filter(is_kept).filter_map(|keyframe| {
            let file = Some(*self.files.get(&keyframe.keyframe_id)?);
            Some(Listed { keyframe, file })
        });
        let since = SystemTime::now().duration_since(UNIX_EPOCH);
        let saves = self.manifest.as_ref().map_or(0, |before| before.saves);
        let manifest = Manifest {
            free_epoch: head.free_epoch,
            loops: head.loops,
            revision: head.revision,
            saves: saves.saturating_add(1),
            saved_secs: since.map_or(0, |since| since.as_secs()),
            keyframes: keyframes.collect(),
            ..Manifest::new(*camera, self.detail)
        };
        let bytes = manifest.to_bytes();
        self.write(BEFORE, &self.manifest_bytes)?;
        self.write(MANIFEST, &bytes)?;
        let before = self.manifest.replace(manifest);
        self.manifest_bytes = bytes;
        self.remove_unlisted(before.as_ref());
        Ok(())
    }

    /// At the end: overwrites the previous manifest with this one, so that changed keyframes have one file each.
    pub fn settle(&mut self) -> Result<(), MapFolderError> {
        self.write(BEFORE, &self.manifest_bytes)?;
        self.remove_unlisted(None);
        Ok(())
    }

    /// Writes a manifest, unless it is empty.
    fn write(&self, name: &str, bytes: &[u8]) -> Result<(), MapFolderError> {
        if bytes.is_empty() {
            return Ok(());
        }
        let path = self.folder.join(name);
        write_durably(&path, |to| to.write_all(bytes))
            .map_err(|source| MapFolderError::Write { path, source })
    }

    /// Removes the files that neither this manifest nor the previous one lists.
    fn remove_unlisted(&mut self, before: Option<&Manifest>) {
        let manifests = self.manifest.iter().chain(before);
        let listed: BTreeSet<String> = manifests.flat_map(Manifest::file_names).collect();
        let folder = self.folder.join(KEYFRAMES);
        // A file that cannot be removed is left to the next process that tidies up.
        self.names
            .retain(|name| listed.contains(name) || fs::remove_file(folder.join(name)).is_err());
        let in_map = self.manifest.iter().flat_map(|manifest| &manifest.keyframes);
        let ids: BTreeSet<u64> = in_map.map(|listed| listed.keyframe.keyframe_id).collect();
        self.files.retain(|id, _| ids.contains(id));
    }
}

/// Whether a folder holds nothing but what a process killed before its first save may have left.
fn is_free(folder: &Path) -> io::Result<bool> {
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        if name != KEYFRAMES && !name.starts_with('.') {
            return Ok(false);
        }
    }
    Ok(true)
}
