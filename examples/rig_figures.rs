//! Effect of a wrong calibration on the figures that a run can compute without ground truth.
//!
//! ```text
//! cargo run --release --example rig_figures -- DIR …      # folders with a camera.txt
//! ```

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use clap::Parser;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source_name::SourceName;
use semidense::service::replay::{ReplayConfig, replay};

/// Replays recordings with their own calibration and with wrong ones.
#[derive(Debug, Parser)]
struct Arguments {
    /// Folders of recordings in TUM layout, with a camera.txt.
    #[arg(required = true)]
    folders: Vec<PathBuf>,
    /// Number of frames of each.
    #[arg(long, default_value_t = 150)]
    frames: usize,
    /// Factors on the focal lengths.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0, 0.5, 0.8, 0.9, 1.1, 1.25, 2.0])]
    factors: Vec<f64>,
    /// Terms k1 added to the lens model, with unchanged focal lengths.
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true, default_values_t = [-0.35, 0.35])]
    distortions: Vec<f64>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = Arguments::parse();
    println!(
        "{:14} {:>6} {:>6} {:>8} {:>8} {:>7} {:>7} {:>7} {:>7} {:>6} {:>5} {:>5}",
        "recording",
        "focal",
        "k1",
        "whitened",
        "p90",
        "grey",
        "inlier",
        "failed",
        "fused",
        "tracked",
        "lost",
        "rej"
    );
    for folder in &arguments.folders {
        for &factor in &arguments.factors {
            figures(folder, factor, 0.0, arguments.frames)?;
        }
        for &k1 in &arguments.distortions {
            figures(folder, 1.0, k1, arguments.frames)?;
        }
    }
    Ok(())
}

fn figures(folder: &Path, factor: f64, k1: f64, frames: usize) -> Result<(), Box<dyn Error>> {
    let text = fs::read_to_string(folder.join("camera.txt"))?;
    let own: Vec<f64> = text.split_whitespace().map(str::parse).collect::<Result<_, _>>()?;
    let mut lens = own[6..].to_vec();
    if k1 != 0.0 {
        lens.resize(lens.len().max(4), 0.0);
        lens[0] += k1;
    }
    let model = if lens.is_empty() { "pinhole" } else { "radtan" };
    let rig = format!(
        "model = \"{model}\"\nfx = {}\nfy = {}\ncx = {}\ncy = {}\nwidth = {}\nheight = {}\ncoefficients = {lens:?}\n",
        own[0] * factor,
        own[1] * factor,
        own[2],
        own[3],
        own[4],
        own[5]
    );
    let place = std::env::temp_dir().join(format!("rig-figures-{}.toml", std::process::id()));
    fs::write(&place, rig)?;
    let name = SourceName::parse(folder.as_os_str())?;
    let mut source = open(&name, Some(&place), &SourceParams::default())?;
    let config = ReplayConfig { max_frames: Some(frames), ..ReplayConfig::default() };
    let (mut attempted, mut failed, mut fused) = (0, 0, 0);
    let record = replay(source.as_mut(), &name.to_string(), &config, &mut |step| {
        let counts = &step.outcome.observations;
        attempted += counts.attempted;
        failed += counts.failed;
        fused += counts.fused;
        true
    })?;
    fs::remove_file(&place)?;
    let tracked: Vec<_> = record.poses.iter().filter(|p| p.estimate.state.is_tracked()).collect();
    let sorted = |value: fn(&semidense::slam::pose::Quality) -> f64| {
        let mut values: Vec<f64> = tracked.iter().map(|p| value(&p.estimate.quality)).collect();
        values.sort_by(f64::total_cmp);
        move |share: f64| {
            values.get((share * values.len() as f64) as usize).copied().unwrap_or(f64::NAN)
        }
    };
    let whitened = sorted(|q| q.whitened_rmse);
    let lost = record
        .poses
        .iter()
        .filter(|p| matches!(p.estimate.state, semidense::slam::pose::TrackingState::Lost(_)));
    println!(
        "{:14} {factor:>6} {k1:>6} {:>8.3} {:>8.3} {:>7.2} {:>7.3} {:>7.3} {:>7.3} {:>6} {:>5} {:>5}",
        folder.file_name().unwrap_or_default().to_string_lossy(),
        whitened(0.5),
        whitened(0.9),
        sorted(|q| q.residual_rmse)(0.5),
        sorted(|q| q.inlier_ratio)(0.5),
        failed as f64 / f64::max(attempted as f64, 1.0),
        fused as f64 / f64::max(attempted as f64, 1.0),
        tracked.len(),
        lost.count(),
        record.rejections.as_ref().map_or(0, Vec::len),
    );
    Ok(())
}
