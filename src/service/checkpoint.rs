//! The mapper's checkpoint: what it needs to go on after its death, in the runtime folder. Written by a
//! thread of its own, so that no frame waits for a file.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use crossbeam::queue::ArrayQueue;

use crate::service::atomic_file::write_privately;
use crate::service::map_file::{MapFileError, read_map, write_map_into};
use crate::slam::mapper::Map;

/// Writes the newest checkpoint. The file stays unless the process ends in order.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    is_over: bool,
}

#[derive(Debug)]
struct Shared {
    newest: ArrayQueue<Map>,
    stop: AtomicBool,
}

impl Checkpoint {
    /// Keeps the checkpoint in the file `path`; what a mapper before has left there stays until the first.
    pub fn keep(path: &Path) -> io::Result<Self> {
        remove_unfinished(path);
        let shared = Arc::new(Shared { newest: ArrayQueue::new(1), stop: AtomicBool::new(false) });
        let (theirs, file) = (Arc::clone(&shared), path.to_owned());
        let thread = std::thread::Builder::new()
            .name("semidense-checkpoint".to_owned())
            .spawn(move || write_until_stopped(&file, &theirs))?;
        Ok(Self { path: path.to_owned(), shared, thread: Some(thread), is_over: false })
    }

    /// Nobody needs to go on from here: the file is removed with this.
    pub fn end_in_order(&mut self) {
        self.is_over = true;
    }

    /// Writes a state before it returns, unless the disk refuses, which is said in the log; the next one may
    /// fit. Before the first [`Checkpoint::put`].
    pub fn put_now(&self, map: &Map) {
        write_or_warn(&self.path, map);
    }

    /// Hands over the newest state; one that was not written yet is older and goes.
    pub fn put(&self, map: Map) {
        drop(self.shared.newest.force_push(map));
        self.wake();
    }

    fn wake(&self) {
        self.thread.iter().for_each(|thread| thread.thread().unpark());
    }
}

impl Drop for Checkpoint {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        self.wake();
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been reported where it happened.
            drop(thread.join());
        }
        if self.is_over {
            drop(fs::remove_file(&self.path));
        }
    }
}

/// It holds images: for the user of the process alone.
fn write(path: &Path, map: &Map) -> io::Result<()> {
    write_privately(path, |file| write_map_into(file, map))
}

fn write_or_warn(path: &Path, map: &Map) {
    if let Err(error) = write(path, map) {
        tracing::warn!(
            "{}: cannot write the checkpoint ({error}); a restarted mapper would begin a new map",
            path.display()
        );
    }
}

fn write_until_stopped(path: &Path, shared: &Shared) {
    while !shared.stop.load(Ordering::Acquire) {
        match shared.newest.pop() {
            None => std::thread::park(),
            Some(map) => {
                write_or_warn(path, &map);
            }
        }
    }
}

/// Removes what mappers that were killed while they wrote have left.
fn remove_unfinished(path: &Path) {
    let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { return };
    let beginning = format!(".{}.", name.to_string_lossy());
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with(&beginning) && name.ends_with(".tmp") {
            // What cannot be removed is removed by the next.
            drop(fs::remove_file(entry.path()));
        }
    }
}

/// The checkpoint that a killed mapper left at `path`; `None` where there is none.
pub fn read_checkpoint(path: &Path) -> Result<Option<Map>, MapFileError> {
    match path.exists() {
        true => read_map(path).map(Some),
        false => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;
    use std::time::{Duration, Instant};

    fn until(mut holds: impl FnMut() -> bool) {
        let start = Instant::now();
        while !holds() {
            assert!(start.elapsed() < Duration::from_secs(60), "waited in vain");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_checkpoint_is_there_until_its_keeper_ends_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.checkpoint");
        assert!(read_checkpoint(&path).unwrap().is_none());
        let unfinished = folder.path().join(".rig.checkpoint.17.tmp");
        fs::write(&unfinished, "half").unwrap();
        let mut kept = Checkpoint::keep(&path).unwrap();
        assert!(!unfinished.exists() && !path.exists());
        kept.put_now(&Map { free_epoch: 3, ..Map::default() });
        assert_eq!(read_checkpoint(&path).unwrap().unwrap().free_epoch, 3);
        kept.put(Map { free_epoch: 7, ..Map::default() });
        until(|| read_checkpoint(&path).unwrap().unwrap().free_epoch == 7);
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        drop(kept);
        assert!(path.exists(), "a panic or an error is no end in order");
        kept = Checkpoint::keep(&path).unwrap();
        kept.end_in_order();
        drop(kept);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_broken_checkpoint_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.checkpoint");
        fs::write(&path, "semidense").unwrap();
        assert!(read_checkpoint(&path).is_err());
    }
}
