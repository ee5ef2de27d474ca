//! Why an instance cannot use its place, and what to do about it.

use std::io;
use std::path::PathBuf;

use crate::wire::folders::{MAX_ROOT_BYTES, ROOT_VARIABLE, SHARED_MEMORY};

/// Why an instance cannot use its place.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// The name of the instance is invalid.
    #[error(
        "instance `{0}` is not a valid name: use 1 to 32 of the characters a-z, A-Z, 0-9, _ and -"
    )]
    Instance(String),
    /// The folder's path is too long.
    #[error(
        "{0}: the path of the runtime folder may have at most {MAX_ROOT_BYTES} bytes; set {ROOT_VARIABLE}"
    )]
    TooLong(PathBuf),
    /// The folder's path has characters that a service cannot have.
    #[error(
        "{0}: the path of the runtime folder has characters that are not allowed; set {ROOT_VARIABLE}"
    )]
    Characters(PathBuf),
    /// The folder belongs to another user.
    #[error("{0}: the runtime folder belongs to another user; set {ROOT_VARIABLE} to one of yours")]
    Foreign(PathBuf),
    /// The folder or a file in it cannot be created.
    #[error("{path}: {source}; set {ROOT_VARIABLE} to a folder that can be written")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// Another process does not release the lock that it holds while it joins.
    #[error(
        "{0}: another process has held this lock for ten seconds: if a semidense process is stopped (ps -o pid,stat,cmd -C semidense), continue or kill it"
    )]
    Held(PathBuf),
    /// Another process already holds the claim.
    #[error(
        "{}instance `{instance}` is already running (process {holder}): stop it, or choose another name with --instance",
        part_of(process)
    )]
    Taken {
        /// Kind of process.
        process: String,
        /// Instance.
        instance: String,
        /// Process id of the running one.
        holder: String,
    },
    /// The limit of open files is too low.
    #[error(
        "only {limit} open files are allowed here, {needed} are needed: raise the limit (ulimit -n 1024, LimitNOFILE= of a systemd unit, docker run --ulimit nofile=1024)"
    )]
    OpenFiles {
        /// The limit.
        limit: u64,
        /// The number needed.
        needed: u64,
    },
    /// Too little address space.
    #[error(
        "only {limit_mb} MB of address space are allowed here, {needed_mb} MB are needed: raise the limit (ulimit -v unlimited, LimitAS= of a systemd unit)"
    )]
    AddressSpace {
        /// The limit.
        limit_mb: u64,
        /// The amount needed.
        needed_mb: u64,
    },
    /// There is no shared memory.
    #[error(
        "{SHARED_MEMORY}: {0}: there is no shared memory here; mount a tmpfs there (a container: docker run --shm-size=128m)"
    )]
    NoSharedMemory(io::Error),
    /// Shared memory ran out while the promised memory was being reserved.
    #[error(
        "{SHARED_MEMORY} is full: {missing_kb} kB of {needed_kb} kB could not be reserved; enlarge it (mount -o remount,size=…, or docker run --shm-size=…) or remove what other programs left there"
    )]
    Reservation {
        /// Could not be reserved.
        missing_kb: u64,
        /// Were to be reserved.
        needed_kb: u64,
    },
    /// Too little shared memory.
    #[error(
        "{SHARED_MEMORY} has only {free_mb} MB free, {needed_mb} MB are needed: enlarge it (mount -o remount,size=…, or docker run --shm-size=…)"
    )]
    SharedMemory {
        /// Free.
        free_mb: u64,
        /// Needed.
        needed_mb: u64,
    },
}

/// Names the process of an instance; empty for the supervisor, which represents all of the instance.
fn part_of(process: &str) -> String {
    if process == "supervisor" { String::new() } else { format!("{process} of ") }
}

#[cfg(test)]
mod tests {
    use super::PlaceError;

    #[test]
    fn a_second_process_is_told_what_is_already_running() {
        let told = |process: &str| {
            let (process, instance) = (process.to_owned(), "semidense".to_owned());
            PlaceError::Taken { process, instance, holder: "7".to_owned() }.to_string()
        };
        let expected = "instance `semidense` is already running (process 7): stop it, or choose another name with --instance";
        assert_eq!(told("supervisor"), expected);
        assert_eq!(told("tracker"), format!("tracker of {expected}"));
    }
}
