//! Figures of the depth filters alone.
//!
//! ```text
//! cargo run --release --example depth_figures -- interval
//! ```

mod interval;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Figures of the depth filters.
#[derive(Debug, Parser)]
struct Arguments {
    #[command(subcommand)]
    figure: Figure,
}

#[derive(Debug, Subcommand)]
enum Figure {
    /// How the intervals of some points narrow from frame to frame, compared with their true inverse depth.
    Interval(interval::Arguments),
}

fn main() -> ExitCode {
    let outcome = match Arguments::parse().figure {
        Figure::Interval(arguments) => interval::run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("depth_figures: {error}");
            ExitCode::FAILURE
        }
    }
}
