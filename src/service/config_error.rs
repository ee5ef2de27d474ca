//! Why a configuration is refused.

use std::path::PathBuf;

use crate::slam::parameter::ParameterError;

/// Why a configuration is refused; one line that names the place.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{path}: cannot be read: {source}; check --config")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A key or a value is invalid.
    #[error("{place}: {reason}")]
    Syntax {
        /// File and line, or the option.
        place: String,
        /// What is wrong.
        reason: String,
    },
    /// A value is out of range.
    #[error("{place}: {source}")]
    Value {
        /// File, or the option.
        place: String,
        /// Key, value, what is allowed.
        source: ParameterError,
    },
}
