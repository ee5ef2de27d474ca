//! The map that a running mapper has switched to, for its successor if it dies.

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::capture::input_file;
use crate::service::atomic_file::write_privately;
use crate::service::config::MapConfig;
use crate::service::map_folder::numbering::Numbering;

/// Largest file, bytes: a path of maximal length, every byte of it escaped.
const MAX_BYTES: u64 = 1 << 15;

/// A map that a mapper was not started with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SwitchedMap {
    /// The folder configured when the mapper was started: a successor started with another one stays there.
    pub(super) from: String,
    /// The map.
    pub(super) to: MapConfig,
    /// Its numbers in this run.
    pub(super) numbering: Numbering,
}

impl SwitchedMap {
    /// Reads what the previous mapper left at `path`, if it was started like this one.
    pub(super) fn read(path: &Path, configured: &MapConfig) -> Option<Self> {
        let mut bytes = Vec::new();
        match input_file::read_into(path, MAX_BYTES, &mut bytes) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => return None,
            Err(error) => {
                tracing::warn!("{}: {error}; using the configured map", path.display());
                return None;
            }
        }
        let read: Result<Self, _> = serde_json::from_slice(&bytes);
        let read = read.inspect_err(|error| {
            tracing::warn!("{}: {error}; using the configured map", path.display());
        });
        read.ok().filter(|left| left.from == configured.folder)
    }

    /// Writes it to `path`.
    pub(super) fn write(&self, path: &Path) -> io::Result<()> {
        let bytes = serde_json::to_vec(self)?;
        write_privately(path, |file| file.write_all(&bytes))
    }

    /// Removes it: no mapper is to continue from there.
    pub(super) fn forget(path: &Path) {
        // A missing file need not be removed; one of another configuration is not read.
        drop(fs::remove_file(path));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_successor_switches_too_unless_it_was_started_with_another_map() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.map");
        let config = |folder: &str| MapConfig { folder: folder.to_owned(), ..MapConfig::default() };
        assert_eq!(SwitchedMap::read(&path, &config("/a")), None);
        let numbering = Numbering { ids: 3, epochs: 2, revisions: 1 };
        let over = SwitchedMap { from: "/a".to_owned(), to: config("/b"), numbering };
        over.write(&path).unwrap();
        assert_eq!(SwitchedMap::read(&path, &config("/a")), Some(over));
        assert_eq!(SwitchedMap::read(&path, &config("/c")), None);
        fs::write(&path, "{}").unwrap();
        assert_eq!(SwitchedMap::read(&path, &config("/a")), None);
        SwitchedMap::forget(&path);
        assert!(!path.exists());
    }
}
