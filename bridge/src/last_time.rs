//! Rate limit: an action done at most once per period.

use std::time::{Duration, Instant};

/// When something was last done; due at once if never.
#[derive(Debug, Clone, Copy, Default)]
pub struct LastTime(Option<Instant>);

impl LastTime {
    /// Done now.
    pub fn now() -> Self {
        Self(Some(Instant::now()))
    }

    /// Whether the action is due again; if so, counts it as done.
    pub fn is_due(&mut self, period: Duration) -> bool {
        let is_due = self.0.is_none_or(|at| at.elapsed() >= period);
        if is_due {
            *self = Self::now();
        }
        is_due
    }
}
