//! Latency trials: the three processes live on a repeated sequence, alongside possible disturbances.

use std::ffi::OsString;
use std::hint::black_box;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::capture::source_name::SourceName;
use crate::service::config::Config;
use crate::service::error_log::ErrorLog;
use crate::service::mode::Mode;
use crate::service::results::record::{EndOfRun, RecordedPose};
use crate::service::results::times::Percentiles;
use crate::service::run_progress::RunProgress;
use crate::service::shutdown::Shutdown;
use crate::service::supervisor::{RunError, RunOptions, RunOutcome, run};
use crate::wire::message::{FrameHeader, PoseMessage};
use crate::wire::place::Place;
use crate::wire::place_error::PlaceError;
use crate::wire::port::{Access, Hub, OpenError, Subscriber, wait};
use crate::wire::topic::{FRAME, POSE};

/// How long the slow reader holds a frame: many frame periods.
const SLOW_READER_PAUSE: Duration = Duration::from_millis(500);
/// Pause of an idle reader.
const READER_PAUSE: Duration = Duration::from_millis(20);
/// Settings that make a map step longer than a frame period: all pixels carry depth, which is smoothed and published
/// with every frame, by one thread.
const SATURATED_MAPPER: [&str; 3] =
    ["mapping.min_gradient=0.5", "mapping.publish_change_ratio=0.0", "mapper.threads=1"];
/// Settings of real-time scheduling.
const REAL_TIME: [&str; 6] = [
    "capture.scheduling.policy=fifo",
    "capture.scheduling.timer_slack_us=1",
    "tracker.scheduling.policy=fifo",
    "tracker.scheduling.lock_memory=true",
    "capture.scheduling.lock_memory=true",
    "tracker.early_wake_us=300.0",
];

/// Disturbance alongside the pipeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Disturbance {
    /// Nothing.
    Idle,
    /// One busy thread per CPU.
    BusyCpus,
    /// More work for the mapper than it can do.
    SaturatedMapper,
    /// A subscriber that reads frames and poses slowly and holds them.
    SlowReader,
    /// A subscriber that never reads.
    DeafReader,
}

impl Disturbance {
    /// All of them.
    pub const ALL: [Self; 5] =
        [Self::Idle, Self::BusyCpus, Self::SaturatedMapper, Self::SlowReader, Self::DeafReader];

    /// Its name in words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::BusyCpus => "busy CPUs",
            Self::SaturatedMapper => "saturated mapper",
            Self::SlowReader => "slow reader",
            Self::DeafReader => "deaf reader",
        }
    }
}

/// One trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trial {
    /// Disturbance alongside the pipeline.
    pub disturbance: Disturbance,
    /// Whether capture and tracker run under FIFO scheduling with locked memory.
    pub real_time: bool,
    /// Frames.
    pub frames: u64,
    /// Frames per second.
    pub rate_hz: f64,
}

/// Result of a trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measurement {
    /// Disturbance alongside the pipeline.
    pub disturbance: Disturbance,
    /// Whether real-time scheduling was requested.
    pub real_time: bool,
    /// Frames per second.
    pub rate_hz: f64,
    /// Frames that capture sent.
    pub frames: u64,
    /// Poses published for them.
    pub poses: u64,
    /// Poses among them that are claimed.
    pub tracked: u64,
    /// From the time at which a frame was due to the publication of its pose.
    pub latency_ms: Option<Percentiles>,
    /// From the sending of a frame to its pick-up by the tracker.
    pub wake_ms: Option<Percentiles>,
    /// Time in the tracker.
    pub track_ms: Option<Percentiles>,
    /// Time allowed to the tracker from a frame's arrival.
    pub deadline_ms: Option<f64>,
    /// Poses published later than that.
    pub deadline_misses: u64,
    /// Frames without a pose, because a newer one had arrived.
    pub dropped: u64,
    /// Page faults of the tracker's frame loop after its first hundred frames.
    pub page_faults: u64,
    /// Time that the host of a virtual machine took from it meanwhile, all CPUs, milliseconds; null where the kernel
    /// does not report it.
    pub stolen_ms: Option<f64>,
}

