//! `semidense capture`: frames into shared memory.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use crate::capture::source::SourceName;
use crate::command::{CommandResult, INTERRUPTED};
use crate::service::capture::{CaptureError, CaptureOptions, run as run_shell};
use crate::service::config::Config;
use crate::service::mode::Mode;
use crate::service::shutdown::Shutdown;

/// Send frames from a source into shared memory
#[derive(Debug, Args)]
pub struct CaptureArguments {
    /// Where frames come from: sim, sim:SCENE, tum:DIR, euroc:DIR or images:DIR
    #[arg(long, value_name = "SOURCE", default_value = "sim")]
    pub source: String,
    /// Rig file with the camera's calibration
    #[arg(long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    /// Lockstep or live.
    #[command(flatten)]
    pub mode: ModeArguments,
}

/// How frames are paced.
#[derive(Debug, Clone, Copy, Args)]
pub struct ModeArguments {
    /// Every frame in order, the same result on every run [default for recordings and simulator]
    #[arg(long, conflicts_with = "live")]
    pub lockstep: bool,
    /// At the pace of the stamps, the newest frame wins [default for cameras]
    #[arg(long)]
    pub live: bool,
}

impl ModeArguments {
    /// The mode asked for, or the usual one.
    pub fn mode(self, usual: Mode) -> Mode {
        match (self.lockstep, self.live) {
            (true, _) => Mode::Lockstep,
            (_, true) => Mode::Live,
            _ => usual,
        }
    }
}

/// The usual mode of a source.
pub fn usual_mode(source: &SourceName) -> Mode {
    if source.is_camera() { Mode::Live } else { Mode::Lockstep }
}

/// Runs it.
pub fn run(config: &Config, arguments: CaptureArguments) -> CommandResult {
    let source: SourceName = arguments.source.parse()?;
    let mode = arguments.mode.mode(usual_mode(&source));
    let shutdown = Shutdown::install()?;
    let options = CaptureOptions { source, rig: arguments.rig, mode };
    match run_shell(config, &options, &shutdown) {
        Ok(()) => Ok(ExitCode::SUCCESS),
        Err(CaptureError::Interrupted) => Ok(ExitCode::from(INTERRUPTED)),
        Err(error) => Err(error.into()),
    }
}
