//! Why an instance cannot live at its place, in words that say what to do.

use std::io;
use std::path::PathBuf;

use crate::wire::folders::{MAX_ROOT_BYTES, ROOT_VARIABLE, SHARED_MEMORY};

/// Why an instance cannot live there.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// The name of the instance.
    #[error(
        "instance `{0}` is not a valid name: use 1 to 32 of the characters a-z, A-Z, 0-9, _ and -"
    )]
    Instance(String),
    /// The folder's path is too long.
    #[error(
        "{0}: the path of the runtime folder may have at most {MAX_ROOT_BYTES} bytes; set {ROOT_VARIABLE}"
    )]
    TooLong(PathBuf),
    /// The folder's path has bytes that a service cannot have.
    #[error(
        "{0}: the path of the runtime folder has characters that are not allowed; set {ROOT_VARIABLE}"
    )]
    Characters(PathBuf),
    /// The folder belongs to someone else.
    #[error("{0}: the runtime folder belongs to another user; set {ROOT_VARIABLE} to one of yours")]
    Foreign(PathBuf),
    /// The folder or a file in it cannot be made.
    #[error("{path}: {source}; set {ROOT_VARIABLE} to a folder that can be written")]
    Io {
        /// What.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A process that joins does not get ready.
    #[error(
        "{0}: another process has held this lock for ten seconds: if a semidense process is stopped (ps -o pid,stat,cmd -C semidense), continue or kill it"
    )]
    Held(PathBuf),
    /// There is one already.
    #[error(
        "{}instance `{instance}` is already running (process {holder}): stop it, or choose another name with --instance",
        part_of(process)
    )]
    Taken {
        /// Kind of process.
        process: String,
        /// Instance.
        instance: String,
        /// Process id of the one that runs.
        holder: String,
    },
    /// Too few files may be open at a time.
    #[error(
        "only {limit} open files are allowed here, {needed} are needed: raise the limit (ulimit -n 1024, LimitNOFILE= of a systemd unit, docker run --ulimit nofile=1024)"
    )]
    OpenFiles {
        /// The limit.
        limit: u64,
        /// What is needed.
        needed: u64,
    },
    /// Too little address space.
    #[error(
        "only {limit_mb} MB of address space are allowed here, {needed_mb} MB are needed: raise the limit (ulimit -v unlimited, LimitAS= of a systemd unit)"
    )]
    AddressSpace {
        /// The limit.
        limit_mb: u64,
        /// What is needed.
        needed_mb: u64,
    },
    /// There is no shared memory.
    #[error(
        "{SHARED_MEMORY}: {0}: there is no shared memory here; mount a tmpfs there (a container: docker run --shm-size=128m)"
    )]
    NoSharedMemory(io::Error),
    /// Shared memory ran out while what was promised was taken.
    #[error(
        "{SHARED_MEMORY} is full: {missing_kb} kB of {needed_kb} kB could not be reserved; enlarge it (mount -o remount,size=…, or docker run --shm-size=…) or remove what other programs left there"
    )]
    Reservation {
        /// Could not be had.
        missing_kb: u64,
        /// Were wanted.
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

/// The process of an instance that is meant; nothing where that is the supervisor, who stands for all of it.
fn part_of(process: &str) -> String {
    if process == "supervisor" { String::new() } else { format!("{process} of ") }
}

#[cfg(test)]
mod tests {
    use super::PlaceError;

    #[test]
    fn who_is_second_is_told_what_runs_already() {
        let told = |process: &str| {
            let (process, instance) = (process.to_owned(), "semidense".to_owned());
            PlaceError::Taken { process, instance, holder: "7".to_owned() }.to_string()
        };
        let expected = "instance `semidense` is already running (process 7): stop it, or choose another name with --instance";
        assert_eq!(told("supervisor"), expected);
        assert_eq!(told("tracker"), format!("tracker of {expected}"));
    }
}
