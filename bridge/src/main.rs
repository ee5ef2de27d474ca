//! The binary: hands the command line to [`semidense_bridge::command`] and returns its exit code.

use std::process::ExitCode;

fn main() -> ExitCode {
    semidense_bridge::command::main()
}
