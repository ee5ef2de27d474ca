//! Figures of the two-frame start: how late it is, how often it is wrong and what a step costs, from
//! many first frames of any source.
//!
//! ```text
//! cargo run --release --example start_figures -- tum:DIR sim:room
//! ```

use std::error::Error;
use std::process::ExitCode;
use std::time::Instant;

use clap::Parser;
use nalgebra::{Matrix4, Vector4};
use semidense::capture::source::{FrameSource, SourceName, SourceParams, open};
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::buffer::Image;
use semidense::slam::two_frame::{InitOutcome, InitState, TwoFrameInitializer, TwoFrameParams};

/// Starts from many first frames of each source.
#[derive(Debug, Parser)]
struct Arguments {
    /// Sources, as `semidense run --source` takes them.
    #[arg(required = true)]
    sources: Vec<SourceName>,
    /// Frames read of each source.
    #[arg(long, default_value_t = 90)]
    frames: usize,
    /// Every so many frames is a first frame.
    #[arg(long, default_value_t = 3)]
    apart: usize,
    /// Number of first frames.
    #[arg(long, default_value_t = 10)]
    starts: usize,
    /// Every so many frames is taken, as in a live run that skips some.
    #[arg(long, default_value_t = 1)]
    stride: usize,
    /// Frames of the source after which a start is given up.
    #[arg(long, default_value_t = 60)]
    patience: usize,
    /// Only the sums.
    #[arg(long)]
    brief: bool,
}

/// A start whose direction is further off than this is wrong, degrees: half of it would be noise of a
/// short baseline, a wrong minimum is further off.
const WRONG_DIRECTION_DEG: f64 = 30.0;
/// A start whose depths are further off than this in the median is wrong.
const WRONG_DEPTH: f64 = 0.15;

/// One frame of a source.
struct Frame {
    nanos: i64,
    pixels: Vec<u8>,
    world_from_camera: SE3,
    depth: Option<Image<f32>>,
}

/// What a start came to.
struct Start {
    /// Frames of the source from its first frame to the proof.
    late: usize,
    /// Length of the translation in mean depths.
    translation: f64,
    direction_error_deg: f64,
    rotation_error_deg: f64,
    /// NaN where the source has no depth.
    median_depth_error: f64,
    /// Slopes of ln(inverse depth / true) along columns, rows and the logarithm of the true inverse depth;
    /// NaN where the source has no depth. A relief of −0.3 is a scene flattened by 30 %.
    modes: [f64; 3],
    /// What the evidence says of errors common to all depths.
    common_error: f64,
}

