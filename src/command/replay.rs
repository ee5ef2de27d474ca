//! `semidense replay`: a sequence through tracker and mapper in one process, deterministic.

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Args, ValueEnum};

use crate::capture::source::{FrameSource, SourceName, open, rig_conflict};
use crate::command::INTERRUPTED;
use crate::command::print::{note, print};
use crate::command::progress::Progress;
use crate::service::config::Config;
use crate::service::replay::{
    DepthOrigin, PoseOrigin, ReplayConfig, ReplayError, ReplayProgress, replay,
};
use crate::service::results::debug_pictures::write_debug_pictures;
use crate::service::results::summary_text::summary_text;
use crate::service::results::{RunRecord, prepare_output, write_results};
use crate::slam::pose::TrackingState;

/// Where poses come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum Poses {
    /// The tracker estimates them
    #[default]
    Tracker,
    /// The source's ground truth; only the mapper is at work
    Groundtruth,
}

/// Where the first depth of a keyframe comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum InitialDepth {
    /// Images alone
    #[default]
    Images,
    /// The source's depth camera
    Sensor,
}

/// Run a recorded or simulated sequence in one process: every frame, the same bits on every run
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// sim, sim:SCENE, tum:DIR, euroc:DIR, images:DIR, or loop:FRAMES:HZ:SOURCE (another to and fro, FRAMES in all)
    source: SourceName,
    /// Rig file with the camera's calibration; needed where the recording brings none
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Folder for trajectory.txt, trajectory_online.txt, keyframes.txt, map.ply, map.pcd, summary.json
    /// and report.html
    #[arg(long, value_name = "DIR", default_value = "output")]
    output: PathBuf,
    /// Where the first depth of a keyframe comes from
    #[arg(long, value_enum, default_value_t)]
    initial_depth: InitialDepth,
    /// Where poses come from
    #[arg(long, value_enum, default_value_t)]
    poses: Poses,
    /// Write pictures of every keyframe's inverse depth, variance, density and weights for three
    /// motions into DIR/debug
    #[arg(long)]
    debug_images: bool,
    /// Stop after as many frames
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    frames: Option<u32>,
    /// Seed of the simulator [default: simulator.seed]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Threads of the mapper; the result does not depend on it [default: mapper.threads]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// Replays, writes the results and prints the summary.
pub fn run(config: &Config, args: &ReplayArgs) -> Result<ExitCode, Box<dyn Error>> {
    if args.source.is_camera() {
        let name = &args.source;
        return Err(
            format!("{name}: a camera cannot be replayed; semidense run --source {name}").into()
        );
    }
    let interrupted = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::clone(&interrupted))?;
    prepare_output(&args.output)?;
    let mut params = config.source_params();
    let simulator = &mut params.simulator;
    simulator.seed = args.seed.unwrap_or(simulator.seed);
    simulator.frames = args.frames.map_or(simulator.frames, |n| simulator.frames.min(n as usize));
    let mut source = open(&args.source, args.rig.as_deref(), &params)?;
    if let Some(conflict) = rig_conflict(&args.source, args.rig.as_deref()) {
        note(&format!("warning: {conflict}"));
    }
    let threads = args.threads.map_or(config.mapper.threads, usize::from);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|i| format!("mapper-{i}"))
        .build()?;
    let replayed = pool.install(|| {
        record(config, args, source.as_mut(), &interrupted).map_err(|error| error.to_string())
    })?;
    let Some(Replayed { record, fault }) = replayed else {
        note("interrupted before the first frame: there are no results");
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let summary = write_results(&args.output, &record, source.as_mut(), &config.results)?;
    if args.debug_images {
        write_debug_pictures(&args.output.join("debug"), &record.map, &config.tracking)?;
    }
    if args.json {
        print(&format!("{}\n", serde_json::to_string_pretty(&summary)?))?;
    } else {
        let place = args.output.display();
        print(&format!("{}results in {place}\n", summary_text(&summary)))?;
    }
    if let Some(fault) = fault {
        return Err(fault.into());
    }
    let code = if interrupted.load(Ordering::Relaxed) { INTERRUPTED } else { 0 };
    Ok(ExitCode::from(code))
}

/// What was replayed.
struct Replayed {
    record: RunRecord,
    /// Why the source failed on the way.
    fault: Option<String>,
}

/// Prepares the source and replays it under a progress bar; `None` where Ctrl-C came before a frame.
fn record(
    config: &Config,
    args: &ReplayArgs,
    source: &mut dyn FrameSource,
    interrupted: &AtomicBool,
) -> Result<Option<Replayed>, Box<dyn Error>> {
    let goes_on = || !interrupted.load(Ordering::Relaxed);
    let mut preparing: Option<Progress> = None;
    source.prepare(&mut |done, total| {
        let progress = preparing.get_or_insert_with(|| Progress::new("preparing", Some(total)));
        progress.update(done, "");
        goes_on()
    })?;
    preparing.iter().for_each(Progress::finish);
    if !goes_on() {
        return Ok(None);
    }
    let config = ReplayConfig {
        tracker: config.tracking.clone(),
        mapper: config.mapping.clone(),
        poses: match args.poses {
            Poses::Tracker => PoseOrigin::Tracker,
            Poses::Groundtruth => PoseOrigin::GroundTruth,
        },
        initial_depth: match args.initial_depth {
            InitialDepth::Images => DepthOrigin::Images,
            InitialDepth::Sensor => DepthOrigin::Sensor,
        },
        max_frames: args.frames.map(|frames| frames as usize),
    };
    let total = source.num_frames().map(|n| n.min(config.max_frames.unwrap_or(n)));
    let progress = Progress::new("replay", total);
    let replayed = replay(source, &args.source.to_string(), &config, &mut |frame| {
        progress.update(frame.done, state_word(frame));
        goes_on()
    });
    progress.finish();
    match replayed {
        Ok(record) => Ok(Some(Replayed { record, fault: None })),
        Err(error) => {
            let fault = Some(error.to_string());
            match error {
                ReplayError::Cut { record, .. } => Ok(Some(Replayed { record: *record, fault })),
                error => Err(error.into()),
            }
        }
    }
}

fn state_word(frame: &ReplayProgress) -> &'static str {
    match frame.state {
        TrackingState::Initializing => "initializing",
        TrackingState::Tracking => "tracking",
        TrackingState::Degraded(_) => "degraded",
        TrackingState::Lost(_) => "lost",
    }
}
