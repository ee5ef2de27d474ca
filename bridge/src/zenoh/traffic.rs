//! The sender's log of traffic: messages and bytes of each kind, and drops.

use std::time::{Duration, Instant};

use crate::zenoh::kind::Kind;
use crate::zenoh::outlet::Outlet;

/// Time between two log lines.
const PERIOD: Duration = Duration::from_secs(10);

/// Counters as of the last log line.
#[derive(Debug)]
pub struct Traffic {
    told: Instant,
    counts: [u64; Kind::COUNT],
    bytes: [u64; Kind::COUNT],
    dropped: u64,
}

impl Default for Traffic {
    /// Counters before the first log line.
    fn default() -> Self {
        Self { told: Instant::now(), counts: [0; Kind::COUNT], bytes: [0; Kind::COUNT], dropped: 0 }
    }
}

impl Traffic {
    /// Logs the traffic since the last line, if that is due.
    pub fn log_if_due(
        &mut self,
        outlet: &Outlet,
        dropped: impl Fn() -> [(&'static str, u64); 5],
        refused: u64,
    ) {
        let secs = self.told.elapsed().as_secs_f64();
        if self.told.elapsed() < PERIOD {
            return;
        }
        let (counts, bytes) = (outlet.counts(), outlet.bytes());
        let rates: Vec<String> = Kind::ALL
            .into_iter()
            .filter(|kind| counts[*kind as usize] > self.counts[*kind as usize])
            .map(|kind| {
                let index = kind as usize;
                let per_sec = |new: u64, old: u64| new.saturating_sub(old) as f64 / secs;
                let rate = per_sec(counts[index], self.counts[index]);
                let kilobytes = per_sec(bytes[index], self.bytes[index]) / 1e3;
                format!("{kind:?} {rate:.1}/s {kilobytes:.1} kB/s")
            })
            .collect();
        let dropped = dropped();
        let sum = dropped.iter().map(|(_, count)| count).sum();
        let names: Vec<String> =
            dropped.iter().map(|(name, count)| format!("{name} {count}")).collect();
        let line = format!("dropped: {}; refused {refused}", names.join(", "));
        tracing::info!("sent: {}; {line}", rates.join(", "));
        if sum > self.dropped {
            tracing::warn!("the network is too slow for the messages; {line}");
        }
        *self = Self { told: Instant::now(), counts, bytes, dropped: sum };
    }
}
