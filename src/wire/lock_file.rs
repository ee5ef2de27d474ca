//! Lock files, each held by one process at a time.

use std::fs::{self, File};
use std::io::{self, Read, Seek, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Instant;

use rustix::fs::FlockOperation;
use rustix::io::Errno;
use rustix::thread::Timespec;

/// Permissions of a file for its user alone.
pub(in crate::wire) const USER_ALONE: u32 = 0o600;

/// A lock on a file that contains the id of the process holding it. The kernel releases it when the process ends.
#[derive(Debug)]
pub struct LockFile {
    _file: File,
    path: PathBuf,
}

/// Outcome of an attempt to lock.
#[derive(Debug)]
pub enum Locking {
    /// This process holds the lock.
    Locked(LockFile),
    /// Another process holds it: its id, if already written.
    HeldBy(String),
}

impl LockFile {
    /// Locks the file at `path`, creating it with the permissions `mode`. Does not wait.
    pub fn take(path: &Path, mode: u32) -> io::Result<Locking> {
        loop {
            let mut file = open_lock(path, mode)?;
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => {}
                Err(Errno::WOULDBLOCK) => {
                    let mut holder = String::new();
                    file.read_to_string(&mut holder)?;
                    return Ok(Locking::HeldBy(holder.trim().to_owned()));
                }
                Err(error) => return Err(error.into()),
            }
            // The previous holder may have removed the file between our open and our lock.
            if is_same_file(&file, path) {
                file.set_len(0)?;
                file.rewind()?;
                writeln!(file, "{}", std::process::id())?;
                return Ok(Locking::Locked(Self { _file: file, path: path.to_owned() }));
            }
        }
    }
}

impl Drop for LockFile {
    fn drop(&mut self) {
        // Removed while still locked, so that no other process can hold the same name. A file that cannot be removed
        // locks no process out.
        drop(fs::remove_file(&self.path));
    }
}

/// Opens and locks the file that finally has this name: its previous holder may have removed it, and other processes
/// lock the new one. `None` if the lock is not obtained by `end`.
pub(in crate::wire) fn lock_named(
    path: &Path,
    operation: FlockOperation,
    end: Instant,
) -> io::Result<Option<File>> {
    loop {
        let file = open_lock(path, USER_ALONE)?;
        if !lock_until(&file, operation, end) {
            return Ok(None);
        }
        if is_same_file(&file, path) {
            return Ok(Some(file));
        }
    }
}

/// Tries to lock until `end`; returns whether it succeeded.
pub(in crate::wire) fn lock_until(file: &File, operation: FlockOperation, end: Instant) -> bool {
    /// Pause between two attempts.
    const PAUSE: Timespec = Timespec { tv_sec: 0, tv_nsec: 2_000_000 };
    loop {
        if rustix::fs::flock(file, operation).is_ok() {
            return true;
        }
        if Instant::now() >= end {
            return false;
        }
        // Whether the sleep was interrupted does not matter: `end` decides.
        drop(rustix::thread::nanosleep(&PAUSE));
    }
}

/// Whether a process holds a lock. One that cannot be opened counts as held.
pub(in crate::wire) fn is_held(path: &Path) -> bool {
    File::open(path).map_or(true, |file| {
        rustix::fs::flock(&file, FlockOperation::NonBlockingLockShared).is_err()
    })
}

pub(in crate::wire) fn open_lock(path: &Path, mode: u32) -> io::Result<File> {
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false).mode(mode).open(path)
}

pub(in crate::wire) fn is_same_file(file: &File, path: &Path) -> bool {
    match (file.metadata(), fs::metadata(path)) {
        (Ok(open), Ok(named)) => (open.dev(), open.ino()) == (named.dev(), named.ino()),
        _ => false,
    }
}
