//! Figures of the two-frame start: its delay, how often it is wrong and the cost of a step, from many first frames of
//! any source.
//!
//! ```text
//! cargo run --release --example start_figures -- tum:DIR sim:room
//! ```

use std::error::Error;
use std::process::ExitCode;
use std::time::Instant;

use clap::Parser;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source::FrameSource;
use semidense::capture::source_name::SourceName;
use semidense::slam::evaluation::start_error::StartErrors;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::buffer::Image;
use semidense::slam::two_frame::{InitState, TwoFrameInitializer, TwoFrameParams};

/// Starts from many first frames of each source.
#[derive(Debug, Parser)]
struct Arguments {
    /// Sources, as in `semidense run --source`.
    #[arg(required = true)]
    sources: Vec<SourceName>,
    /// Number of frames to read from each source.
    #[arg(long, default_value_t = 90)]
    frames: usize,
    /// Distance between first frames.
    #[arg(long, default_value_t = 3)]
    apart: usize,
    /// Number of first frames.
    #[arg(long, default_value_t = 10)]
    starts: usize,
    /// Use every n-th frame, as in a live run that skips some.
    #[arg(long, default_value_t = 1)]
    stride: usize,
    /// Number of frames of the source after which a start is abandoned.
    #[arg(long, default_value_t = 60)]
    patience: usize,
    /// Print only the totals.
    #[arg(long)]
    brief: bool,
}

/// One frame of a source.
struct Frame {
    pixels: Vec<u8>,
    world_from_camera: SE3,
    depth: Option<Image<f32>>,
}

/// Outcome of a start.
struct Start {
    /// Number of frames of the source from its first frame to the proof.
    late: usize,
    /// Length of the translation in mean depths.
    translation: f64,
    /// Estimated errors common to all depths, from the evidence.
    common_error: f64,
    /// Errors against ground truth.
    errors: StartErrors,
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
            let is_wrong = start.errors.is_wrong();
            wrongs += usize::from(is_wrong);
            lates.push(start.late as f64);
            if !arguments.brief {
                let Start { late, translation, common_error, errors } = start;
                let StartErrors { direction_deg, rotation_deg, depth, modes, shape, .. } = errors;
                println!(
                    "{name} from {first:2}: after {late:2} frames, moved {translation:.4}, direction \
                     {direction_deg:5.1}°, rotation {rotation_deg:.2}°, common {common_error:.3}, depth {:.3?}, \
                     shape {shape:.3?}, modes {:+.2?}{}",
                    depth.map(|depth| depth.relative_error_median),
                    modes.map(|modes| [modes.column, modes.row, modes.relief]),
                    if is_wrong { "  WRONG" } else { "" },
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
        frames.push(Frame { pixels: pixels.clone(), world_from_camera, depth });
    }
    Ok(frames)
}

/// Runs the start on every `stride`-th frame; appends the time of each step to `millis`.
fn start(
    intrinsics: Intrinsics,
    frames: &[Frame],
    stride: usize,
    millis: &mut Vec<f64>,
) -> Result<Option<Start>, Box<dyn Error>> {
    let mut initializer = TwoFrameInitializer::new(intrinsics, TwoFrameParams::default())?;
    let (mut first, mut before) = (&frames[0], &frames[0]);
    initializer.begin(&first.pixels);
    for (i, frame) in frames.iter().enumerate().step_by(stride).skip(1) {
        let begun = Instant::now();
        let outcome = initializer.step(&frame.pixels);
        millis.push(begun.elapsed().as_secs_f64() * 1e3);
        first = match outcome.frames {
            0 => frame,
            1 => before,
            _ => first,
        };
        before = frame;
        match outcome.state {
            InitState::Failed(_) | InitState::Waiting(_) => {}
            InitState::Proven => {
                let truth = first.world_from_camera.inverse() * frame.world_from_camera;
                let (found, depths) = (&outcome.first_from_current, initializer.depths());
                let depth = first.depth.as_ref();
                return Ok(Some(Start {
                    late: i,
                    translation: outcome.evidence.translation,
                    common_error: outcome.evidence.common_error,
                    errors: StartErrors::of(found, depths, &intrinsics, &truth, depth),
                }));
            }
        }
    }
    Ok(None)
}

/// A quantile; NaN without values.
fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    values.get((last as f64 * share).round() as usize).copied().unwrap_or(f64::NAN)
}
