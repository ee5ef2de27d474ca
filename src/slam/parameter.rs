//! Errors for parameters of an algorithm that are out of range.

use std::fmt::{Debug, Display};
use std::ops::RangeInclusive;

/// A parameter with a value that its algorithm cannot work with.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key} = {value}: must be {allowed}")]
pub struct ParameterError {
    /// The key as written in the configuration, dotted below the algorithm's table.
    pub key: String,
    /// The value that was given.
    pub value: String,
    /// What is allowed, in words.
    pub allowed: String,
}

impl ParameterError {
    /// The same error with `table.` before its key.
    pub fn within(mut self, table: &str) -> Self {
        self.key = format!("{table}.{}", self.key);
        self
    }
}

/// Checks that `value` lies in `allowed`; NaN does not.
pub fn check_range<T: PartialOrd + Display + Debug>(
    key: &str,
    value: T,
    allowed: RangeInclusive<T>,
) -> Result<(), ParameterError> {
    if allowed.contains(&value) {
        return Ok(());
    }
    Err(ParameterError {
        key: key.to_owned(),
        value: value.to_string(),
        allowed: format!("{} to {}", allowed.start(), allowed.end()),
    })
}
