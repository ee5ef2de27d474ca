//! `semidense mapper`: estimates the semi-dense map.

use std::process::ExitCode;

use clap::Args;

use crate::command::CommandResult;
use crate::command::capture::ModeArguments;
use crate::command::map::MapOptions;
use crate::service::config::Config;
use crate::service::mapper::run as run_shell;
use crate::service::mode::Mode;
use crate::service::shutdown::Shutdown;

/// Estimate the depth of keyframes and publish the map
#[derive(Debug, Args)]
pub struct MapperArguments {
    #[command(flatten)]
    mode: ModeArguments,
    #[command(flatten)]
    map: MapOptions,
}

/// Runs the mapper process.
pub fn run(config: &Config, arguments: MapperArguments) -> CommandResult {
    let shutdown = Shutdown::install()?;
    let config = &Config { map: arguments.map.of(config)?, ..config.clone() };
    run_shell(config, arguments.mode.mode(Mode::Live), &shutdown)?;
    Ok(ExitCode::SUCCESS)
}
