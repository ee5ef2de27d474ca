//! What is done at most once in a period.

use std::time::{Duration, Instant};

/// When something was done last; due at once where it never was.
#[derive(Debug, Clone, Copy, Default)]
pub struct LastTime(Option<Instant>);

impl LastTime {
    /// Now.
    pub fn now() -> Self {
        Self(Some(Instant::now()))
    }

    /// Whether it is due once more; then it counts as done.
    pub fn is_due(&mut self, period: Duration) -> bool {
        let is_due = self.0.is_none_or(|at| at.elapsed() >= period);
        if is_due {
            *self = Self::now();
        }
        is_due
    }
}
