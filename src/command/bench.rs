//! `semidense bench latency`: the latency of poses, idle and under load.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{Args, Subcommand, ValueEnum};

use crate::capture::source::SourceName;
use crate::command::print::{note, print};
use crate::command::run_progress::start_display;
use crate::command::{CommandResult, CommonArguments, INTERRUPTED};
use crate::service::config::Config;
use crate::service::error_log::ErrorLog;
use crate::service::latency_bench::{Disturbance, Measurement, Trial, TrialError, try_out};
use crate::service::results::times::Percentiles;
use crate::service::shutdown::Shutdown;

/// Measure performance on this machine
#[derive(Debug, Args)]
pub struct BenchArguments {
    #[command(subcommand)]
    what: Bench,
}

#[derive(Debug, Subcommand)]
enum Bench {
    Latency(LatencyArguments),
}

/// Load next to the pipeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Beside {
    /// Each of the following in turn
    All,
    /// No load
    Idle,
    /// One busy thread per CPU
    BusyCpus,
    /// A mapper with more work than it can do
    SaturatedMapper,
    /// A subscriber that reads slowly
    SlowReader,
    /// A subscriber that never reads
    DeafReader,
}

/// Scheduling of capture and tracker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum RealTime {
    /// As configured
    Off,
    /// FIFO priorities, locked memory, and a tracker that is awake when a frame is due
    On,
    /// Off, then on
    Both,
}

/// Run capture, tracker and mapper live and report the latency of poses, idle and under load, with and
/// without real-time scheduling
#[derive(Debug, Args)]
pub struct LatencyArguments {
    /// Source to play back and forth; the default room is rendered first
    #[arg(long, value_name = "SOURCE", default_value = "sim")]
    source: OsString,
    /// Frames per second
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    fps: f64,
    /// Duration of each trial in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0)]
    seconds: f64,
    /// Load next to the pipeline
    #[arg(long, value_enum, default_value_t = Beside::All)]
    load: Beside,
    /// Scheduling of capture and tracker
    #[arg(long, value_enum, default_value_t = RealTime::Both)]
    realtime: RealTime,
    /// Print JSON, one object per trial
    #[arg(long)]
    json: bool,
}

/// Most frames of a trial: a day at 60 Hz; poses are kept until its end.
const MAX_FRAMES: f64 = 5_184_000.0;

/// Runs it.
pub fn run(
    config: &Config,
    common: &CommonArguments,
    log: &ErrorLog,
    arguments: BenchArguments,
) -> CommandResult {
    let Bench::Latency(arguments) = arguments.what;
    let frames = (arguments.fps * arguments.seconds).round();
    if !(1.0..=MAX_FRAMES).contains(&frames) {
        return Err(format!(
            "--fps {} for --seconds {} is {frames} frames; choose 1 to {MAX_FRAMES}",
            arguments.fps, arguments.seconds
        )
        .into());
    }
    let source = SourceName::parse(&arguments.source)?;
    let shutdown = Shutdown::install()?;
    let mut measurements = Vec::new();
    for disturbance in disturbances(arguments.load) {
        for real_time in real_times(arguments.realtime) {
            let rate_hz = arguments.fps;
            let trial = Trial { disturbance, real_time, frames: frames as u64, rate_hz };
            if !arguments.json {
                let scheduling = if real_time { "real time" } else { "ordinary" };
                note(&format!("{}, {scheduling}:", disturbance.name()));
            }
            let display = start_display(arguments.json)?;
            let options = common.without_instance().to_arguments();
            let tried = try_out(config, &trial, &source, &options, log, &shutdown, &mut |p| {
                display.show(p)
            });
            display.finish();
            match tried {
                Err(TrialError::Interrupted) => return Ok(ExitCode::from(INTERRUPTED)),
                tried => measurements.push(tried?),
            }
        }
    }
    print(&match arguments.json {
        true => format!("{}\n", serde_json::to_string_pretty(&measurements)?),
        false => table(&measurements),
    })?;
    Ok(ExitCode::SUCCESS)
}

fn disturbances(beside: Beside) -> Vec<Disturbance> {
    match beside {
        Beside::All => Disturbance::ALL.to_vec(),
        Beside::Idle => vec![Disturbance::Idle],
        Beside::BusyCpus => vec![Disturbance::BusyCpus],
        Beside::SaturatedMapper => vec![Disturbance::SaturatedMapper],
        Beside::SlowReader => vec![Disturbance::SlowReader],
        Beside::DeafReader => vec![Disturbance::DeafReader],
    }
}

fn real_times(real_time: RealTime) -> Vec<bool> {
    match real_time {
        RealTime::Off => vec![false],
        RealTime::On => vec![true],
        RealTime::Both => vec![false, true],
    }
}

/// The measurements as lines; times in milliseconds.
fn table(measurements: &[Measurement]) -> String {
    let mut lines = vec![format!(
        "{:16} {:9} {:>6} {:>28} {:>28} {:>5} {:>5} {:>6} {:>9}",
        "load",
        "schedule",
        "frames",
        "latency p50/p99/p99.9/max",
        "wake p50/p99/p99.9/max",
        "late",
        "drop",
        "faults",
        "stolen ms"
    )];
    let tail = |tail: Option<Percentiles>| {
        tail.map_or("-".to_owned(), |t| {
            format!("{:.2}/{:.2}/{:.2}/{:.2}", t.p50, t.p99, t.p999, t.max)
        })
    };
    for m in measurements {
        lines.push(format!(
            "{:16} {:9} {:>6} {:>28} {:>28} {:>5} {:>5} {:>6} {:>9}",
            m.disturbance.name(),
            if m.real_time { "real time" } else { "ordinary" },
            m.frames,
            tail(m.latency_ms),
            tail(m.wake_ms),
            m.deadline_misses,
            m.dropped,
            m.page_faults,
            m.stolen_ms.map_or("-".to_owned(), |stolen| format!("{stolen:.0}")),
        ));
    }
    if let Some(deadline_ms) = measurements.first().and_then(|m| m.deadline_ms) {
        lines.push(format!(
            "times in ms; late: poses published more than {deadline_ms:.1} ms after their frame arrived; faults: page faults of the warm frame loop"
        ));
    }
    lines.join("\n") + "\n"
}