impl Start {
    fn is_wrong(&self) -> bool {
        self.direction_error_deg > WRONG_DIRECTION_DEG || self.median_depth_error > WRONG_DEPTH
    }
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("start_figures: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let mut all_millis = Vec::new();
    let (mut tried, mut started, mut wrong) = (0, 0, 0);
    for name in &arguments.sources {
        let mut source = open(name, None, &SourceParams::default())?;
        let frames = read(source.as_mut(), arguments.frames)?;
        let mut millis = Vec::new();
        let (mut here, mut none, mut wrongs, mut lates) = (0, 0, 0, Vec::new());
        for first in (0..arguments.starts).map(|i| i * arguments.apart) {
            let Some(rest) = frames.get(first..).filter(|rest| rest.len() > 2) else { break };
            let rest = &rest[..rest.len().min(arguments.patience)];
            here += 1;
            let start = start(source.intrinsics(), rest, arguments.stride, &mut millis)?;
            let Some(start) = start else {
                none += 1;
                if !arguments.brief {
                    println!("{name} from {first:2}: none in {} frames", rest.len());
                }
                continue;
            };
            wrongs += usize::from(start.is_wrong());
            lates.push(start.late as f64);
            if !arguments.brief {
                println!(
                    "{name} from {first:2}: after {:2} frames, moved {:.4}, direction {:5.1}°, rotation \
                     {:.2}°, depth {:.3}, common {:.3}, modes {:+.2} {:+.2} {:+.2}{}",
                    start.late,
                    start.translation,
                    start.direction_error_deg,
                    start.rotation_error_deg,
                    start.median_depth_error,
                    start.common_error,
                    start.modes[0],
                    start.modes[1],
                    start.modes[2],
                    if start.is_wrong() { "  WRONG" } else { "" },
                );
            }
        }
        println!(
            "{name}: {here} first frames, {none} without a start, {wrongs} wrong, after {:.0} frames in \
             the median, {:.0} at most; a step {:.1} ms in the median, {:.1} at most",
            quantile(&mut lates, 0.5),
            quantile(&mut lates, 1.0),
            quantile(&mut millis, 0.5),
            quantile(&mut millis, 1.0),
        );
        (tried, started, wrong) = (tried + here, started + here - none, wrong + wrongs);
        all_millis.extend(millis);
    }
    println!(
        "all: {tried} first frames, {started} starts, {wrong} wrong; a step {:.1} ms in the median, {:.1} \
         p90, {:.1} at most",
        quantile(&mut all_millis, 0.5),
        quantile(&mut all_millis, 0.9),
        quantile(&mut all_millis, 1.0),
    );
    Ok(())
}

fn read(source: &mut dyn FrameSource, most: usize) -> Result<Vec<Frame>, Box<dyn Error>> {
    source.prepare(&mut |_, _| true)?;
    let k = source.intrinsics();
    let mut pixels = vec![0; k.width * k.height];
    let mut frames = Vec::new();
    while frames.len() < most
        && let Some(stamp) = source.next_into(&mut pixels)?
    {
        let nanos = stamp.capture_nanos;
        let nearest = source.ground_truth().iter().min_by_key(|p| p.nanos.abs_diff(nanos));
        let world_from_camera = nearest.ok_or("a source without ground truth")?.world_from_camera;
        let depth = source.depth_at(nanos)?;
        frames.push(Frame { nanos, pixels: pixels.clone(), world_from_camera, depth });
    }
    Ok(frames)
}

/// The start on every `stride`-th of the frames; the time of each step goes to `millis`.
fn start(
    intrinsics: Intrinsics,
    frames: &[Frame],
    stride: usize,
    millis: &mut Vec<f64>,
) -> Result<Option<Start>, Box<dyn Error>> {
    let mut initializer = TwoFrameInitializer::new(intrinsics, TwoFrameParams::default())?;
    let mut first = &frames[0];
    initializer.begin(&first.pixels);
    for (i, frame) in frames.iter().enumerate().skip(1).step_by(stride) {
        let begun = Instant::now();
        let outcome = initializer.step(&frame.pixels);
        millis.push(begun.elapsed().as_secs_f64() * 1e3);
        match outcome.state {
            InitState::Failed(_) => first = frame,
            InitState::Waiting(_) => {}
            InitState::Proven => {
                return Ok(Some(figures(intrinsics, &initializer, &outcome, first, frame, i)));
            }
        }
    }
    Ok(None)
}

fn figures(
    intrinsics: Intrinsics,
    initializer: &TwoFrameInitializer,
    outcome: &InitOutcome,
    first: &Frame,
    frame: &Frame,
    late: usize,
) -> Start {
    debug_assert!(first.nanos <= frame.nanos);
    let truth = first.world_from_camera.inverse() * frame.world_from_camera;
    let found = outcome.first_from_current;
    let lengths = found.translation.norm() * truth.translation.norm();
    let cosine = found.translation.dot(&truth.translation) / lengths;
    let depth = first.depth.as_ref();
    let mut products: Vec<f64> = depth.map_or_else(Vec::new, |depth| {
        let product = |d: semidense::slam::two_frame::InitialDepth| {
            f64::from(d.inverse_depth * depth.at(usize::from(d.u), usize::from(d.v)))
        };
        initializer.depths().map(product).filter(|product| *product > 0.0).collect()
    });
    let scale = quantile(&mut products, 0.5);
    let mut errors: Vec<f64> = products.iter().map(|p| (scale / p - 1.0).abs()).collect();
    Start {
        late,
        translation: outcome.evidence.translation,
        direction_error_deg: cosine.clamp(-1.0, 1.0).acos().to_degrees(),
        rotation_error_deg: found.rotation.angle_to(&truth.rotation).to_degrees(),
        median_depth_error: quantile(&mut errors, 0.5),
        modes: depth.map_or([f64::NAN; 3], |depth| modes(intrinsics, initializer, depth)),
        common_error: outcome.evidence.common_error,
    }
}

/// Slopes of ln(d / d_true) over (X, Y, ln d_true), X and Y the ray's coordinates: least squares, reweighted
/// against points on occluding edges.
fn modes(k: Intrinsics, initializer: &TwoFrameInitializer, depth: &Image<f32>) -> [f64; 3] {
    /// Deviations beyond this many median deviations lose weight.
    const HUBER: f64 = 2.0;
    const ROUNDS: usize = 10;
    let rows: Vec<(Vector4<f64>, f64)> = initializer
        .depths()
        .filter_map(|d| {
            let (u, v) = (usize::from(d.u), usize::from(d.v));
            let inverse = 1.0 / f64::from(depth.at(u, v));
            let ray = ((f64::from(d.u) - k.cx) / k.fx, (f64::from(d.v) - k.cy) / k.fy);
            let log_ratio = (f64::from(d.inverse_depth) / inverse).ln();
            (inverse.is_finite() && log_ratio.is_finite())
                .then(|| (Vector4::new(ray.0, ray.1, inverse.ln(), 1.0), log_ratio))
        })
        .collect();
    let mut weights = vec![1.0; rows.len()];
    let mut slopes = Vector4::zeros();
    for _ in 0..ROUNDS {
        let (mut hessian, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for ((row, y), w) in rows.iter().zip(&weights) {
            hessian += row * row.transpose() * *w;
            right += row * (*y * *w);
        }
        let Some(solved) = hessian.cholesky().map(|factor| factor.solve(&right)) else {
            return [f64::NAN; 3];
        };
        slopes = solved;
        let residual = |(row, y): &(Vector4<f64>, f64)| (y - row.dot(&slopes)).abs();
        let mut sizes: Vec<f64> = rows.iter().map(residual).collect();
        let limit = HUBER * 1.4826 * quantile(&mut sizes.clone(), 0.5).max(1e-6);
        sizes.iter_mut().for_each(|size| *size = (limit / *size).min(1.0));
        weights = sizes;
    }
    [slopes[0], slopes[1], slopes[2]]
}

/// A quantile; NaN of nothing.
fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    values.get((last as f64 * share).round() as usize).copied().unwrap_or(f64::NAN)
}
