//! Shared memory: how much is free, and reserving what segments have promised.

use std::fs::{self, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::{Access, FallocateFlags, OFlags};

use crate::wire::folders::SHARED_MEMORY;
use crate::wire::limits::check_address_space;
use crate::wire::place::Place;
use crate::wire::place_error::PlaceError;
use crate::wire::root_folder::is_mine;

impl Place {
    /// Checks that `needed` bytes of shared memory are free, and that the address space has room for them: running out
    /// later is not an error but the death of the process.
    pub fn check_shared_memory(&self, needed: u64) -> Result<(), PlaceError> {
        check_address_space(needed)?;
        let none = |cause| PlaceError::NoSharedMemory(io::Error::from(cause));
        rustix::fs::access(SHARED_MEMORY, Access::WRITE_OK | Access::EXEC_OK).map_err(none)?;
        let free = free_shared_memory().map_err(none)?;
        if free >= needed {
            return Ok(());
        }
        Err(PlaceError::SharedMemory { free_mb: free >> 20, needed_mb: (needed >> 20) + 1 })
    }
}

/// Free shared memory, bytes.
pub fn free_shared_memory() -> rustix::io::Result<u64> {
    let stat = rustix::fs::statvfs(SHARED_MEMORY)?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Reserves the memory that segments in `folder` with names that begin with `prefix` have promised but not allocated:
/// they are created sparse, and touching a page that cannot be allocated kills the process (SIGBUS). Takes milliseconds
/// for new segments, a fraction of one if all is reserved.
pub(in crate::wire) fn reserve(folder: &Path, prefix: &str) -> Result<(), PlaceError> {
    /// Unit of `st_blocks`.
    const BLOCK_BYTES: u64 = 512;
    let (mut needed, mut missing) = (0, 0);
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        if !entry.file_name().to_string_lossy().starts_with(prefix) {
            continue;
        }
        // Segments appear and disappear: one that is gone needs nothing. Any user may create a file of such a name.
        let Ok(found) = entry.metadata() else { continue };
        if !found.is_file() || !is_mine(&found) {
            continue;
        }
        let lacks = found.len().saturating_sub(found.blocks().saturating_mul(BLOCK_BYTES));
        if lacks == 0 {
            continue;
        }
        // Write only: a segment that is being created may be open for nothing else.
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let open = OpenOptions::new().write(true).custom_flags(flags).open(entry.path());
        let Some(file) = open.ok().filter(|file| file.metadata().is_ok_and(|m| m.is_file())) else {
            continue;
        };
        needed += lacks;
        let taken = rustix::fs::fallocate(&file, FallocateFlags::KEEP_SIZE, 0, found.len());
        // A file system that cannot reserve leaves the segment unchanged.
        if taken == Err(rustix::io::Errno::NOSPC) {
            missing += lacks;
        }
    }
    match missing {
        0 => Ok(()),
        _ => Err(PlaceError::Reservation {
            missing_kb: missing.div_ceil(1 << 10),
            needed_kb: needed.div_ceil(1 << 10),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    #[test]
    fn memory_promised_by_segments_is_reserved() {
        // The kernel's own tmpfs, under names that none of our processes has.
        let prefix = format!("semidense-reserve-test-{}-", std::process::id());
        let segment = Path::new(SHARED_MEMORY).join(format!("{prefix}x"));
        let foreign = Path::new(SHARED_MEMORY).join(format!("x{prefix}"));
        for path in [&segment, &foreign] {
            File::create(path).unwrap().set_len(1 << 20).unwrap();
        }
        reserve(Path::new(SHARED_MEMORY), &prefix).unwrap();
        let bytes = |path: &Path| 512 * fs::metadata(path).unwrap().blocks();
        let (taken, left) = (bytes(&segment), bytes(&foreign));
        let length = fs::metadata(&segment).unwrap().len();
        [segment, foreign].iter().for_each(|path| fs::remove_file(path).unwrap());
        assert_eq!((taken, left, length), (1 << 20, 0, 1 << 20));
    }

    #[test]
    fn a_pipe_with_the_name_of_a_segment_is_skipped() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = std::ffi::CString::new(folder.path().join("x_pipe").to_str().unwrap()).unwrap();
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::from(0o600)).unwrap();
        std::os::unix::fs::symlink("/dev/zero", folder.path().join("x_link")).unwrap();
        reserve(folder.path(), "x_").unwrap();
    }

    #[test]
    fn too_little_shared_memory_is_an_error() {
        let place = Place::new("rig", "/tmp/x").unwrap();
        assert!(place.check_shared_memory(0).is_ok());
        let error = place.check_shared_memory(u64::MAX).unwrap_err().to_string();
        assert!(error.starts_with("/dev/shm has"), "{error}");
    }
}
