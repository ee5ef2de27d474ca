//! A long monitored run: memory of the processes, time per frame and keyframes, over time.

use std::ffi::OsString;
use std::fmt::Write;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::capture::source_name::SourceName;
use crate::service::config::Config;
use crate::service::error_log::ErrorLog;
use crate::service::health::percentile_ms;
use crate::service::journal::{Journal, JournalOptions};
use crate::service::latency_bench::{TrialError, bench_options};
use crate::service::mode::Mode;
use crate::service::peers::Peer;
use crate::service::results::record::EndOfRun;
use crate::service::run_progress::RunProgress;
use crate::service::shutdown::Shutdown;
use crate::service::supervisor::run;
use crate::wire::message::{HISTOGRAM_BUCKETS, HealthMessage};
use crate::wire::place::Place;
use crate::wire::port::{Access, Hub};
use crate::wire::topic::HEALTH_TOPICS;

/// Indices in [`HEALTH_TOPICS`].
const TRACKER: usize = 1;
const MAPPER: usize = 2;
const BYTES_PER_MEGABYTE: f64 = 1e6;

/// A run to monitor.
#[derive(Debug, Clone)]
pub struct Soak {
    /// Frames.
    pub frames: u64,
    /// Frames per second.
    pub rate_hz: f64,
    /// Live or lockstep.
    pub mode: Mode,
    /// Time between two samples.
    pub period: Duration,
    /// Its journal, which holds the poses like that of any run.
    pub journal: JournalOptions,
}

/// The state of the processes at one instant, and the times of the frames since the previous sample.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Since the first frame, seconds.
    pub seconds: f64,
    /// Frames that the tracker has received.
    pub frames: u64,
    /// Frames without a pose, because a newer one had arrived.
    pub dropped: u64,
    /// The quantities whose trend is reported, in the order of [`COLUMNS`].
    values: Vec<f64>,
}

/// Names of the quantities whose trend is reported: keyframes with image and depth; times of the tracker and of the
/// mapper per frame and CPU time of a joint estimate, milliseconds; resident memory of each process without what the
/// processes share, megabytes, where the supervisor is the process that monitors and collects the poses.
const COLUMNS: [&str; 11] = [
    "keyframes",
    "track_p50_ms",
    "track_p99_ms",
    "map_p50_ms",
    "map_p99_ms",
    "adjust_p50_ms",
    "adjust_p99_ms",
    "capture_mb",
    "tracker_mb",
    "mapper_mb",
    "supervisor_mb",
];

/// The trend of a quantity over time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Trend {
    /// Name of the column.
    pub name: &'static str,
    /// Mean of the second quarter of the samples; the first is warm-up.
    pub second_quarter: f64,
    /// Mean of the last quarter.
    pub last_quarter: f64,
    /// Slope of the straight line through the last three quarters, per hour.
    pub per_hour: f64,
}

/// Runs it and returns the samples, even if it is interrupted.
pub fn soak(
    config: &Config,
    soak: &Soak,
    source: &SourceName,
    arguments: &[OsString],
    log: &ErrorLog,
    shutdown: &Shutdown,
    observe: &mut dyn FnMut(&RunProgress),
) -> Result<Vec<Sample>, TrialError> {
    let (config, mut options) =
        bench_options(config, soak.frames, soak.rate_hz, source, arguments, log);
    options.mode = soak.mode;
    options.journal = Some(soak.journal.clone());
    let place = Place::new(&config.instance, &config.root)?;
    let mut watch = Watch::new(place, soak.period);
    let outcome = run(&config, &options, shutdown, &mut |progress| {
        observe(progress);
        if matches!(progress, RunProgress::Running { .. }) {
            watch.sample_if_due();
        }
    })?;
    // There are no results that would need it.
    if let Some(Err(error)) = outcome.journal.map(Journal::finish) {
        tracing::warn!("the journal of the soak run could not be removed: {error}");
    }
    match outcome.record.ended {
        EndOfRun::Failed(cause) => Err(TrialError::Ended(cause)),
        _ => Ok(watch.samples),
    }
}

