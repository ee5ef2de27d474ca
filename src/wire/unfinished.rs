//! What a process was making when it was killed. iceoryx2 0.10 waits until it is finished: for a segment without a size
//! for ever, in every process that joins, cleans up or leaves.

use std::collections::BTreeSet;
use std::fs::{self, Metadata};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::thread::{Timespec, nanosleep};

use crate::wire::folders::SHARED_MEMORY;
use crate::wire::place::Place;
use crate::wire::root_folder::is_mine;

/// A living process finishes a file within microseconds, on a busy machine within some tens of milliseconds.
const LONGEST_MAKING: Duration = Duration::from_millis(500);
/// Time between two looks at unfinished files.
const PAUSE: Timespec = Timespec { tv_sec: 0, tv_nsec: 10_000_000 };
/// Permission of the owner to write: a finished description of a service has it no longer, and what is being made about
/// the process of a node has no other.
pub(in crate::wire) const OWNER_MAY_WRITE: u32 = 0o200;

impl Place {
    /// Removes segments without a size and unfinished descriptions of services; waits for those that a living process
    /// is making. Takes microseconds where there are none.
    pub(in crate::wire) fn remove_unfinished(&self) {
        let (mut unfinished, end) = (self.unfinished_files(), Instant::now() + LONGEST_MAKING);
        while !unfinished.is_empty() && Instant::now() < end {
            drop(nanosleep(&PAUSE));
            let still = self.unfinished_files();
            unfinished.retain(|path| still.contains(path));
        }
        // What cannot be removed is another user's, and stays as it was.
        unfinished.iter().for_each(|path| drop(fs::remove_file(path)));
    }

    fn unfinished_files(&self) -> BTreeSet<PathBuf> {
        let segments = self.transport_files(Path::new(SHARED_MEMORY), "");
        let segments = segments.filter(|path| is_ours(path, |found| found.len() == 0));
        let folder = self.root.join("services");
        let services = self.transport_files(&folder, ".service");
        let is_written = |found: &Metadata| found.mode() & OWNER_MAY_WRITE != 0;
        segments.chain(services.filter(|path| is_ours(path, is_written))).collect()
    }
}

/// Whether a path is a file of this user in the given state.
pub(in crate::wire) fn is_ours(path: &Path, is_in_state: impl Fn(&Metadata) -> bool) -> bool {
    let found = fs::symlink_metadata(path);
    found.is_ok_and(|found| found.is_file() && is_mine(&found) && is_in_state(&found))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{File, Permissions};
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn only_what_no_process_finishes_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let services = folder.path().join("services");
        fs::create_dir(&services).unwrap();
        let segment = |name: &str, bytes: u64| {
            let path = Path::new(SHARED_MEMORY).join(format!("{}{name}", place.prefix));
            File::create(&path).unwrap().set_len(bytes).unwrap();
            path
        };
        let service = |name: &str, mode: u32| {
            let path = services.join(format!("{}{name}.service", place.prefix));
            fs::write(&path, "x").unwrap();
            fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
            path
        };
        let finished = [segment("a.dynamic", 8), service("a", 0o400)];
        place.remove_unfinished();
        let abandoned = [segment("b.dynamic", 0), service("b", 0o600)];
        let late = segment("c.dynamic", 0);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let finish = || {
            (0..5).for_each(|_| drop(nanosleep(&PAUSE)));
            File::options().write(true).open(&late).unwrap().set_len(8).unwrap();
        };
        pool.join(|| place.remove_unfinished(), finish);
        assert!(abandoned.iter().all(|path| !path.exists()), "{abandoned:?}");
        let kept = finished.iter().chain([&late]).all(|path| path.exists());
        place.tidy();
        assert!(kept && !late.exists());
    }
}
