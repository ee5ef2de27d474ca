//! Counted times of a run.

use serde::{Deserialize, Serialize};

use crate::wire::message::HISTOGRAM_BUCKETS;

/// Times counted in the buckets of [`crate::service::health::bucket`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "Vec<u64>", from = "Vec<u64>")]
pub struct TimeCounts(pub [u64; HISTOGRAM_BUCKETS]);

impl TimeCounts {
    /// Adds the counts of another process.
    pub fn add(&mut self, others: &Self) {
        let pairs = self.0.iter_mut().zip(&others.0);
        pairs.for_each(|(sum, count)| *sum = sum.saturating_add(*count));
    }
}

impl Default for TimeCounts {
    fn default() -> Self {
        Self([0; HISTOGRAM_BUCKETS])
    }
}

impl From<TimeCounts> for Vec<u64> {
    fn from(counts: TimeCounts) -> Self {
        counts.0.to_vec()
    }
}

impl From<Vec<u64>> for TimeCounts {
    /// Missing buckets are empty.
    fn from(counts: Vec<u64>) -> Self {
        Self(std::array::from_fn(|i| counts.get(i).copied().unwrap_or(0)))
    }
}
