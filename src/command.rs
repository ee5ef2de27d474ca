//! The command line: arguments → configuration → shell → exit code.
//!
//! Exit codes: 0 done, 1 failed (one line states what, where and what to do), 2 the command line is invalid, 3 nothing
//! was tracked (one line gives the reason), 130 interrupted (results so far are written).

pub(crate) mod bench;
pub(crate) mod bridge;
pub(crate) mod cameras;
pub(crate) mod capture;
pub(crate) mod config;
pub(crate) mod doctor;
pub(crate) mod ending;
pub(crate) mod evaluate;
mod evaluate_text;
pub(crate) mod map;
pub(crate) mod map_points;
pub(crate) mod mapper;
pub(crate) mod parse;
pub(crate) mod print;
pub(crate) mod progress;
pub(crate) mod recover;
pub(crate) mod replay;
pub(crate) mod ros2_rig;
pub(crate) mod run;
pub(crate) mod run_progress;
pub(crate) mod simulate;
pub(crate) mod status;
pub(crate) mod status_text;
pub(crate) mod tracker;

use std::error::Error;
use std::ffi::{OsStr, OsString};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::FmtSpan;
use tracing_subscriber::prelude::*;

use crate::capture::source_error::SourceError;
use crate::command::print::{PrintError, note};
use crate::service::child::{ERROR_PREFIX, follow_supervisor, tidy_up};
use crate::service::config::{Config, SYSTEM_FOLDER, file_for};
use crate::service::error_log::ErrorLog;
use crate::wire::limits::check_address_space;
use crate::wire::place::Place;

/// Exit code of an interrupted run: 128 + SIGINT, as in shells.
const INTERRUPTED: u8 = 130;

/// Exit code of a run that has tracked nothing.
const NOTHING_TRACKED: u8 = 3;

/// Longest wait at the end of a command for its log to be written.
const LAST_LINES: Duration = Duration::from_secs(1);

/// Heading of the options that every command has.
const COMMON: &str = "Common options";

/// Result of a command; its error is one line for the user.
pub type CommandResult = Result<ExitCode, Box<dyn Error>>;

#[derive(Debug, Parser)]
#[command(
    name = "semidense",
    version,
    about = "Real-time semi-dense direct visual SLAM for robot computers",
    after_help = "Start with `semidense run`: it simulates a camera in a furnished room, tracks it, maps the room,\n\
                  and writes trajectory, map and report into a new folder under ./output.\n\
                  Then `semidense run DIR` for a recording, `semidense run v4l:0 --rig FILE` for a camera.\n\n\
                  Exit codes: 0 done, 1 failed, 2 wrong usage, 3 nothing was tracked, 130 interrupted before the end (results so far are written)."
)]
struct CommandLine {
    #[command(flatten)]
    common: CommonArguments,
    #[command(subcommand)]
    command: Subcommands,
}

/// Options that every command has.
#[derive(Debug, Clone, Args)]
pub struct CommonArguments {
    /// Configuration file [default: /etc/semidense/NAME.toml for the instance NAME, else
    /// /etc/semidense/semidense.toml, if it exists]
    #[arg(long, global = true, help_heading = COMMON, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Set one configuration key, e.g. mapper.threads=2; may be repeated
    #[arg(long, global = true, help_heading = COMMON, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Name of the instance; instances with different names run side by side [default: semidense]
    #[arg(long, global = true, help_heading = COMMON, value_name = "NAME")]
    pub instance: Option<String>,
    /// What to log: error, warn, info, debug or trace, also per module (semidense::service=debug)
    #[arg(long, global = true, help_heading = COMMON, value_name = "LEVEL", default_value = "warn")]
    pub log: String,
    /// How to log: text or JSON lines on standard error, or the systemd journal
    #[arg(long, global = true, help_heading = COMMON, value_name = "FORMAT", value_enum, default_value_t)]
    pub log_format: LogFormat,
}

/// How to log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum LogFormat {
    /// Lines of text on standard error
    #[default]
    Text,
    /// One JSON object per line on standard error
    Json,
    /// The systemd journal, with its fields
    Journald,
}

