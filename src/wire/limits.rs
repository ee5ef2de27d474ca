//! Limits of the process that are too low to take part in an instance, detected before they are hit.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::wire::place_error::PlaceError;

/// Files that a process of the pipeline may need open at a time: the mapper has 134; each topic with its event and each
/// further subscriber takes a few more.
const OPEN_FILES: u64 = 256;
/// Address space of a process without images: the program, its threads' stacks and arenas. A run on small images works
/// with 200 MB; with 150 MB the mapper crashes.
const ADDRESS_SPACE_BYTES: u64 = 256 << 20;
/// How many times the topics of an image are mapped or copied in one process: the mapper keeps keyframes.
const COPIES: u64 = 3;

/// Raises the limit of open files to the number needed, if the hard limit allows it.
pub fn raise_open_files() -> Result<(), PlaceError> {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current.is_none_or(|files| files >= OPEN_FILES) {
        return Ok(());
    }
    let too_few = |limit| PlaceError::OpenFiles { limit, needed: OPEN_FILES };
    if let Some(limit) = maximum.filter(|limit| *limit < OPEN_FILES) {
        return Err(too_few(limit));
    }
    let wanted = Rlimit { current: Some(OPEN_FILES), maximum };
    setrlimit(Resource::Nofile, wanted).map_err(|_| too_few(current.unwrap_or_default()))
}

/// Checks that the address space suffices for `shared_bytes` of shared memory and its copies: running out later is not
/// an error but the death of the process.
pub fn check_address_space(shared_bytes: u64) -> Result<(), PlaceError> {
    let needed = ADDRESS_SPACE_BYTES.saturating_add(shared_bytes.saturating_mul(COPIES));
    match getrlimit(Resource::As).current {
        Some(limit) if limit < needed => {
            Err(PlaceError::AddressSpace { limit_mb: limit >> 20, needed_mb: needed >> 20 })
        }
        _ => Ok(()),
    }
}
