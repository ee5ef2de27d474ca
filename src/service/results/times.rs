//! Times of a run as percentiles and histograms.

use serde::{Deserialize, Serialize};

use crate::service::health::{bucket, bucket_end_ms, mean_ms, percentile_ms};
use crate::service::results::record::RecordedPose;
use crate::service::time_counts::TimeCounts;
use crate::slam::evaluation::statistics::percentile;
use crate::slam::pose::NO_KEYFRAME;
use crate::wire::message::HISTOGRAM_BUCKETS;

/// Percentiles of a time in milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Percentiles {
    /// Mean.
    pub mean: f64,
    /// Median.
    pub p50: f64,
    /// 95 of 100 are not longer.
    pub p95: f64,
    /// 99 of 100 are not longer.
    pub p99: f64,
    /// 999 of 1000 are not longer.
    pub p999: f64,
    /// Longest.
    pub max: f64,
}

impl Percentiles {
    /// Percentiles (nearest rank) of times in nanoseconds; `None` where there are none.
    pub fn of(nanos: impl Iterator<Item = u64>) -> Option<Self> {
        let mut millis: Vec<f64> = nanos.map(|n| n as f64 * 1e-6).collect();
        millis.sort_by(f64::total_cmp);
        let mean = millis.iter().sum::<f64>() / millis.len() as f64;
        Self::at(mean, |share| percentile(&millis, share))
    }

    fn at(mean: f64, at: impl Fn(f64) -> Option<f64>) -> Option<Self> {
        let (p50, p95, p99) = (at(0.5)?, at(0.95)?, at(0.99)?);
        Some(Self { mean, p50, p95, p99, p999: at(0.999)?, max: at(1.0)? })
    }

    /// Percentiles of counted times: accurate to a few per cent, the longest is the end of its bucket.
    pub fn of_counts(counts: &TimeCounts) -> Option<Self> {
        Self::at(mean_ms(&counts.0)?, |share| percentile_ms(&counts.0, share))
    }
}

/// How often each time occurred.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Histogram {
    /// Upper ends of the buckets that are not empty, milliseconds: half octaves.
    pub below_ms: Vec<f64>,
    /// How often a time fell into each.
    pub counts: Vec<u64>,
}

impl Histogram {
    /// Histogram of times in nanoseconds; `None` where there are none.
    pub fn of(nanos: impl Iterator<Item = u64>) -> Option<Self> {
        let mut counts = [0; HISTOGRAM_BUCKETS];
        nanos.for_each(|nanos| counts[bucket(nanos)] += 1);
        let filled: Vec<usize> = (0..HISTOGRAM_BUCKETS).filter(|&i| counts[i] > 0).collect();
        (!filled.is_empty()).then(|| Self {
            below_ms: filled.iter().map(|&i| bucket_end_ms(i)).collect(),
            counts: filled.iter().map(|&i| counts[i]).collect(),
        })
    }
}

/// Latency of poses, and the tracker's part of it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LatencySummary {
    /// From a frame's stamp to its pose's publication.
    pub latency_ms: Option<Percentiles>,
    /// From a frame's sending to its pick-up by the tracker.
    pub wake_ms: Option<Percentiles>,
    /// How often each latency occurred.
    pub latency_histogram: Option<Histogram>,
    /// How often each time in the tracker occurred.
    pub track_histogram: Option<Histogram>,
    /// How often each wake-up time occurred.
    pub wake_histogram: Option<Histogram>,
}

impl LatencySummary {
    /// Latencies of the poses of a run.
    pub fn of(poses: &[RecordedPose]) -> Self {
        let latencies = || poses.iter().filter_map(|pose| pose.latency_nanos);
        let wakes = || poses.iter().filter_map(|pose| pose.wake_nanos);
        Self {
            latency_ms: Percentiles::of(latencies()),
            wake_ms: Percentiles::of(wakes()),
            latency_histogram: Histogram::of(latencies()),
            track_histogram: Histogram::of(track_nanos(poses)),
            wake_histogram: Histogram::of(wakes()),
        }
    }
}

/// Times in the tracker, nanoseconds. A frame without a keyframe costs nothing and is left out.
pub fn track_nanos(poses: &[RecordedPose]) -> impl Iterator<Item = u64> {
    let has_keyframe = |pose: &&RecordedPose| pose.estimate.keyframe_id != NO_KEYFRAME;
    poses.iter().filter(has_keyframe).filter_map(|pose| pose.track_nanos)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_is_exact_for_times_and_within_buckets_for_counts() {
        let times = [1_000_000, 2_000_000, 9_000_000];
        let exact = Percentiles::of(times.into_iter()).unwrap();
        assert!((exact.mean - 4.0).abs() < 1e-12 && exact.p50 == 2.0, "{exact:?}");
        let mut counts = TimeCounts::default();
        times.iter().for_each(|&nanos| counts.0[bucket(nanos)] += 1);
        let counted = Percentiles::of_counts(&counts).unwrap();
        // A bucket is half an octave wide.
        assert!((counted.mean / 4.0).ln().abs() < 0.18, "{counted:?}");
        assert_eq!(Percentiles::of_counts(&TimeCounts::default()), None);
    }
}
