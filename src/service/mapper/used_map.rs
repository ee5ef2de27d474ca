//! The map on disk that a mapper uses, noted for its successor if it dies: a checkpoint belongs to that map, and a
//! running mapper may have switched to another one than it was started with.

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::capture::input_file;
use crate::service::atomic_file::write_privately;
use crate::service::checkpoint::Kept;
use crate::service::config::MapConfig;
use crate::service::map_folder::numbering::Numbering;
use crate::service::results::record::LoadedMap;
use crate::slam::map::Map;
use crate::wire::place::Place;

/// Largest file, bytes: two paths of maximal length, every byte of them escaped.
const MAX_BYTES: u64 = 1 << 16;

/// The map on disk that a mapper uses.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct UsedMap {
    /// The folder that the mapper was started with; empty without one.
    pub(super) configured: String,
    /// The map that it has switched to.
    pub(super) switched_to: Option<MapConfig>,
    /// The map's numbers in this run.
    pub(super) numbering: Numbering,
    /// First id of a keyframe made in the map that it has switched to.
    #[serde(default)]
    pub(super) first_keyframe_id: u64,
}

/// The map that the mapper of a run has switched to; `None` where it stayed in its own.
pub(crate) fn loaded_map(place: &Place) -> Option<LoadedMap> {
    let used = UsedMap::read(&place.loaded_map_path()).ok()??;
    let MapConfig { folder, read_only, .. } = used.switched_to?;
    let (first_epoch, first_keyframe_id) = (used.numbering.epochs, used.first_keyframe_id);
    Some(LoadedMap { folder, read_only, first_epoch, first_keyframe_id })
}

/// Opens the checkpoint of a live mapper, and reads what a dead one left: a map that it made in another folder than the
/// configured one is left out, but for the numbers it assigned, which the tracker may still hold.
pub(super) fn open_checkpoint(
    place: &Place,
    configured: &MapConfig,
) -> (Option<Kept>, Option<Map>, UsedMap) {
    let (path, note) = (place.checkpoint_path(), place.loaded_map_path());
    let (mut kept, mut left) = Kept::open(&path);
    let mut used = UsedMap::of(configured);
    let other = match UsedMap::read(&note) {
        Ok(None) => None,
        Ok(Some(before)) if before.configured == configured.folder => {
            used = before;
            None
        }
        Ok(Some(before)) => Some(started_otherwise(&before.configured, &configured.folder)),
        // It may be that of a mapper with any map.
        Err(error) => Some(format!("{}: {error}", note.display())),
    };
    if let Some(other) = other {
        if let Some(map) = &left {
            tracing::warn!("{other}: what the mapper before this one left is not continued");
            used.numbering = Numbering::above_map(map);
        }
        if let Some(mut old) = kept.take() {
            old.remove_on_drop();
            drop(old);
            kept = Kept::open(&path).0;
        }
        // In a map on disk the numbering continues them.
        left = left.filter(|_| configured.folder.is_empty()).map(|map| numbers_of(&map));
    }
    if let Err(error) = used.write(&note) {
        tracing::warn!("{}: {error}; a restarted mapper uses the configured map", note.display());
    }
    (kept, left, used)
}

fn started_otherwise(before: &str, now: &str) -> String {
    let name = |folder: &str| match folder {
        "" => "without a map".to_owned(),
        folder => format!("with the map {folder}"),
    };
    format!("the mapper before this one was started {}, this one {}", name(before), name(now))
}

/// A map without depth: only its numbers can be continued.
fn numbers_of(map: &Map) -> Map {
    Map {
        keyframes: map.keyframes.iter().map(|keyframe| keyframe.without_depth()).collect(),
        free_epoch: map.free_epoch,
        ..Map::default()
    }
}

impl UsedMap {
    /// The map that a mapper is started with.
    pub(super) fn of(configured: &MapConfig) -> Self {
        Self { configured: configured.folder.clone(), ..Self::default() }
    }

