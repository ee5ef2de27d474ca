//! `semidense bench`: pose latency, idle and under load, and the behaviour of a long run.

use std::error::Error;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::io::Write;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};

use crate::capture::source_name::{LOOP_RATES_HZ, SourceName};
use crate::command::ending::journal_options;
use crate::command::print::{note, print_as};
use crate::command::run_progress::start_display;
use crate::command::{CommandResult, CommonArguments, INTERRUPTED};
use crate::service::atomic_file::write_atomically;
use crate::service::config::Config;
use crate::service::error_log::ErrorLog;
use crate::service::latency_bench::{Disturbance, Measurement, Trial, TrialError, run_trial};
use crate::service::mode::Mode;
use crate::service::results::times::Percentiles;
use crate::service::shutdown::Shutdown;
use crate::service::soak_bench::{Sample, Soak, Trend, csv, soak, trends};

/// Measure performance on this machine
#[derive(Debug, Args)]
pub struct BenchArguments {
    #[command(subcommand)]
    what: Bench,
}

#[derive(Debug, Subcommand)]
enum Bench {
    Latency(LatencyArguments),
    Soak(SoakArguments),
}

/// Load alongside the pipeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Beside {
    /// Each of the following, one after another
    All,
    /// No load
    Idle,
    /// One busy thread per CPU
    BusyCpus,
    /// A mapper with more work than it can keep up with
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
    /// Source to play back and forth; the default, a simulated room, is rendered first
    #[arg(long, value_name = "SOURCE", default_value = "sim")]
    source: OsString,
    /// Frames per second
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    fps: f64,
    /// Duration of each trial in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0)]
    seconds: f64,
    /// Load alongside the pipeline
    #[arg(long, value_enum, default_value_t = Beside::All)]
    load: Beside,
    /// Scheduling of capture and tracker
    #[arg(long, value_enum, default_value_t = RealTime::Both)]
    realtime: RealTime,
    /// Print JSON, one object per trial
    #[arg(long)]
    json: bool,
}

/// Run a source back and forth for a long time and report memory, time per frame and keyframes over time
///
/// The table lists each quantity's mean over the second and the last quarter of the run, and its slope per
/// hour after the first quarter.
#[derive(Debug, Args)]
pub struct SoakArguments {
    /// Source to play back and forth: its first 640 MB, 2184 frames at 640x480 (more than a round of the default flat)
    #[arg(long, value_name = "SOURCE", default_value = "sim:flat")]
    source: OsString,
    /// Number of frames; 108000 is an hour at 30 Hz
    #[arg(long, value_name = "N", default_value_t = 108_000)]
    frames: u64,
    /// Frames per second
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    fps: f64,
    /// Process every frame in order, as fast as possible, instead of live
    #[arg(long)]
    lockstep: bool,
    /// Time from one sample to the next in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0)]
    every: f64,
    /// Write the samples to FILE as comma-separated values
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Print the trends as JSON
    #[arg(long)]
    json: bool,
}

/// Upper limit for the frames of a trial: a day at 60 Hz; poses are kept until its end.
const MAX_FRAMES: f64 = 5_184_000.0;

/// Runs the chosen benchmark.
pub fn run(
    config: &Config,
    common: &CommonArguments,
    log: &ErrorLog,
    arguments: BenchArguments,
) -> CommandResult {
    match arguments.what {
        Bench::Latency(arguments) => run_latency(config, common, log, &arguments),
        Bench::Soak(arguments) => run_soak(config, common, log, &arguments),
    }
}

fn check_rate(rate_hz: f64) -> Result<(), String> {
    match LOOP_RATES_HZ.contains(&rate_hz) {
        true => Ok(()),
        false => Err(format!("--fps {rate_hz}: choose {LOOP_RATES_HZ:?}")),
    }
}

/// The source that a benchmark plays back and forth.
fn repeated(name: &OsStr) -> Result<SourceName, Box<dyn Error>> {
    match SourceName::parse(name)? {
        SourceName::Looped { inner, .. } => Err(format!(
            "--source {}: a benchmark repeats its source by itself; name {inner} and the rate with --fps",
            name.display()
        )
        .into()),
        source => Ok(source),
    }
}

