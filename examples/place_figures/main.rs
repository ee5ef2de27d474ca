//! Figures of place recognition: frames of a sequence as keyframes, later ones looked up among earlier ones, judged by
//! the view they share according to ground truth.
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

/// Recognises places of a sequence by several methods.
#[derive(Debug, Parser)]
struct Arguments {
    /// Source of the frames.
    source: SourceName,
    /// Use every n-th frame as a keyframe.
    #[arg(long, default_value_t = 10)]
    stride: usize,
    /// Number of frames to read.
    #[arg(long)]
    frames: Option<usize>,
    /// Seed of the simulator.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Trajectory that replaces the source's ground truth.
    #[arg(long)]
    truth: Option<PathBuf>,
    /// Assumed depths for a source without depth, in units of the truth.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0, 2.0, 4.0])]
    depths: Vec<f64>,
    /// Number of keyframes that must lie between a query and what it may find.
    #[arg(long, default_value_t = 10)]
    gap: usize,
    /// Methods to compare.
    #[arg(long, value_delimiter = ',', value_enum, default_values_t = [Kind::Tree, Kind::Small, Kind::Ferns])]
    methods: Vec<Kind>,
    /// File with the scores of another method: a line for each query, a number for each keyframe.
    #[arg(long)]
    scores: Option<PathBuf>,
    /// Folder to export the keyframes to as PGM files, for other methods.
    #[arg(long)]
    export: Option<PathBuf>,
    /// Factor on the grey levels of every query keyframe, which lowers its contrast.
    #[arg(long, default_value_t = 1.0)]
    contrast: f32,
    /// Degrees by which every query keyframe is rolled.
    #[arg(long, default_value_t = 0.0)]
    roll: f32,
    /// Align the tree's best candidates as the loop search does, with true depth plus relative errors of this size
    /// (0.01: 1 %), independent from pixel to pixel.
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
