//! Figures of place recognition: frames of a sequence as keyframes, the earlier ones found by the later ones, judged by
//! what both see by the truth.
//!
//! ```text
//! cargo run --release --example place_figures -- sim:room --frames 600 --stride 10
//! cargo run --release --example place_figures -- tum:DIR --truth DIR/orbslam2.txt --depths 0.1,0.2,0.4
//! ```

mod ferns;
mod footage;
mod judge;
mod methods;
mod verify;

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use semidense::capture::source_name::SourceName;

use crate::footage::Footage;
use crate::methods::{Kind, Scores};

/// Finds places of a sequence again by several methods.
#[derive(Debug, Parser)]
struct Arguments {
    /// Source of the frames.
    source: SourceName,
    /// Every so many frames is a keyframe.
    #[arg(long, default_value_t = 10)]
    stride: usize,
    /// Frames read of it.
    #[arg(long)]
    frames: Option<usize>,
    /// Seed of the simulator.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Trajectory in place of the source's ground truth.
    #[arg(long)]
    truth: Option<PathBuf>,
    /// Depths that are assumed where the source has none, lengths of the truth.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0, 2.0, 4.0])]
    depths: Vec<f64>,
    /// Keyframes that must lie between a query and what it may find.
    #[arg(long, default_value_t = 10)]
    gap: usize,
    /// Methods to compare.
    #[arg(long, value_delimiter = ',', value_enum, default_values_t = [Kind::Tree, Kind::Small, Kind::Ferns])]
    methods: Vec<Kind>,
    /// File with the scores of another method: a line for each query, a number for each keyframe.
    #[arg(long)]
    scores: Option<PathBuf>,
    /// Folder to write the keyframes to as PGM files, for other methods.
    #[arg(long)]
    export: Option<PathBuf>,
    /// Seconds of wear: every keyframe that asks is darkened to this share of its contrast.
    #[arg(long, default_value_t = 1.0)]
    contrast: f32,
    /// Degrees by which every keyframe that asks is rolled.
    #[arg(long, default_value_t = 0.0)]
    roll: f32,
    /// Align the tree's best candidates as the search for loops does, with true depth that errs by so much (0.01: 1 %),
    /// independently from pixel to pixel.
    #[arg(long, conflicts_with_all = ["roll", "contrast", "truth"])]
    verify: Option<f64>,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("place_figures: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let footage = Footage::read(arguments)?;
    let overlaps = footage.overlaps();
    if let Some(folder) = &arguments.export {
        footage.export(folder, &overlaps)?;
    }
    let revisits = judge::count_revisits(&overlaps, arguments.gap);
    println!(
        "{} keyframes, {revisits} that show a place seen {} before",
        overlaps.len(),
        arguments.gap
    );
    let queries = footage.queries(arguments.contrast, arguments.roll);
    let mut all: Vec<(String, Scores)> = Vec::new();
    for kind in &arguments.methods {
        all.push((format!("{kind:?}"), methods::scores(*kind, &footage, &queries, arguments.gap)));
    }
    if let Some(file) = &arguments.scores {
        all.push((file.display().to_string(), methods::read_scores(file)?));
    }
    for (name, scores) in &all {
        println!("{name}: {}", scores.cost);
        judge::judge(&overlaps, scores, arguments.gap);
        if let Some(depth_error) = arguments.verify
            && !scores.candidates.is_empty()
        {
            verify::verify(&footage, &overlaps, &scores.candidates, arguments.gap, depth_error);
        }
    }
    Ok(())
}
