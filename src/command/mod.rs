//! The command line: arguments → configuration → shell → exit code.

pub mod evaluate;
pub mod progress;
pub mod replay;
pub mod simulate;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Real-time semi-dense direct visual SLAM for robot computers
#[derive(Debug, Parser)]
#[command(name = "semidense", version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Evaluate(evaluate::EvaluateArgs),
    Replay(replay::ReplayArgs),
    Simulate(simulate::SimulateArgs),
}

/// Parses the command line and runs the chosen subcommand.
pub fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Evaluate(arguments) => evaluate::run(&arguments),
        Command::Replay(arguments) => replay::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
    };
    result.unwrap_or_else(|error| {
        eprintln!("semidense: {error}");
        ExitCode::FAILURE
    })
}
