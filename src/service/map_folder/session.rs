//! A process's use of a map folder: read at its start, kept while it maps, complete at its end.

use std::path::{Path, PathBuf};

use crate::service::config::MapConfig;
use crate::service::map_folder::keeper::MapSaver;
use crate::service::map_folder::map_folder_error::{MapFolderError, check_same_camera};
use crate::service::map_folder::numbering::Numbering;
use crate::service::map_folder::reading::{Loaded, load, read_manifest};
use crate::service::map_folder::writer::MapWriter;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::map::Map;
use crate::slam::mapper::prior::{MapUse, PriorError};
use crate::slam::mapper::{Mapper, StepOutcome};

/// Why a process cannot use a map.
#[derive(Debug, thiserror::Error)]
pub enum MapSessionError {
    /// The folder cannot be read or written.
    #[error(transparent)]
    Folder(#[from] MapFolderError),
    /// A mapper cannot begin in the map.
    #[error("{folder}: {source}")]
    Prior {
        /// The map.
        folder: PathBuf,
        /// The cause.
        source: PriorError,
    },
    /// The thread cannot be started.
    #[error("cannot start the thread that saves the map ({0})")]
    Thread(std::io::Error),
}

/// A map in use.
#[derive(Debug)]
pub struct MapSession {
    folder: PathBuf,
    map_use: MapUse,
    /// Held until the camera is known.
    loaded: Option<Map>,
    camera: Option<Intrinsics>,
    writer: Option<MapWriter>,
    keeper: Option<MapSaver>,
    numbering: Numbering,
    waits: bool,
}

impl MapSession {
    /// Reads the map that the configuration names, with the threads of the pool it is called in; `None` where it names
    /// none. Damage is logged. `waits`: frames may wait for the disk. The run's numbers differ from the disk's where it
    /// had a map before.
    pub fn open(
        config: &MapConfig,
        max_bytes: usize,
        numbering: Numbering,
        waits: bool,
    ) -> Result<Option<Self>, MapFolderError> {
        if config.folder.is_empty() {
            return Ok(None);
        }
        let folder = PathBuf::from(&config.folder);
        let map_use = if config.read_only { MapUse::Locate } else { MapUse::Extend };
        let writer = match map_use {
            MapUse::Extend => Some(MapWriter::open(&folder, config.detail)?),
            MapUse::Locate => None,
        };
        let loaded = match &writer {
            Some(writer) if writer.camera().is_none() => None,
            _ => Some(load(&folder, max_bytes)?),
        };
        loaded.iter().for_each(|loaded| warn_about_damage(loaded, max_bytes));
        let camera = loaded.as_ref().map(|loaded| loaded.manifest.camera);
        let loaded = loaded.map(|loaded| numbering.in_run(loaded.map));
        let keeper = None;
        Ok(Some(Self { folder, map_use, loaded, camera, writer, keeper, numbering, waits }))
    }

    /// Lets a mapper of `camera` begin in the map, before its first frame; where a dead mapper has `left` a checkpoint
    /// and the map continues, the mapper continues from that.
    pub fn begin(
        &mut self,
        mapper: &mut Mapper,
        camera: &Intrinsics,
        left: Option<Map>,
    ) -> Result<StepOutcome, MapSessionError> {
        if let Some(map) = &self.camera {
            check_same_camera(&self.folder, map, camera)?;
        }
        let map = self.loaded.take().unwrap_or_default();
        if let Some(writer) = self.writer.take() {
            let keeper = MapSaver::start(writer, *camera, &map, self.numbering, self.waits)
                .map_err(MapSessionError::Thread)?;
            self.keeper = Some(keeper);
        }
        let can_continue = |left: &Map| left.keyframes.iter().any(|of| of.intrinsics == *camera);
        let continues = self.map_use == MapUse::Extend && left.as_ref().is_some_and(can_continue);
        match left {
            Some(left) if continues => Ok(mapper.resume(left.merged_over(map))),
            left => {
                let folder = self.folder.clone();
                mapper
                    .start_in_map(map, self.map_use)
                    .map_err(|source| MapSessionError::Prior { folder, source })?;
                left.iter().for_each(|left| mapper.skip_numbers_after(left));
                Ok(StepOutcome::default())
            }
        }
    }

    /// Whether it is the map in `folder`; an empty path matches any map.
    pub fn is_in(&self, folder: &Path) -> bool {
        let same = || Some(folder.canonicalize().ok()? == self.folder.canonicalize().ok()?);
        folder.as_os_str().is_empty() || same().unwrap_or(false)
    }

    /// Whether nothing is written into it.
    pub fn is_read_only(&self) -> bool {
        self.map_use == MapUse::Locate
    }

    /// Keeps what a step or a correction changed.
    pub fn follow(&mut self, mapper: &Mapper, outcome: &StepOutcome) {
        self.keeper.iter_mut().for_each(|keeper| keeper.follow(mapper, outcome));
    }

    /// Writes everything that is not on disk yet, before it returns; nothing where the map is not kept. Calls `each`
    /// before each keyframe.
    pub fn save_all(
        &mut self,
        mapper: &Mapper,
        each: &mut dyn FnMut(),
    ) -> Result<(), MapSessionError> {
        let Some(keeper) = &mut self.keeper else { return Ok(()) };
        Ok(keeper.save_all(mapper, each)?)
    }

    /// Takes the reason why the last save failed.
    pub fn take_failure(&mut self) -> Option<String> {
        self.keeper.as_mut()?.take_failure()
    }
}

/// Checks, before anything is started, that a map can be read or begun.
pub fn check(config: &MapConfig) -> Result<(), MapFolderError> {
    if config.folder.is_empty() {
        return Ok(());
    }
    let folder = PathBuf::from(&config.folder);
    match config.read_only {
        true => read_manifest(&folder).map(drop),
        false => MapWriter::open(&folder, config.detail).map(drop),
    }
}

/// Checks, before anything is started, that an existing map is of this camera.
pub fn check_camera(config: &MapConfig, camera: &Intrinsics) -> Result<(), MapFolderError> {
    if config.folder.is_empty() {
        return Ok(());
    }
    match check_loadable(Path::new(&config.folder), camera) {
        // It is to be begun, or an earlier check has refused it.
        Err(MapFolderError::Missing(_)) => Ok(()),
        checked => checked,
    }
}

/// First id of a keyframe of a run that begins now: above those of earlier runs in its map.
pub fn first_own_id(config: &MapConfig) -> u64 {
    let manifest = (!config.folder.is_empty()).then(|| read_manifest(Path::new(&config.folder)));
    let Some(Ok((manifest, _))) = manifest else { return 0 };
    let ids = manifest.keyframes.iter().map(|listed| listed.keyframe.keyframe_id);
    ids.max().map_or(0, |newest| newest.saturating_add(1))
}

/// Checks that a folder holds a map of this camera that a running mapper could switch to.
pub fn check_loadable(folder: &Path, camera: &Intrinsics) -> Result<(), MapFolderError> {
    let (manifest, _) = read_manifest(folder)?;
    check_same_camera(folder, &manifest.camera, camera)
}

fn warn_about_damage(loaded: &Loaded, max_bytes: usize) {
    const MEGABYTE: usize = 1_000_000;
    loaded.problems.iter().for_each(|problem| tracing::warn!("{problem}"));
    if loaded.without_memory > 0 {
        tracing::warn!(
            "{} of {} keyframes of the map are left without depth, so that the others take at most {} MB: raise \
             mapping.max_map_megabytes to relocalise against them too",
            loaded.without_memory,
            loaded.map.keyframes.len(),
            max_bytes / MEGABYTE
        );
    }
}
