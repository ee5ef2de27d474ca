//! The program: passes the command line to `command` and returns its exit code.

use std::process::ExitCode;

fn main() -> ExitCode {
    semidense::command::main()
}