fn run_soak(
    config: &Config,
    common: &CommonArguments,
    log: &ErrorLog,
    arguments: &SoakArguments,
) -> CommandResult {
    /// From one sample per report of the processes to one per hour.
    const PERIODS_S: RangeInclusive<f64> = 1.0..=3600.0;
    let (frames, rate_hz) = (arguments.frames, arguments.fps);
    if !(1..=MAX_FRAMES as u64).contains(&frames) {
        return Err(format!("--frames {frames}: choose 1 to {MAX_FRAMES}").into());
    }
    check_rate(rate_hz)?;
    if !PERIODS_S.contains(&arguments.every) {
        return Err(format!("--every {}: choose {PERIODS_S:?} seconds", arguments.every).into());
    }
    let mode = if arguments.lockstep { Mode::Lockstep } else { Mode::Live };
    let period = Duration::from_secs_f64(arguments.every);
    let source = repeated(&arguments.source)?;
    let shutdown = Shutdown::install()?;
    let display = start_display(arguments.json)?;
    let options = common.without_instance().to_arguments();
    let output = std::env::temp_dir().join(format!("semidense-soak-{}", std::process::id()));
    fs::create_dir(&output)
        .map_err(|error| format!("{}: cannot be created ({error})", output.display()))?;
    let journal = journal_options(config, &source, None, &output);
    let soaked = Soak { frames, rate_hz, mode, period, journal };
    let samples =
        soak(config, &soaked, &source, &options, log, &shutdown, &mut |p| display.show(p));
    display.finish();
    drop(fs::remove_dir_all(&output));
    let samples = samples?;
    if let Some(path) = &arguments.csv {
        write_atomically(path, |file| file.write_all(csv(&samples).as_bytes()))
            .map_err(|error| format!("{}: cannot be written ({error})", path.display()))?;
    }
    let trends = trends(&samples);
    print_as(arguments.json, &trends, |trends| trend_table(&samples, trends))?;
    Ok(if shutdown.is_requested() { ExitCode::from(INTERRUPTED) } else { ExitCode::SUCCESS })
}

/// Formats the trends as a table.
fn trend_table(samples: &[Sample], trends: &[Trend]) -> String {
    let Some(last) = samples.last().filter(|_| !trends.is_empty()) else {
        return "too short for a trend: fewer than four samples\n".to_owned();
    };
    let mut lines = vec![
        format!("{} frames, {} dropped, {:.0} s", last.frames, last.dropped, last.seconds),
        format!("{:16} {:>14} {:>14} {:>14}", "", "second quarter", "last quarter", "per hour"),
    ];
    lines.extend(trends.iter().map(|trend| {
        let Trend { name, second_quarter, last_quarter, per_hour } = trend;
        format!("{name:16} {second_quarter:>14.2} {last_quarter:>14.2} {per_hour:>+14.2}")
    }));
    lines.join("\n") + "\n"
}

fn run_latency(
    config: &Config,
    common: &CommonArguments,
    log: &ErrorLog,
    arguments: &LatencyArguments,
) -> CommandResult {
    check_rate(arguments.fps)?;
    let frames = (arguments.fps * arguments.seconds).round();
    if !(1.0..=MAX_FRAMES).contains(&frames) {
        return Err(format!(
            "--fps {} for --seconds {} is {frames} frames; choose 1 to {MAX_FRAMES}",
            arguments.fps, arguments.seconds
        )
        .into());
    }
    let source = repeated(&arguments.source)?;
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
            let tried = run_trial(config, &trial, &source, &options, log, &shutdown, &mut |p| {
                display.show(p)
            });
            display.finish();
            match tried {
                Err(TrialError::Interrupted) => return Ok(ExitCode::from(INTERRUPTED)),
                tried => measurements.push(tried?),
            }
        }
    }
    print_as(arguments.json, &measurements, |all| table(all))?;
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

/// Formats the measurements as a table; times in milliseconds.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_repeated_is_refused_before_anything_starts() {
        for rate_hz in [1e9, 0.0, -30.0, f64::NAN, f64::INFINITY] {
            let error = check_rate(rate_hz).unwrap_err();
            assert!(error.starts_with(&format!("--fps {rate_hz}: choose 0.01..=10000")), "{error}");
        }
        assert!(check_rate(0.01).is_ok() && check_rate(10_000.0).is_ok());
        let error = repeated(OsStr::new("loop:9:30:sim:flat")).unwrap_err().to_string();
        assert!(error.starts_with("--source loop:9:30:sim:flat: "), "{error}");
        assert!(error.contains("name sim:flat and the rate with --fps"), "{error}");
        assert_eq!(repeated(OsStr::new("sim")).unwrap(), SourceName::Simulator { scene: None });
    }
}