/// Monitors the processes while they run.
struct Watch {
    place: Place,
    period: Duration,
    peers: Option<(Hub, [Peer; 3])>,
    started: Option<Instant>,
    next: Instant,
    before: [Counts; 3],
    samples: Vec<Sample>,
}

type Counts = [u64; HISTOGRAM_BUCKETS];

impl Watch {
    fn new(place: Place, period: Duration) -> Self {
        let before = [[0; HISTOGRAM_BUCKETS]; 3];
        let (peers, started) = (None, None);
        Self { place, period, peers, started, next: Instant::now(), before, samples: Vec::new() }
    }

    /// Takes a sample when one is due; a process without a message yet is queried again at the next call.
    fn sample_if_due(&mut self) {
        let started = *self.started.get_or_insert_with(Instant::now);
        if self.peers.is_none() {
            self.peers = listen(&self.place);
        }
        let Some((hub, peers)) = &mut self.peers else { return };
        // Messages for late subscribers are sent when connections are checked.
        let _ = hub;
        let heard = peers.iter_mut().map(|peer| peer.update().ok().flatten().copied());
        let heard: Option<Vec<HealthMessage>> = heard.collect();
        let Some(heard) = heard.filter(|_| Instant::now() >= self.next) else { return };
        self.next = Instant::now() + self.period;
        let [tracker, mapper] = [TRACKER, MAPPER].map(|process| &heard[process]);
        let counts = [tracker.work_counts, mapper.work_counts, mapper.adjustment_counts];
        let times = [0, 1, 2].map(|of| times_since(&counts[of], &self.before[of]));
        self.before = counts;
        let keyframes = [mapper.total as f64];
        let children = heard.iter().map(|process| process.process_id.to_string());
        let memory = children.chain(["self".to_owned()]).map(|process| resident_mb(&process));
        self.samples.push(Sample {
            seconds: started.elapsed().as_secs_f64(),
            frames: tracker.frames,
            dropped: tracker.dropped,
            values: keyframes
                .into_iter()
                .chain(times.into_iter().flatten())
                .chain(memory)
                .collect(),
        });
    }
}

fn listen(place: &Place) -> Option<(Hub, [Peer; 3])> {
    let hub = Hub::join(place, "soak", Access::Observer).ok()?;
    let peers: Vec<Peer> =
        HEALTH_TOPICS.iter().map(|topic| Peer::open(&hub, topic).ok()).collect::<Option<_>>()?;
    Some((hub, peers.try_into().ok()?))
}

/// Median and 99th percentile of the times counted since then; NaN without any.
fn times_since(now: &Counts, before: &Counts) -> [f64; 2] {
    // A restarted process counts from 0.
    let counts = std::array::from_fn(|i| now[i].saturating_sub(before[i]));
    [0.5, 0.99].map(|share| percentile_ms(&counts, share).unwrap_or(f64::NAN))
}

/// Resident anonymous memory of a process, megabytes; NaN where it is gone.
fn resident_mb(process: &str) -> f64 {
    const BYTES_PER_KB: f64 = 1024.0;
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:"));
    let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kilobytes.map_or(f64::NAN, |kilobytes| kilobytes * BYTES_PER_KB / BYTES_PER_MEGABYTE)
}

/// The trend of each quantity; empty for fewer than four samples.
pub fn trends(samples: &[Sample]) -> Vec<Trend> {
    let quarter = samples.len() / 4;
    if quarter == 0 {
        return Vec::new();
    }
    let (warm, last) = (&samples[quarter..], &samples[samples.len() - quarter..]);
    let of = |(column, name): (usize, &&'static str)| Trend {
        name,
        second_quarter: mean(&warm[..quarter], column),
        last_quarter: mean(last, column),
        per_hour: slope(warm, column) * 3600.0,
    };
    COLUMNS.iter().enumerate().map(of).collect()
}

