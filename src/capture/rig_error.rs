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
    /// The calibration file of another tool.
    #[error(
        "{}: this is a calibration of {tool}, not a rig: copy one from config/rigs or /usr/share/semidense/rigs and write its values there; {values}",
        path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// The tool that wrote it.
        tool: &'static str,
        /// Where the values of a rig are in it.
        values: &'static str,
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
