//! `semidense view`, `record`, `ros2`, `zenoh`: hand over to `semidense-bridge`, a program and package of its own.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use clap::Args;

use crate::capture::stream::INSTALL_BRIDGE;
use crate::command::{CommandResult, CommonArguments};

/// The program that they are in.
const PROGRAM: &str = "semidense-bridge";

/// What goes to the program as it stands: its own command line explains and checks it.
#[derive(Debug, Args)]
#[command(disable_help_flag = true)]
pub struct BridgeArguments {
    /// Arguments of the command; `--help` explains them
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    arguments: Vec<OsString>,
}

/// Why the program cannot be handed over to.
#[derive(Debug, thiserror::Error)]
pub enum BridgeError {
    /// It is nowhere.
    #[error(
        "`semidense {command}` needs {PROGRAM}, which is neither beside {own} nor on the PATH: {INSTALL_BRIDGE}"
    )]
    Missing {
        /// The command that was given.
        command: String,
        /// This program.
        own: PathBuf,
    },
    /// It has no `--set`: the subcommand.
    #[error(
        "`semidense {0}` has no --set: write it into a configuration file and name that with --config"
    )]
    Set(&'static str),
    /// It does not start.
    #[error("cannot start {program}: {source}")]
    Start {
        /// The program.
        program: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
}

/// Becomes `semidense-bridge COMMAND ARGUMENTS`, with the options that every command has.
pub fn run(
    common: &CommonArguments,
    command: &'static str,
    arguments: &BridgeArguments,
) -> CommandResult {
    if !common.set.is_empty() {
        return Err(BridgeError::Set(command).into());
    }
    let program = bridge(command)?;
    let source = Command::new(&program)
        // Its help and its errors then name the command that was typed.
        .arg0("semidense")
        .args(common.of_bridge())
        .arg(command)
        .args(&arguments.arguments)
        .exec();
    Err(BridgeError::Start { program, source }.into())
}

/// The program, for `command`.
pub fn bridge(command: &str) -> Result<PathBuf, BridgeError> {
    let own = std::env::current_exe().unwrap_or_else(|_| PathBuf::from("semidense"));
    program(&own).ok_or_else(|| BridgeError::Missing { command: command.to_owned(), own })
}

/// The program: beside our own, which was installed or built with it, else on the path.
fn program(own: &Path) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let beside = own.parent().map(Path::to_owned);
    beside
        .into_iter()
        .chain(std::env::split_paths(&path))
        .map(|f| f.join(PROGRAM))
        .find(|p| p.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_program_beside_ours_comes_first() {
        let folder = tempfile::tempdir().unwrap();
        let own = folder.path().join("semidense");
        let beside = folder.path().join(PROGRAM);
        assert_ne!(program(&own), Some(beside.clone()));
        std::fs::write(&beside, "").unwrap();
        assert_eq!(program(&own), Some(beside));
    }

    #[test]
    fn a_missing_program_is_said_alike_by_whoever_needs_it() {
        let error = BridgeError::Missing { command: "ros2".to_owned(), own: "/x/semidense".into() };
        let error = error.to_string();
        assert!(error.contains("neither beside /x/semidense nor on the PATH"), "{error}");
        assert!(error.contains(INSTALL_BRIDGE) && INSTALL_BRIDGE.contains(PROGRAM), "{error}");
    }
}
