//! Relative pose error, normalised errors and times for one source.

use std::error::Error;
use std::path::PathBuf;

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::capture::tum;
use semidense::slam::pose::TrackingState;
use semidense::slam::tracker::TrackerParams;

use crate::sequence::{KeyframeChoice, Recorded, TrackedFrame, track};

/// What to track, and how.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// `tum:DIR` or `sim` (`sim:SEED` for another seed)
    source: String,
    /// Standard deviation of the noise added to the inverse depth, as a share of it
    #[arg(long, default_value_t = 0.05)]
    depth_noise: f64,
    /// Multiply each point's noise by this to a power of -1 to 1; 1 for uniform noise
    #[arg(long, default_value_t = 1.0)]
    noise_spread: f64,
    /// Minimum gradient of a keyframe's points, grey levels per pixel
    #[arg(long, default_value_t = 5.0)]
    min_gradient: f64,
    /// Start a new keyframe every N frames; 0 to start one when the tracker proposes it
    #[arg(long, default_value_t = 0)]
    keyframe_every: usize,
    /// Stop after this many frames
    #[arg(long, default_value_t = usize::MAX)]
    frames: usize,
    /// Tracker parameters as TOML (the tables of `[tracker]`), applied over the defaults
    #[arg(long)]
    params: Option<PathBuf>,
    /// The same on the command line, e.g. `alignment.huber=2.0;reference.finest_level=0`; each occurrence is a
    /// separate run
    #[arg(long)]
    set: Vec<String>,
}

pub fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let base = match &arguments.params {
        Some(path) => std::fs::read_to_string(path)?,
        None => String::new(),
    };
    let choice = KeyframeChoice {
        depth_noise: arguments.depth_noise,
        noise_spread: arguments.noise_spread,
        min_gradient: arguments.min_gradient,
        every: arguments.keyframe_every,
    };
    let source = open(&arguments.source, arguments.frames)?;
    let mut recorded = Recorded::new(source, arguments.frames)?;
    let default = [String::new()];
    let variants = if arguments.set.is_empty() { &default[..] } else { &arguments.set };
    for variant in variants {
        let settings = variant.replace(';', "\n");
        let params: TrackerParams = toml::from_str(&format!("{base}\n{settings}"))?;
        println!("== {} {variant}", arguments.source);
        print_figures(&track(&mut recorded, &params, &choice)?);
    }
    Ok(())
}

fn open(name: &str, frames: usize) -> Result<Box<dyn FrameSource>, Box<dyn Error>> {
    if let Some(folder) = name.strip_prefix("tum:") {
        return Ok(Box::new(tum::open(folder.as_ref(), None)?));
    }
    let seed = match name.strip_prefix("sim") {
        Some("") => 1,
        Some(seed) => seed.trim_start_matches(':').parse()?,
        None => return Err(format!("source `{name}`: `tum:DIR`, `sim` or `sim:SEED`").into()),
    };
    let defaults = SimulatorParams::default();
    let frames = frames.saturating_add(1).min(defaults.frames);
    Ok(Box::new(Simulator::new(SimulatorParams { seed, frames, ..defaults })?))
}

fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(((sorted.len() as f64 - 1.0) * share).round() as usize).copied().unwrap_or(f64::NAN)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|x| x * x).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// RPE over `interval` frames: (translation RMSE in millimetres, rotation RMSE in degrees).
fn relative_error(frames: &[TrackedFrame], interval: usize) -> (f64, f64) {
    let pairs = frames.iter().zip(frames.iter().skip(interval));
    let tracked =
        pairs.filter(|(a, b)| a.estimate.state.is_tracked() && b.estimate.state.is_tracked());
    let errors: Vec<_> = tracked
        .map(|(a, b)| {
            let estimated = a.estimate.world_from_camera.inverse() * b.estimate.world_from_camera;
            let truth = a.truth.inverse() * b.truth;
            (truth.inverse() * estimated).log()
        })
        .collect();
    let part = |start: usize| -> Vec<f64> {
        errors.iter().map(|error| error.fixed_rows::<3>(start).norm()).collect()
    };
    (root_mean_square(&part(0)) * 1e3, root_mean_square(&part(3)).to_degrees())
}