impl CommonArguments {
    /// Settings on the command line, in the form of `--set`.
    fn settings(&self) -> Vec<String> {
        let named = self.instance.iter().map(|name| format!("instance={name:?}"));
        self.set.iter().cloned().chain(named).collect()
    }

    /// The configuration file: the named one, else the default one.
    fn file(&self) -> Option<PathBuf> {
        let usual = || file_for(Path::new(SYSTEM_FOLDER), self.instance.as_deref());
        self.config.clone().or_else(usual)
    }

    /// The same options without the instance.
    fn without_instance(&self) -> Self {
        Self { config: self.file(), instance: None, ..self.clone() }
    }

    /// The same options for a child process.
    fn to_arguments(&self) -> Vec<OsString> {
        let mut arguments = self.of_bridge();
        let mut push = |option: &str, value: &str| arguments.extend([option.into(), value.into()]);
        let format = self.log_format.to_possible_value();
        format.iter().for_each(|format| push("--log-format", format.get_name()));
        self.set.iter().for_each(|setting| push("--set", setting));
        arguments
    }

    /// Those options that `semidense-bridge` also has.
    fn of_bridge(&self) -> Vec<OsString> {
        let mut arguments: Vec<OsString> = Vec::new();
        let mut push =
            |option: &str, value: &OsStr| arguments.extend([option.into(), value.into()]);
        push("--log", self.log.as_ref());
        self.config.iter().for_each(|file| push("--config", file.as_ref()));
        self.instance.iter().for_each(|name| push("--instance", name.as_ref()));
        arguments
    }
}

#[derive(Debug, Subcommand)]
enum Subcommands {
    Run(run::RunArguments),
    Capture(capture::CaptureArguments),
    Tracker(tracker::TrackerArguments),
    Mapper(mapper::MapperArguments),
    Replay(replay::ReplayArgs),
    Map(map::MapArguments),
    Recover(recover::RecoverArguments),
    Simulate(Box<simulate::SimulateArgs>),
    Evaluate(evaluate::EvaluateArgs),
    Status(status::StatusArguments),
    Config(config::ConfigArguments),
    Bench(bench::BenchArguments),
    Doctor(doctor::DoctorArguments),
    Cameras(cameras::CamerasArguments),
    /// Serve a live web page: camera, map, state, latencies [in the package semidense-bridge]
    View(bridge::BridgeArguments),
    /// Record images, poses, keyframes and health into an MCAP file [in the package semidense-bridge]
    Record(bridge::BridgeArguments),
    /// Publish to ROS 2 without ROS being installed [in the package semidense-bridge]
    Ros2(bridge::BridgeArguments),
    /// Send to another machine, or receive there, over Zenoh [in the package semidense-bridge]
    Zenoh(bridge::BridgeArguments),
}

/// The command line as a `clap` command, from which man page and shell completions are generated.
pub fn command_line() -> clap::Command {
    CommandLine::command()
}

/// Parses the command line and runs the chosen subcommand.
pub fn main() -> ExitCode {
    let line: CommandLine = parse::parse();
    let log = match ErrorLog::start() {
        Ok(log) => log,
        Err(error) => {
            note(&format!("{ERROR_PREFIX}cannot start the log thread ({error})"));
            return ExitCode::FAILURE;
        }
    };
    let outcome = run_subcommand(line, &log);
    // Waits so that the final messages follow the log.
    log.wait_written(LAST_LINES);
    if log.dropped_lines() > 0 {
        let dropped = log.dropped_lines();
        note(&format!(
            "warning: {dropped} log lines were dropped because standard error was not read in time"
        ));
    }
    outcome.unwrap_or_else(|error| {
        if error.downcast_ref::<PrintError>().is_some_and(PrintError::is_reader_gone) {
            return ExitCode::SUCCESS;
        }
        let line = error.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
        note(&format!("{ERROR_PREFIX}{line}"));
        if let Some(command) = error.downcast_ref().and_then(SourceError::command) {
            note(&format!("  {command}"));
        }
        ExitCode::FAILURE
    })
}

