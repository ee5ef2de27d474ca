//! A limit on the number of clients served at a time.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Counter of the seats in use.
#[derive(Debug, Clone, Default)]
pub struct Seats(Arc<AtomicUsize>);

/// A seat in use until it is dropped.
#[derive(Debug)]
pub struct Seat(Seats);

impl Seats {
    /// Takes a seat; `None` if `most` are in use.
    pub fn take(&self, most: usize) -> Option<Seat> {
        let more = |n: usize| (n < most).then_some(n + 1);
        self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).ok()?;
        Some(Seat(self.clone()))
    }

    /// Number of seats in use.
    pub fn num_taken(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.0.0.fetch_sub(1, Ordering::Relaxed);
    }
}
