//! `semidense view`, `record`, `ros2`, `zenoh`: hand over to `semidense-bridge`, a separate program and package.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use clap::Args;

use crate::capture::stream::INSTALL_BRIDGE;
use crate::command::{CommandResult, CommonArguments};

/// The program that implements these commands.
const PROGRAM: &str = "semidense-bridge";

/// Arguments passed on unchanged: the bridge's own command line explains and checks them.
#[derive(Debug, Args)]
#[command(disable_help_flag = true)]
pub struct BridgeArguments {
    /// Arguments of the command; `--help` explains them
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    arguments: Vec<OsString>,
}

/// Replaces this process with `semidense-bridge COMMAND ARGUMENTS`, with the options common to all commands.
pub fn run(
    common: &CommonArguments,
    command: &'static str,
    arguments: &BridgeArguments,
) -> CommandResult {
    if !common.set.is_empty() {
        return Err(format!(
            "`semidense {command}` has no --set: set it in a configuration file and name that with --config"
        )
        .into());
    }
    let program = bridge(command)?;
    let error = Command::new(&program)
        // So that its help and its errors name the command that was typed.
        .arg0("semidense")
        .args(common.of_bridge())
        .arg(command)
        .args(&arguments.arguments)
        .exec();
    Err(format!("cannot start {}: {error}", program.display()).into())
}

/// Path of the bridge, for an error that names `command`.
pub fn bridge(command: &str) -> Result<PathBuf, String> {
    let own = std::env::current_exe().unwrap_or_else(|_| PathBuf::from("semidense"));
    program(&own).ok_or_else(|| missing_text(command, &own))
}

fn missing_text(command: &str, own: &Path) -> String {
    let own = own.display();
    format!(
        "`semidense {command}` needs {PROGRAM}, which is neither next to {own} nor on the PATH: {INSTALL_BRIDGE}"
    )
}

/// Path of the bridge: next to our own program, with which it was installed or built, else on the `PATH`.
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
    fn the_program_next_to_ours_takes_precedence() {
        let folder = tempfile::tempdir().unwrap();
        let own = folder.path().join("semidense");
        let beside = folder.path().join(PROGRAM);
        assert_ne!(program(&own), Some(beside.clone()));
        std::fs::write(&beside, "").unwrap();
        assert_eq!(program(&own), Some(beside));
    }

    #[test]
    fn the_error_for_a_missing_program_names_both_places_and_the_package() {
        let error = missing_text("ros2", Path::new("/x/semidense"));
        assert!(error.contains("neither next to /x/semidense nor on the PATH"), "{error}");
        assert!(error.contains(INSTALL_BRIDGE) && INSTALL_BRIDGE.contains(PROGRAM), "{error}");
    }
}
