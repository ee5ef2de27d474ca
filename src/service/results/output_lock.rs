//! Keeps a second process from writing into the output folder of a run.

use std::fs::{self, File};
use std::io::{self, Read, Seek, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::FlockOperation;

/// Name of the lock file. Its content is the id of the process that holds it.
const LOCK: &str = ".semidense-lock";

/// The lock of a folder; the kernel ends it with the process.
#[derive(Debug)]
pub struct OutputLock {
    _file: File,
    path: PathBuf,
}

/// What came of an attempt to lock a folder.
#[derive(Debug)]
pub enum Locking {
    /// It is ours.
    Locked(OutputLock),
    /// Another process holds it: its id, where it has been written already.
    HeldBy(String),
}

impl OutputLock {
    /// Locks `folder`, which exists. Does not wait.
    pub fn take(folder: &Path) -> io::Result<Locking> {
        let path = folder.join(LOCK);
        loop {
            let mut options = File::options();
            let opened = options.read(true).write(true).create(true).truncate(false).open(&path);
            let mut file = opened?;
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => {}
                Err(rustix::io::Errno::WOULDBLOCK) => {
                    let mut holder = String::new();
                    file.read_to_string(&mut holder)?;
                    return Ok(Locking::HeldBy(holder.trim().to_owned()));
                }
                Err(error) => return Err(error.into()),
            }
            // The one before may have removed the file between our opening and our lock.
            if is_same_file(&file, &path) {
                file.set_len(0)?;
                file.rewind()?;
                writeln!(file, "{}", std::process::id())?;
                return Ok(Locking::Locked(Self { _file: file, path }));
            }
        }
    }
}

impl Drop for OutputLock {
    fn drop(&mut self) {
        // While it is still locked. A file that cannot be removed locks nobody out.
        drop(fs::remove_file(&self.path));
    }
}

fn is_same_file(file: &File, path: &Path) -> bool {
    let id = |metadata: &fs::Metadata| (metadata.dev(), metadata.ino());
    matches!((file.metadata(), fs::metadata(path)), (Ok(a), Ok(b)) if id(&a) == id(&b))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_locked_once_and_nothing_remains() {
        let folder = tempfile::tempdir().unwrap();
        // As a killed process leaves it.
        fs::write(folder.path().join(LOCK), "4194304\nand more").unwrap();
        let Locking::Locked(lock) = OutputLock::take(folder.path()).unwrap() else {
            panic!("nobody holds it")
        };
        let Locking::HeldBy(holder) = OutputLock::take(folder.path()).unwrap() else {
            panic!("locked twice")
        };
        assert_eq!(holder, std::process::id().to_string());
        drop(lock);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        assert!(matches!(OutputLock::take(folder.path()).unwrap(), Locking::Locked(_)));
    }

    #[test]
    fn of_many_at_once_one_has_it() {
        let folder = tempfile::tempdir().unwrap();
        let inside = std::sync::atomic::AtomicU32::new(0);
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..200 {
                        let Ok(Locking::Locked(lock)) = OutputLock::take(folder.path()) else {
                            continue;
                        };
                        let before = inside.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
                        assert_eq!(before, 0);
                        inside.fetch_sub(1, std::sync::atomic::Ordering::SeqCst);
                        drop(lock);
                    }
                });
            }
        });
    }
}
