//! Why a rig cannot be used.

use std::path::PathBuf;

use crate::slam::parameter::ParameterError;

/// Why a rig cannot be used; names the file.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The file is not a rig: bad syntax, an unknown or a missing key.
    #[error("{}, line {line}: {problem}", path.display())]
    Syntax {
        /// The rig file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// The problem, in one line.
        problem: String,
    },
    /// A value that no camera can have.
    #[error("{}: {source}", path.display())]
    Value {
        /// The rig file.
        path: PathBuf,
        /// Key, value and allowed range.
        source: ParameterError,
    },
}
