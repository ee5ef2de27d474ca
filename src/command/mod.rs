//! The command line: arguments → configuration → shell → exit code.

pub mod progress;
pub mod simulate;

use std::process::ExitCode;

/// Parses the command line and runs the chosen subcommand.
pub fn main() -> ExitCode {
    ExitCode::SUCCESS
}
