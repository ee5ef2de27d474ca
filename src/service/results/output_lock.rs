//! Keeps a second process from writing into the output folder of a run.

use std::io;
use std::path::Path;

use crate::wire::lock_file::{LockFile, Locking};

/// Name of the lock file.
const LOCK: &str = ".semidense-lock";
/// Its permissions, subject to the user's umask like those of every file of the folder.
const MODE: u32 = 0o666;

/// Locks `folder`, which must exist. Does not wait.
pub fn lock_output(folder: &Path) -> io::Result<Locking> {
    LockFile::take(&folder.join(LOCK), MODE)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_folder_is_locked_once_and_nothing_remains() {
        let folder = tempfile::tempdir().unwrap();
        // As left by a killed process.
        fs::write(folder.path().join(LOCK), "4194304\nand more").unwrap();
        let Locking::Locked(lock) = lock_output(folder.path()).unwrap() else {
            panic!("nobody holds it")
        };
        let Locking::HeldBy(holder) = lock_output(folder.path()).unwrap() else {
            panic!("locked twice")
        };
        assert_eq!(holder, std::process::id().to_string());
        drop(lock);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        assert!(matches!(lock_output(folder.path()).unwrap(), Locking::Locked(_)));
    }

    #[test]
    fn only_one_of_many_at_once_holds_it() {
        let folder = tempfile::tempdir().unwrap();
        let inside = std::sync::atomic::AtomicU32::new(0);
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..200 {
                        let Ok(Locking::Locked(lock)) = lock_output(folder.path()) else {
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
