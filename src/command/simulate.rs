//! `semidense simulate`: writes a simulated sequence as a dataset with exact depth and poses.

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, ValueEnum};
use rayon::prelude::*;
use serde::Serialize;

use crate::capture::dataset_writer::{DatasetError, DatasetLayout, DatasetWriter};
use crate::capture::simulator::params::{MotionKind, SimulatorParams};
use crate::capture::simulator::scene_kind::SceneKind;
use crate::capture::simulator::summary::{PathSummary, gradient_share, summarize};
use crate::capture::simulator::{RenderScratch, Simulator};
use crate::capture::source::FrameSource;
use crate::command::INTERRUPTED;
use crate::command::print::{note, print_as};
use crate::command::progress::Progress;
use crate::service::config::Config;
use crate::service::shutdown::Shutdown;

/// Frames written between two updates of the progress bar.
const FRAMES_PER_BATCH: usize = 24;
/// Gradient from which a pixel counts as textured, grey levels per pixel.
const TEXTURED_GRADIENT: f64 = 5.0;

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Layout {
    /// TUM RGB-D: rgb/, depth/, groundtruth.txt, camera.txt
    Tum,
    /// EuRoC: mav0/cam0, mav0/depth0, mav0/state_groundtruth_estimate0
    Euroc,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Scene {
    /// A furnished room of 6 x 5 x 3 m
    Room,
    /// A printed plane seen from 1.5 m above
    Plane,
    /// A corridor of 24 x 2.4 x 2.6 m
    Corridor,
    /// Four furnished rooms along a corridor, walked through twice
    Flat,
    /// Two identical rooms on a repeating corridor
    Twins,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Motion {
    /// Walking with a handheld camera
    Handheld,
    /// Back and forth on a straight line across the view
    Straight,
    /// Turning about the optical centre
    Rotation,
    /// The camera stands still
    Standing,
}

/// Write a simulated sequence as a dataset: images, exact depth, exact poses
///
/// Values that are not given are taken from the section `simulator` of the configuration. The same values and
/// seed give the same bytes on any number of threads.
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// Folder for the dataset; must be new or empty
    #[arg(long, value_name = "DIR")]
    output: PathBuf,
    /// Replace a dataset in the folder
    #[arg(long)]
    force: bool,
    /// Layout of the files
    #[arg(long, value_enum, default_value = "tum")]
    layout: Layout,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
    /// Scene
    #[arg(long, value_enum)]
    scene: Option<Scene>,
    /// Number of frames
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Seed of textures, path and noise
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Frames per second
    #[arg(long, value_name = "HZ")]
    rate: Option<f64>,
    /// Image width in pixels; the focal length follows, so that the field of view is unchanged
    #[arg(long, value_name = "PX")]
    width: Option<usize>,
    /// Image height in pixels
    #[arg(long, value_name = "PX")]
    height: Option<usize>,
    /// Focal length in pixels
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// Scale factor for all lengths of world and path
    #[arg(long, value_name = "FACTOR")]
    world_scale: Option<f64>,
    #[command(flatten, next_help_heading = "Motion")]
    motion: MotionArgs,
    #[command(flatten, next_help_heading = "Lens and sensor")]
    sensor: SensorArgs,
}

#[derive(Debug, Args)]
struct MotionArgs {
    /// How the camera moves
    #[arg(long, value_enum)]
    motion: Option<Motion>,
    /// Mean speed in m/s
    #[arg(long, value_name = "M/S")]
    speed: Option<f64>,
    /// Mean turn rate in degrees per second
    #[arg(long, value_name = "DEG/S")]
    turn: Option<f64>,
    /// Scale factor for hand tremor
    #[arg(long, value_name = "FACTOR")]
    tremor: Option<f64>,
}

#[derive(Debug, Args)]
struct SensorArgs {
    /// Standard deviation of the pixel noise in grey levels
    #[arg(long, value_name = "GREY")]
    noise: Option<f64>,
    /// Share of light lost in the image corners, 0 to 0.95
    #[arg(long, value_name = "SHARE")]
    vignette: Option<f64>,
    /// Amplitude of the slow change of gain, as a natural logarithm
    #[arg(long, value_name = "LOG")]
    gain_change: Option<f64>,
    /// Amplitude of the slow change of offset in grey levels
    #[arg(long, value_name = "GREY")]
    offset_change: Option<f64>,
    /// Period of both changes in seconds
    #[arg(long, value_name = "S")]
    exposure_period: Option<f64>,
    /// Exposure time in ms, which sets the motion blur
    #[arg(long, value_name = "MS")]
    exposure: Option<f64>,
    /// Time between the starts of two rows in microseconds (rolling shutter)
    #[arg(long, value_name = "US")]
    row_time: Option<f64>,
    /// Lens distortion: 4, 5 or 8 of k1,k2,p1,p2,k3,k4,k5,k6 (radtan, as OpenCV)
    #[arg(long, value_name = "K", value_delimiter = ',', allow_hyphen_values = true)]
    distortion: Option<Vec<f64>>,
}

/// Summary of the written dataset.
#[derive(Debug, Serialize)]
struct Summary {
    /// As text, whatever its bytes.
    output: String,
    frames: usize,
    seed: u64,
    #[serde(flatten)]
    path: PathSummary,
    /// Mean share of pixels with a gradient of at least 5 grey levels per pixel.
    gradient_share: f64,
}

/// Renders and writes the dataset and prints its summary.
pub fn run(config: &Config, args: &SimulateArgs) -> Result<ExitCode, Box<dyn Error>> {
    // First: on a signal, the writer must be ready to remove what it has started.
    let shutdown = Shutdown::install()?;
    let mut simulator = Simulator::new(params(&config.simulator, args))?;
    let layout = match args.layout {
        Layout::Tum => DatasetLayout::Tum,
        Layout::Euroc => DatasetLayout::Euroc,
    };
    let params = simulator.params();
    let (camera, rate_hz) = (*simulator.camera(), params.rate_hz);
    let writer = DatasetWriter::create(&args.output, layout, camera, rate_hz, args.force)?;
    let Some(gradient_share) = write_frames(&mut simulator, &writer, &shutdown)? else {
        note(&format!("interrupted: nothing was written to {}", args.output.display()));
        return Ok(ExitCode::from(INTERRUPTED));
    };
    writer.finish(simulator.ground_truth())?;
    let summary = Summary {
        output: args.output.display().to_string(),
        frames: simulator.params().frames,
        seed: simulator.params().seed,
        path: summarize(simulator.ground_truth()),
        gradient_share,
    };
    print_as(args.json, &summary, summary_text)?;
    Ok(ExitCode::SUCCESS)
}

/// Renders and writes all frames; returns the mean share of textured pixels, `None` after a signal.
fn write_frames(
    simulator: &mut Simulator,
    writer: &DatasetWriter,
    shutdown: &Shutdown,
) -> Result<Option<f64>, DatasetError> {
    let frames = simulator.params().frames;
    let progress = Progress::new("simulate", Some(frames));
    let mut shares = 0.0;
    // In batches, so that memory stays small however long the sequence.
    for first in (0..frames).step_by(FRAMES_PER_BATCH) {
        let batch = first..(first + FRAMES_PER_BATCH).min(frames);
        let written: Result<Vec<f64>, DatasetError> = batch
            .clone()
            .into_par_iter()
            .map_init(RenderScratch::default, |scratch, frame| match shutdown.is_requested() {
                true => Ok(0.0),
                false => write_frame(simulator, writer, frame, scratch),
            })
            .collect();
        shares += written?.iter().sum::<f64>();
        if shutdown.is_requested() {
            progress.finish();
            return Ok(None);
        }
        batch.for_each(|frame| progress.update(frame + 1, ""));
    }
    progress.finish();
    Ok(Some(shares / frames as f64))
}

/// Renders and writes one frame; returns its share of textured pixels.
fn write_frame(
    simulator: &Simulator,
    writer: &DatasetWriter,
    frame: usize,
    scratch: &mut RenderScratch,
) -> Result<f64, DatasetError> {
    let Some((pixels, depth)) = simulator.raw_frame_and_depth(frame, scratch) else {
        return Ok(0.0);
    };
    writer.write_frame(simulator.nanos(frame), &pixels, &depth)?;
    Ok(gradient_share(&pixels, depth.width(), TEXTURED_GRADIENT))
}

fn summary_text(summary: &Summary) -> String {
    let path = &summary.path;
    format!(
        "{} frames, {:.2} s, in {}\npath {:.2} m at {:.2} m/s, extent {:.2} m, rotation {:.0}°\n\
         textured pixels {:.1} %\n",
        summary.frames,
        path.duration_s,
        summary.output,
        path.path_length_m,
        path.mean_speed_m_s,
        path.extent_m,
        path.rotation_deg,
        100.0 * summary.gradient_share
    )
}

/// The configuration with the options of the command line.
fn params(configured: &SimulatorParams, args: &SimulateArgs) -> SimulatorParams {
    fn set<T: Clone>(value: &mut T, said: &Option<T>) {
        if let Some(said) = said {
            value.clone_from(said);
        }
    }
    let mut params = configured.clone();
    let scene = args.scene.map(|scene| match scene {
        Scene::Room => SceneKind::Room,
        Scene::Plane => SceneKind::Plane,
        Scene::Corridor => SceneKind::Corridor,
        Scene::Flat => SceneKind::Flat,
        Scene::Twins => SceneKind::Twins,
    });
    set(&mut params.seed, &args.seed);
    set(&mut params.frames, &args.frames);
    set(&mut params.rate_hz, &args.rate);
    set(&mut params.width, &args.width);
    set(&mut params.height, &args.height);
    // A smaller image of the same view: a narrower field of view would make turns and translations hard to tell apart.
    let widened = args.width.map(|px| px as f64 / configured.width as f64);
    set(&mut params.focal_px, &args.focal.or(widened.map(|by| by * configured.focal_px)));
    set(&mut params.world_scale, &args.world_scale);
    let motion = &args.motion;
    let kind = motion.motion.map(|kind| match kind {
        Motion::Handheld => MotionKind::Handheld,
        Motion::Straight => MotionKind::Straight,
        Motion::Rotation => MotionKind::Rotation,
        Motion::Standing => MotionKind::Standing,
    });
    set(&mut params.motion.kind, &kind);
    set(&mut params.motion.mean_speed_m_s, &motion.speed);
    set(&mut params.motion.mean_turn_deg_s, &motion.turn);
    set(&mut params.motion.tremor, &motion.tremor);
    let sensor = &args.sensor;
    set(&mut params.sensor.noise_std_dev, &sensor.noise);
    set(&mut params.sensor.vignette, &sensor.vignette);
    set(&mut params.sensor.gain_amplitude, &sensor.gain_change);
    set(&mut params.sensor.offset_amplitude, &sensor.offset_change);
    set(&mut params.sensor.exposure_period_s, &sensor.exposure_period);
    set(&mut params.sensor.exposure_ms, &sensor.exposure);
    set(&mut params.sensor.row_time_us, &sensor.row_time);
    set(&mut params.sensor.distortion, &sensor.distortion);
    // Last: the length of a route follows from speed and rate.
    match scene {
        Some(scene) => params.with_scene(scene),
        None => params,
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        args: SimulateArgs,
    }

    #[test]
    fn a_smaller_image_keeps_the_field_of_view_unless_a_focal_length_is_given() {
        let configured = SimulatorParams::default();
        let focal = |line: &str| {
            let words = "simulate --output out ".to_owned() + line;
            params(&configured, &Line::parse_from(words.split_whitespace()).args).focal_px
        };
        assert_eq!(focal(""), configured.focal_px);
        assert_eq!(focal("--width 320 --height 240"), 0.5 * configured.focal_px);
        assert_eq!(focal("--width 320 --focal 400"), 400.0);
        assert_eq!(focal("--height 240"), configured.focal_px);
    }
}