/// Reads the configuration and runs the chosen subcommand.
fn run_subcommand(line: CommandLine, log: &ErrorLog) -> CommandResult {
    let config = prepare(&line.common, log)?;
    let place = Place::new(&config.instance, &config.root)?;
    if let Some(occupied) = &place.occupied {
        note(&format!(
            "warning: {} is not private to this user; using {} instead",
            occupied.display(),
            place.root.display()
        ));
    }
    let outcome = match line.command {
        Subcommands::Run(arguments) => run::run(&config, &line.common, log, arguments),
        Subcommands::Capture(arguments) => capture::run(&config, arguments),
        Subcommands::Tracker(arguments) => tracker::run(&config, arguments),
        Subcommands::Mapper(arguments) => mapper::run(&config, arguments),
        Subcommands::Replay(arguments) => replay::run(&config, arguments),
        Subcommands::Map(arguments) => map::run(&config, arguments),
        Subcommands::Recover(arguments) => recover::run(&config, &arguments),
        Subcommands::Simulate(arguments) => simulate::run(&config, &arguments),
        Subcommands::Evaluate(arguments) => evaluate::run(&arguments),
        Subcommands::Status(arguments) => status::run(&config, arguments),
        Subcommands::Config(arguments) => config::run(&line.common, &arguments),
        Subcommands::Cameras(arguments) => cameras::run(arguments),
        Subcommands::Doctor(arguments) => doctor::run(&config, arguments),
        Subcommands::Bench(arguments) => bench::run(&config, &line.common, log, arguments),
        Subcommands::View(arguments) => bridge::run(&line.common, "view", &arguments),
        Subcommands::Record(arguments) => bridge::run(&line.common, "record", &arguments),
        Subcommands::Ros2(arguments) => bridge::run(&line.common, "ros2", &arguments),
        Subcommands::Zenoh(arguments) => bridge::run(&line.common, "zenoh", &arguments),
    };
    tidy_up(&place);
    outcome
}

/// Parses the filter of `--log`. A single word must be a level: the filter's own parser takes every other word for the
/// name of a module, and then nothing of the program is logged.
fn log_filter(text: &str) -> Result<EnvFilter, String> {
    const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
    let form =
        "write error, warn, info, debug or trace, or module=level as in semidense::service=debug";
    let is_level = |word: &str| LEVELS.iter().any(|level| level.eq_ignore_ascii_case(word.trim()));
    for directive in text.split(',') {
        let level = directive.rsplit_once('=').map_or(directive, |(_, level)| level);
        if !is_level(level) {
            return Err(format!("--log {text}: `{}` is not a log level; {form}", level.trim()));
        }
    }
    EnvFilter::try_new(text).map_err(|error| format!("--log {text}: {error}; {form}"))
}

/// Starts the log. Spans are logged when they end, with their duration, if the level includes them.
fn start_log(filter: EnvFilter, format: LogFormat, log: &ErrorLog) -> Result<(), Box<dyn Error>> {
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(log.clone())
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .with_span_events(FmtSpan::CLOSE);
    let registry = tracing_subscriber::registry().with(filter);
    match format {
        LogFormat::Text => registry.with(lines).init(),
        LogFormat::Json => registry.with(lines.json()).init(),
        LogFormat::Journald => {
            let journal = tracing_journald::layer().map_err(|error| {
                format!("--log-format journald: there is no systemd journal here ({error})")
            })?;
            registry.with(journal).init();
        }
    }
    Ok(())
}

fn prepare(common: &CommonArguments, log: &ErrorLog) -> Result<Config, Box<dyn Error>> {
    follow_supervisor()?;
    check_address_space(0)?;
    start_log(log_filter(&common.log)?, common.log_format, log)?;
    let config = Config::load(common.file().as_deref(), &common.settings())?;
    tracing::info!("configuration:\n{}", config.to_text());
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::log_filter;

    #[test]
    fn only_levels_are_accepted_as_log_levels() {
        for good in ["warn", "INFO", "off", "warn,semidense::service=debug", "semidense=trace"] {
            assert!(log_filter(good).is_ok(), "{good}");
        }
        for bad in ["nonsense", "warn,nonsense", "semidense=loud", "", "3", "warn,"] {
            let error = log_filter(bad).unwrap_err();
            assert!(error.starts_with(&format!("--log {bad}: ")), "{error}");
            assert!(error.contains("warn, info") && !error.contains('\n'), "{error}");
        }
    }
}
