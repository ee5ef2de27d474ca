//! Files that one process holds at a time.

use std::fs::{self, File};
use std::io::{self, Read, Seek, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Instant;

use rustix::fs::FlockOperation;
use rustix::io::Errno;
use rustix::thread::Timespec;

/// Permissions of a file that is the user's alone.
pub(in crate::wire) const USER_ALONE: u32 = 0o600;

/// The lock on a file whose content is the id of the process that holds it. The kernel ends it with the process.
#[derive(Debug)]
pub struct LockFile {
    _file: File,
    path: PathBuf,
}

/// What came of an attempt to lock.
#[derive(Debug)]
pub enum Locking {
    /// It is ours.
    Locked(LockFile),
    /// Another process holds it: its id, where it has been written already.
    HeldBy(String),
}

impl LockFile {
    /// Locks the file of this name, which is made with the permissions `mode`. Does not wait.
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
            // The one before may have removed the file between our opening and our lock.
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
        // While it is still locked, so that no other process can hold the same name. A file that cannot be removed
        // locks nobody out.
        drop(fs::remove_file(&self.path));
    }
}

/// Opens and locks the file that has this name in the end: whoever held it before may have removed it, and others
/// lock the new one. `None` if that is not possible in time.
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

/// Tries to lock until `end`; whether it is locked.
pub(in crate::wire) fn lock_until(file: &File, operation: FlockOperation, end: Instant) -> bool {
    /// Between two attempts.
    const PAUSE: Timespec = Timespec { tv_sec: 0, tv_nsec: 2_000_000 };
    loop {
        if rustix::fs::flock(file, operation).is_ok() {
            return true;
        }
        if Instant::now() >= end {
            return false;
        }
        // Interrupted or not, the end decides.
        drop(rustix::thread::nanosleep(&PAUSE));
    }
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