/// Mean of the finite values.
fn mean(samples: &[Sample], column: usize) -> f64 {
    let values = samples.iter().map(|of| of.values[column]).filter(|value| value.is_finite());
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

/// Slope of the least-squares line, per second.
fn slope(samples: &[Sample], column: usize) -> f64 {
    let points = || {
        let all = samples.iter().map(|sample| (sample.seconds, sample.values[column]));
        all.filter(|(_, value)| value.is_finite())
    };
    let count = points().count() as f64;
    let (seconds, values) = points().fold((0.0, 0.0), |(s, v), (x, y)| (s + x, v + y));
    let (middle, level) = (seconds / count, values / count);
    let (above, below) = points().fold((0.0, 0.0), |(above, below), (x, y)| {
        (above + (x - middle) * (y - level), below + (x - middle) * (x - middle))
    });
    if below > 0.0 { above / below } else { 0.0 }
}

/// The samples as comma-separated lines, the first with the column names; unknown values are left empty.
pub fn csv(samples: &[Sample]) -> String {
    let mut text = format!("seconds,frames,dropped,{}\n", COLUMNS.join(","));
    for sample in samples {
        let Sample { seconds, frames, dropped, values } = sample;
        // Writing to a string does not fail.
        let _ = write!(text, "{seconds:.1},{frames},{dropped}");
        for value in values {
            let _ = if value.is_finite() { write!(text, ",{value:.3}") } else { write!(text, ",") };
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples() -> Vec<Sample> {
        // 40 per hour, and flat.
        let value = |k: u32, name: &str| match name {
            "keyframes" => (40 * u64::from(k) / 360) as f64,
            "mapper_mb" => 100.0 + 40.0 * 10.0 * f64::from(k) / 3600.0,
            "track_p50_ms" => [3.0, f64::NAN][usize::from(k == 390)],
            _ => 0.0,
        };
        let sample = |k: u32| Sample {
            seconds: 10.0 * f64::from(k),
            frames: 300 * u64::from(k),
            dropped: 0,
            values: COLUMNS.map(|name| value(k, name)).to_vec(),
        };
        (0..400).map(sample).collect()
    }

    #[test]
    fn a_growing_quantity_has_a_slope_and_a_flat_one_has_none() {
        let trends = trends(&samples());
        let of = |name: &str| *trends.iter().find(|trend| trend.name == name).unwrap();
        assert!((of("mapper_mb").per_hour - 40.0).abs() < 1e-6, "{:?}", of("mapper_mb"));
        assert!((of("keyframes").per_hour - 40.0).abs() < 1.0, "{:?}", of("keyframes"));
        let track = of("track_p50_ms");
        assert!(track.per_hour.abs() < 1e-9 && track.last_quarter == 3.0, "{track:?}");
        assert!(of("mapper_mb").last_quarter > of("mapper_mb").second_quarter + 20.0);
        assert_eq!(super::trends(&samples()[..3]), []);
    }

    #[test]
    fn a_line_has_a_value_per_name_and_no_nan() {
        let text = csv(&samples());
        let columns = text.lines().next().unwrap().split(',').count();
        assert_eq!(text.lines().count(), 401);
        assert!(text.lines().all(|line| line.split(',').count() == columns), "{text}");
        assert!(!text.contains("NaN"));
    }

    #[test]
    fn times_cover_the_frames_since_the_previous_sample() {
        let (mut now, mut before) = ([0; HISTOGRAM_BUCKETS], [0; HISTOGRAM_BUCKETS]);
        (now[10], before[10], now[20]) = (1000, 1000, 5);
        let [median, _] = times_since(&now, &before);
        assert!(median > percentile_ms(&before, 0.99).unwrap());
        before[20] = 5;
        assert!(times_since(&now, &before)[0].is_nan());
    }

    #[test]
    fn memory_is_that_of_the_process_and_nan_without_one() {
        let held = std::hint::black_box(vec![1_u8; 8_000_000]);
        let resident = resident_mb("self");
        assert!(resident > 7.0, "{resident} MB with {} bytes", held.len());
        assert!(resident_mb("none").is_nan());
    }
}
