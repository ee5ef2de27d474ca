//! Why results cannot be written.

use std::io;
use std::path::PathBuf;

use crate::capture::source_error::SourceError;

/// Why results cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    /// A file or folder cannot be written.
    #[error("cannot write {path}: {source}; choose another folder with --output")]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The path of the folder is a file.
    #[error("{0} is a file: name a folder with --output")]
    File(PathBuf),
    /// There is not enough space.
    #[error(
        "cannot write {path}: {source}; about {needed_mb} MB are needed and {free_mb} MB are free: free some space, or choose another folder with --output"
    )]
    Room {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
        /// Space for all files of the run.
        needed_mb: u64,
        /// Free space of the file system.
        free_mb: u64,
    },
    /// A file of the user would be replaced.
    #[error(
        "{0} was not written by semidense and would be replaced: move it away, or choose another folder with --output"
    )]
    Foreign(PathBuf),
    /// Another process writes there.
    #[error(
        "{folder} is in use by semidense, process {process}: wait until that has ended, or choose another folder with --output"
    )]
    Held {
        /// The folder.
        folder: PathBuf,
        /// Id of the process.
        process: String,
    },
    /// True depth cannot be read.
    #[error("cannot read the depth of a keyframe for evaluation: {0}")]
    Depth(#[from] SourceError),
}