    /// Reads what the previous mapper noted at `path`; `None` where it noted nothing.
    fn read(path: &Path) -> io::Result<Option<Self>> {
        let mut bytes = Vec::new();
        match input_file::read_into(path, MAX_BYTES, &mut bytes) {
            Ok(()) => Ok(Some(serde_json::from_slice(&bytes)?)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Writes it to `path`.
    pub(super) fn write(&self, path: &Path) -> io::Result<()> {
        let bytes = serde_json::to_vec(self)?;
        write_privately(path, |file| file.write_all(&bytes))
    }

    /// Removes it: no mapper is to continue from there.
    pub(super) fn forget(path: &Path) {
        // A missing file need not be removed.
        drop(fs::remove_file(path));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::{DepthPoint, Keyframe};

    fn config(folder: &str) -> MapConfig {
        MapConfig { folder: folder.to_owned(), ..MapConfig::default() }
    }

    /// What a killed mapper left that was started with the map `/a` and had switched to `/b`.
    fn left(place: &Place) -> UsedMap {
        let numbering = Numbering { ids: 3, epochs: 2, revisions: 1 };
        let switched_to = Some(config("/b"));
        let used =
            UsedMap { switched_to, numbering, first_keyframe_id: 6, ..UsedMap::of(&config("/a")) };
        used.write(&place.loaded_map_path()).unwrap();
        let point = DepthPoint { u: 9, v: 9, inverse_depth: 1.0, variance: 0.1, intensity: 9.0 };
        let camera = Intrinsics::pinhole(17, 16, 20.0);
        let at = Keyframe::at(Sim3::identity(), camera, vec![point; 3], vec![9; 17 * 16]);
        let keyframes = vec![Keyframe { keyframe_id: 7, revision: 40, ..at }];
        let map = Map { keyframes, active: Some(7), free_epoch: 5, ..Map::default() };
        crate::service::map_file::write_map(&place.checkpoint_path(), &map, &mut || {}).unwrap();
        used
    }

    #[test]
    fn the_map_that_a_run_has_switched_to_is_told_from_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        assert_eq!(loaded_map(&place), None);
        UsedMap::of(&config("/a")).write(&place.loaded_map_path()).unwrap();
        assert_eq!(loaded_map(&place), None);
        left(&place);
        let folder = "/b".to_owned();
        let loaded = LoadedMap { folder, read_only: false, first_epoch: 2, first_keyframe_id: 6 };
        assert_eq!(loaded_map(&place), Some(loaded));
    }

    #[test]
    fn a_successor_with_the_same_map_continues_and_switches_too() {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let used = left(&place);
        let (kept, map, continued) = open_checkpoint(&place, &config("/a"));
        assert!(kept.is_some() && map.is_some_and(|map| map.keyframes[0].has_depth()));
        assert_eq!(continued, used);
        UsedMap::forget(&place.loaded_map_path());
        assert_eq!(open_checkpoint(&place, &config("/a")).2, UsedMap::of(&config("/a")));
    }

    #[test]
    fn a_successor_with_another_map_continues_only_the_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        left(&place);
        let (kept, map, used) = open_checkpoint(&place, &config("/c"));
        assert!(kept.is_some() && map.is_none(), "nothing enters the map on disk");
        assert!(!place.checkpoint_path().exists());
        assert_eq!((used.configured.as_str(), &used.switched_to), ("/c", &None));
        let Numbering { ids, epochs, .. } = used.numbering;
        assert!(ids > 7 && epochs == 5, "{ids}, {epochs}");
        assert_eq!(open_checkpoint(&place, &config("/c")).2, used, "its own successor");
        left(&place);
        let (_, map, _) = open_checkpoint(&place, &config(""));
        let map = map.unwrap();
        assert_eq!((map.free_epoch, map.keyframes[0].keyframe_id), (5, 7));
        assert!(!map.keyframes[0].has_depth());
    }

    #[test]
    fn with_a_damaged_note_only_the_numbers_continue() {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        left(&place);
        fs::write(place.loaded_map_path(), "{}").unwrap();
        let (_, map, used) = open_checkpoint(&place, &config("/a"));
        assert!(map.is_none() && used.numbering.ids > 7);
    }
}
