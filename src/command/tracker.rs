//! `semidense tracker`: computes one pose for each frame.

use std::process::ExitCode;

use clap::Args;

use crate::command::CommandResult;
use crate::command::capture::ModeArguments;
use crate::service::config::Config;
use crate::service::mode::Mode;
use crate::service::shutdown::Shutdown;
use crate::service::tracker::run as run_shell;

/// Track every frame against the active keyframe and publish its pose
#[derive(Debug, Args)]
pub struct TrackerArguments {
    #[command(flatten)]
    mode: ModeArguments,
}

/// Runs the tracker process.
pub fn run(config: &Config, arguments: TrackerArguments) -> CommandResult {
    let shutdown = Shutdown::install()?;
    run_shell(config, arguments.mode.mode(Mode::Live), &shutdown)?;
    Ok(ExitCode::SUCCESS)
}