/// Why a trial failed.
#[derive(Debug, thiserror::Error)]
pub enum TrialError {
    /// The processes do not run.
    #[error(transparent)]
    Run(#[from] RunError),
    /// They ended early.
    #[error("the trial ended early: {0}")]
    Ended(String),
    /// A signal arrived.
    #[error("interrupted")]
    Interrupted,
    /// The instance's place is invalid.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A thread of the disturbance cannot be started.
    #[error("cannot start a thread for the load ({0})")]
    Thread(std::io::Error),
}

/// Runs one trial. `source` is repeated; `arguments` are options for every process.
pub fn run_trial(
    config: &Config,
    trial: &Trial,
    source: &SourceName,
    arguments: &[OsString],
    log: &ErrorLog,
    shutdown: &Shutdown,
    observe: &mut dyn FnMut(&RunProgress),
) -> Result<Measurement, TrialError> {
    let mut settings = Vec::new();
    if trial.real_time {
        settings.extend(REAL_TIME);
    }
    if trial.disturbance == Disturbance::SaturatedMapper {
        settings.extend(SATURATED_MAPPER);
    }
    let (config, mut options) =
        bench_options(config, trial.frames, trial.rate_hz, source, arguments, log);
    options.arguments.extend(settings.iter().flat_map(|&set| ["--set".into(), set.into()]));
    let place = Place::new(&config.instance, &config.root)?;
    let disturber = Disturber::start(trial.disturbance, &place).map_err(TrialError::Thread)?;
    let stolen_before = stolen_ms();
    let outcome = run(&config, &options, shutdown, observe);
    let stolen_ms = stolen_ms().zip(stolen_before).map(|(after, before)| after - before);
    drop(disturber);
    let outcome = outcome?;
    match &outcome.record.ended {
        EndOfRun::Interrupted => Err(TrialError::Interrupted),
        EndOfRun::Failed(cause) => Err(TrialError::Ended(cause.clone())),
        _ => Ok(measurement(trial, &outcome, stolen_ms)),
    }
}

/// A run of a repeated source under a separate instance, without results.
pub(super) fn bench_options(
    config: &Config,
    num_frames: u64,
    rate_hz: f64,
    source: &SourceName,
    arguments: &[OsString],
    log: &ErrorLog,
) -> (Config, RunOptions) {
    let mut config = config.clone();
    config.instance = format!("bench-{}", std::process::id());
    let instance = ["--instance".into(), config.instance.clone().into()];
    let options = RunOptions {
        source: SourceName::Looped { num_frames, rate_hz, inner: Box::new(source.clone()) },
        rig: None,
        mask: None,
        mode: Mode::Live,
        output: PathBuf::new(),
        keeps_map: false,
        journal: None,
        log: log.clone(),
        arguments: arguments.iter().cloned().chain(instance).collect(),
    };
    (config, options)
}

fn measurement(trial: &Trial, outcome: &RunOutcome, stolen_ms: Option<f64>) -> Measurement {
    let record = &outcome.record;
    let tail =
        |of: fn(&RecordedPose) -> Option<u64>| Percentiles::of(record.poses.iter().filter_map(of));
    Measurement {
        disturbance: trial.disturbance,
        real_time: trial.real_time,
        rate_hz: trial.rate_hz,
        frames: record.counters.frames_in,
        poses: record.poses.len() as u64,
        tracked: record.poses.iter().filter(|p| p.estimate.state.is_tracked()).count() as u64,
        latency_ms: tail(|pose| pose.latency_nanos),
        wake_ms: tail(|pose| pose.wake_nanos),
        track_ms: tail(|pose| pose.track_nanos),
        deadline_ms: record.deadline_nanos.map(|nanos| nanos as f64 * 1e-6),
        deadline_misses: record.counters.deadline_misses,
        dropped: record.frames_dropped,
        page_faults: record.counters.page_faults,
        stolen_ms,
    }
}

/// Time stolen from all CPUs since the machine started, from /proc/stat.
fn stolen_ms() -> Option<f64> {
    /// Index of the figure in the line `cpu`, counting its name.
    const STEAL_FIELD: usize = 8;
    let stat = std::fs::read_to_string("/proc/stat").ok()?;
    let line = stat.lines().find(|line| line.starts_with("cpu "))?;
    let ticks: f64 = line.split_whitespace().nth(STEAL_FIELD)?.parse().ok()?;
    Some(ticks * 1000.0 / rustix::param::clock_ticks_per_second() as f64)
}

/// A running disturbance; ends when dropped.
struct Disturber {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Disturber {
    fn start(disturbance: Disturbance, place: &Place) -> std::io::Result<Self> {
        let mut disturber = Self { stop: Arc::new(AtomicBool::new(false)), threads: Vec::new() };
        let stop = || Arc::clone(&disturber.stop);
        let works: Vec<Box<dyn FnOnce() + Send>> = match disturbance {
            Disturbance::Idle | Disturbance::SaturatedMapper => Vec::new(),
            Disturbance::BusyCpus => {
                let count = std::thread::available_parallelism()?.get();
                (0..count).map(|_| stop()).map(|stop| Box::new(move || spin(&stop)) as _).collect()
            }
            Disturbance::SlowReader | Disturbance::DeafReader => {
                let (stop, place) = (stop(), place.clone());
                let hears = disturbance == Disturbance::SlowReader;
                vec![Box::new(move || read(&place, hears, &stop))]
            }
        };
        for work in works {
            let thread = std::thread::Builder::new().name("semidense-disturb".to_owned());
            disturber.threads.push(thread.spawn(work)?);
        }
        Ok(disturber)
    }
}

impl Drop for Disturber {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        // A panic of a thread has been reported where it happened.
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

/// Keeps a CPU busy.
fn spin(stop: &AtomicBool) {
    let mut value = 1_u64;
    while !stop.load(Ordering::Acquire) {
        for _ in 0..10_000 {
            value = black_box(value.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1));
        }
    }
}

/// Subscribes as soon as it can, and reads slowly or not at all.
fn read(place: &Place, hears: bool, stop: &AtomicBool) {
    // A wait that fails only ends sooner.
    let pause = |time: Duration| drop(wait(&[], None, time));
    let mut opened = None;
    while !stop.load(Ordering::Acquire) {
        let Some((_, frames, poses)) = &opened else {
            opened = subscribe(place).ok();
            pause(READER_PAUSE);
            continue;
        };
        if hears {
            let held = (frames.receive(), poses.receive());
            pause(SLOW_READER_PAUSE);
            drop(held);
        } else {
            pause(READER_PAUSE);
        }
    }
}

type Subscribed = (Hub, Subscriber<u8, FrameHeader>, Subscriber<PoseMessage, ()>);

fn subscribe(place: &Place) -> Result<Subscribed, OpenError> {
    let hub = Hub::join(place, "bench-reader", Access::Observer)?;
    let (frames, poses) = (hub.subscriber(&FRAME)?, hub.subscriber(&POSE)?);
    Ok((hub, frames, poses))
}
