//! The command line: one short file per subcommand in `command/`.

pub mod record;
#[cfg(feature = "ros2")]
pub mod ros2;
mod view;
#[cfg(feature = "zenoh")]
pub mod zenoh;

use std::error::Error;
use std::io::{IsTerminal, Write};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::str::FromStr;

use clap::{Args, CommandFactory, Parser, Subcommand};
use semidense::service::config::{Config, SYSTEM_FOLDER, file_for};
use semidense::wire::place::Place;
use tracing_subscriber::EnvFilter;

/// Help heading of the options common to all commands.
const COMMON: &str = "Common options";

/// A command's exit code, or its error as one line for the user.
pub type CommandResult = Result<ExitCode, Box<dyn Error>>;

#[derive(Debug, Parser)]
#[command(
    name = "semidense-bridge",
    version,
    about = "semidense out of shared memory: live page, recordings, ROS 2, a second machine",
    after_help = "Each command reads the topics of a running instance; start one with `semidense run`.\n\
                  `semidense view`, `record`, `ros2` and `zenoh` call this program.\n\n\
                  Exit codes: 0 done, 1 failed, 2 wrong usage."
)]
struct CommandLine {
    #[command(flatten)]
    common: CommonArguments,
    #[command(subcommand)]
    command: Subcommands,
}

/// Options common to all commands, as in `semidense`.
#[derive(Debug, Clone, Args)]
pub struct CommonArguments {
    /// Configuration file [default: /etc/semidense/NAME.toml for the instance NAME, else
    /// /etc/semidense/semidense.toml, if it exists]
    #[arg(long, global = true, help_heading = COMMON, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Name of the instance [default: semidense]
    #[arg(long, global = true, help_heading = COMMON, value_name = "NAME")]
    pub instance: Option<String>,
    /// Log level on standard error: error, warn, info, debug or trace
    #[arg(long, global = true, help_heading = COMMON, value_name = "LEVEL", default_value = "warn")]
    pub log: String,
}

impl CommonArguments {
    /// Place of the instance, from command line, configuration and environment.
    pub fn place(&self) -> Result<Place, Box<dyn Error>> {
        let named: Vec<String> =
            self.instance.iter().map(|name| format!("instance={name:?}")).collect();
        let usual = || file_for(Path::new(SYSTEM_FOLDER), self.instance.as_deref());
        let config = Config::load(self.config.clone().or_else(usual).as_deref(), &named)?;
        Ok(Place::new(&config.instance, &config.root)?)
    }
}

#[derive(Debug, Subcommand)]
enum Subcommands {
    View(view::ViewArguments),
    #[cfg(feature = "ros2")]
    Ros2(ros2::Ros2Arguments),
    #[cfg(feature = "ros2")]
    Ros2Camera(ros2::Ros2CameraArguments),
    Record(record::RecordArguments),
    #[cfg(feature = "zenoh")]
    Zenoh(zenoh::ZenohArguments),
}

/// The command line, for the manual and completions.
pub fn command_line() -> clap::Command {
    CommandLine::command()
}

/// Parses the command line and runs the chosen subcommand.
pub fn main() -> ExitCode {
    let line = CommandLine::parse();
    run(line).unwrap_or_else(|error| {
        let line = error.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
        note(&format!("error: {line}"));
        ExitCode::FAILURE
    })
}

/// Prints a line for the user. A closed standard error is ignored: the failure could not be reported.
fn note(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Parses a number within `range`; the error text is `wanted`.
fn number_within<T: FromStr + PartialOrd>(
    text: &str,
    range: RangeInclusive<T>,
    wanted: &str,
) -> Result<T, String> {
    text.parse().ok().filter(|number| range.contains(number)).ok_or_else(|| wanted.to_owned())
}

fn run(line: CommandLine) -> CommandResult {
    // Zenoh warns of scouting that is disabled on purpose; the ROS 2 middleware warns endlessly where
    // loopback has no multicast, as is usual.
    let log = format!("zenoh=error,rustdds=off,ros2_client=off,{}", line.common.log);
    let filter =
        EnvFilter::try_new(&log).map_err(|error| format!("--log {}: {error}", line.common.log))?;
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .init();
    match line.command {
        Subcommands::View(arguments) => view::run(&line.common, &arguments),
        #[cfg(feature = "ros2")]
        Subcommands::Ros2(arguments) => ros2::run(&line.common, &arguments),
        #[cfg(feature = "ros2")]
        Subcommands::Ros2Camera(arguments) => ros2::run_camera(&arguments),
        Subcommands::Record(arguments) => record::run(&line.common, &arguments),
        #[cfg(feature = "zenoh")]
        Subcommands::Zenoh(arguments) => zenoh::run(&line.common, &arguments),
    }
}
