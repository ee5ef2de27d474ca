//! Figures of the alignment alone: keyframes take their depth from the source (exact for the simulator, the sensor's
//! for recordings), with noise that matches their variance.
//!
//! ```text
//! cargo run --release --example alignment_figures -- accuracy tum:DIR
//! cargo run --release --example alignment_figures -- covariance
//! cargo run --release --example alignment_figures -- basin
//! ```

mod accuracy;
mod basin;
mod covariance;
mod sequence;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Figures of the alignment with known depth.
#[derive(Debug, Parser)]
struct Arguments {
    #[command(subcommand)]
    figure: Figure,
}

#[derive(Debug, Subcommand)]
enum Figure {
    /// Relative pose error, normalised errors and times for one source.
    Accuracy(accuracy::Arguments),
    /// Fits the inflation of the covariance on some simulated scenes and validates it on others.
    Covariance(covariance::Arguments),
    /// Share of random starts that converge, by their distance, with and without depth variance.
    Basin(basin::Arguments),
}

fn main() -> ExitCode {
    let outcome = match Arguments::parse().figure {
        Figure::Accuracy(arguments) => accuracy::run(&arguments),
        Figure::Covariance(arguments) => covariance::run(&arguments),
        Figure::Basin(arguments) => basin::run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("alignment_figures: {error}");
            ExitCode::FAILURE
        }
    }
}