fn print_figures(frames: &[TrackedFrame]) {
    let is_lost = |frame: &&TrackedFrame| matches!(frame.estimate.state, TrackingState::Lost(_));
    let tracked: Vec<_> =
        frames.iter().filter(|f| f.estimate.state.is_tracked()).cloned().collect();
    let keyframes: std::collections::BTreeSet<_> =
        frames.iter().map(|frame| frame.estimate.keyframe_id).collect();
    let of = |figure: &dyn Fn(&TrackedFrame) -> f64| -> Vec<f64> {
        tracked.iter().map(figure).collect()
    };
    println!(
        "frames {} tracked {} lost {} keyframes {} points {:.0}",
        frames.len(),
        tracked.len(),
        frames.iter().filter(is_lost).count(),
        keyframes.len(),
        mean(&of(&|f| f.points as f64)),
    );
    let (short_mm, short_deg) = relative_error(frames, 1);
    let (long_mm, long_deg) = relative_error(frames, 30);
    println!(
        "RPE 1 frame {short_mm:.3} mm {short_deg:.4} deg; 30 frames {long_mm:.2} mm {long_deg:.3} deg"
    );
    let to_keyframe_mm = of(&|f| f.error.fixed_rows::<3>(0).norm() * f.unit_m * 1e3);
    let to_keyframe_deg = of(&|f| f.error.fixed_rows::<3>(3).norm().to_degrees());
    println!(
        "to keyframe: RMSE {:.3} mm {:.4} deg; median {:.3} mm {:.4} deg",
        root_mean_square(&to_keyframe_mm),
        root_mean_square(&to_keyframe_deg),
        quantile(&to_keyframe_mm, 0.5),
        quantile(&to_keyframe_deg, 0.5),
    );
    // How much of the true translation is recovered: noise in the depth biases it towards zero.
    let (mut along, mut squared) = (0.0, 0.0);
    for frame in &tracked {
        let current_from_keyframe = frame.estimate.keyframe_from_camera.inverse();
        let estimated = current_from_keyframe.translation;
        let error = frame.error.fixed_rows::<3>(0).into_owned();
        let truth = estimated - error;
        along += estimated.dot(&truth);
        squared += truth.norm_squared();
    }
    println!("translation found / true {:.4}", along / squared);
    let normalized: Vec<_> = tracked.iter().filter_map(TrackedFrame::normalized).collect();
    let part = |index: usize| normalized.iter().map(|n| n[index]).collect::<Vec<_>>();
    let below =
        part(0).iter().filter(|&&n| n < 12.6).count() as f64 / normalized.len().max(1) as f64;
    println!(
        "NEES mean {:.2} median {:.2} translation {:.2} rotation {:.2} below 12.6: {:.3}",
        mean(&part(0)),
        quantile(&part(0), 0.5),
        mean(&part(1)),
        mean(&part(2)),
        below
    );
    let times = of(&|f| f.track_ms);
    println!(
        "track ms median {:.3} p95 {:.3} p99 {:.3} max {:.3}; iterations {:.1}; prepare ms {:.2}",
        quantile(&times, 0.5),
        quantile(&times, 0.95),
        quantile(&times, 0.99),
        quantile(&times, 1.0),
        mean(&of(&|f| f64::from(f.estimate.quality.iterations))),
        mean(&of(&|f| f.prepare_ms)),
    );
    println!(
        "whitened rmse {:.3} residual {:.2} inliers {:.3} (least {:.3}) in view {:.3}",
        mean(&of(&|f| f.estimate.quality.whitened_rmse)),
        mean(&of(&|f| f.estimate.quality.residual_rmse)),
        mean(&of(&|f| f.estimate.quality.inlier_ratio)),
        quantile(&of(&|f| f.estimate.quality.inlier_ratio), 0.0),
        mean(&of(&|f| f.estimate.quality.in_view_ratio)),
    );
}
