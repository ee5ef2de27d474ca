//! `semidense replay`: runs a sequence through tracker and mapper in one process, deterministically.

use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;

use crate::capture::mask::Mask;
use crate::capture::opening::{open, rig_remarks};
use crate::capture::source::FrameSource;
use crate::capture::source_name::SourceName;
use crate::command::INTERRUPTED;
use crate::command::capture::{NamedSource, SourceArguments};
use crate::command::ending::{Ending, journal_options, print_unfinished};
use crate::command::map::MapOptions;
use crate::command::map_points::MapPointOptions;
use crate::command::print::{PrintError, note};
use crate::command::progress::Progress;
use crate::service::config::Config;
use crate::service::journal::Journal;
use crate::service::journal::folder::unfinished;
use crate::service::journal::replayed::ReplayJournal;
use crate::service::replay::{DepthOrigin, PoseOrigin, ReplayConfig, ReplayError, replay};
use crate::service::results::debug_pictures::write_debug_pictures;
use crate::service::results::output_folder::OutputFolder;
use crate::service::results::record::{EndOfRun, RunRecord};
use crate::service::results::results_error::ResultsError;
use crate::service::results::set::{DEBUG_FOLDER, foreign_debug};
use crate::service::schedule::give_back_large_blocks;
use crate::service::shutdown::Shutdown;
use crate::wire::place::Place;

/// Sources of a replay; a camera cannot repeat its frames.
const SOURCE_HELP: &str = "Where frames come from: DIR (its layout is detected), sim, sim:SCENE, tum:DIR, euroc:DIR, images:DIR, \
     mcap:FILE[:TOPIC] (a recording of `semidense record` or a ROS 2 bag), or loop:FRAMES:HZ:SOURCE, which plays another source back and forth, FRAMES frames at HZ [default: capture.source \
     of the configuration, which is sim]. A camera cannot be replayed: use `semidense run`";
const RIG_HELP: &str = "Rig file with the camera's calibration, for recordings without their own [default: capture.rig of the \
     configuration, for the source configured there]";

/// Replay a recorded or simulated sequence in one process: every frame, bit-identical on every run
#[derive(Debug, Args)]
#[command(mut_arg("source", |source| source.help(SOURCE_HELP)), mut_arg("rig", |rig| rig.help(RIG_HELP)))]
pub struct ReplayArgs {
    /// Where frames come from, and the camera's calibration.
    #[command(flatten)]
    source: SourceArguments,
    /// Folder for trajectory.txt, trajectory_online.txt, keyframes.txt, map.ply, points.ply, summary.json and
    /// report.html [default: a new folder under ./output named after the time (UTC); output/latest links to
    /// the newest]
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    map: MapOptions,
    #[command(flatten)]
    points: MapPointOptions,
    /// Source of a keyframe's initial depth
    #[arg(long, value_enum, default_value_t, value_name = "ORIGIN")]
    initial_depth: DepthOrigin,
    /// Source of the poses
    #[arg(long, value_enum, default_value_t, value_name = "ORIGIN")]
    poses: PoseOrigin,
    /// Write images of every keyframe's inverse depth, variance, density and weights for three motions to DIR/debug
    #[arg(long)]
    debug_images: bool,
    /// Stop after N frames
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    frames: Option<u32>,
    /// Seed of the simulator [default: simulator.seed]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Threads of the mapper and of the evaluation; results do not depend on them [default: mapper.threads]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// An error from another thread.
type SentError = dyn Error + Send + Sync;

/// Replays the sequence, writes the results and prints the summary.
pub fn run(config: &Config, args: ReplayArgs) -> Result<ExitCode, Box<dyn Error>> {
    let NamedSource { name, rig, mask } = args.source.clone().named(&config.capture)?;
    let (args, config) = (&args, &meant_config(config, &args, &name)?);
    give_back_large_blocks();
    let shutdown = Shutdown::install_final(INTERRUPTED)?;
    let place = Place::new(&config.instance, &config.root)?;
    let output = OutputFolder::prepare(args.output.as_deref())?;
    if let Some(file) = foreign_debug(output.path()).filter(|_| args.debug_images) {
        return Err(ResultsError::Foreign(file).into());
    }
    print_unfinished(&unfinished(Some(&place), output.path()));
    let mut source = open(&name, rig.as_deref(), &config.source_params())?;
    for remark in rig_remarks(&name, rig.as_deref()) {
        note(&format!("warning: {remark}"));
    }
    let read_mask = |path: &PathBuf| Mask::read(path, source.as_ref());
    let mask = mask.as_ref().map(read_mask).transpose()?;
    let replay_config = ReplayConfig { mask, ..replay_config(config, args) };
    let threads = args.threads.map_or(config.mapper.threads, usize::from);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|i| format!("mapper-{i}"))
        .build()?;
    let mut journal = journal_options(config, &name, rig.as_deref(), output.path());
    journal.start.poses_given = args.poses == PoseOrigin::GroundTruth;
    journal.start.is_depth_from_sensor = args.initial_depth == DepthOrigin::Sensor;
    let begin = || ReplayJournal::begin(&journal, &place);
    let replayed = pool.install(|| {
        record(&replay_config, &name.to_string(), source.as_mut(), &shutdown, &begin)
            .map_err(|error| error.to_string())
    })?;
    let Some(Replayed { record, journal }) = replayed else {
        note("interrupted before the first frame: there are no results");
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let write_more = |folder: &Path| match args.debug_images {
        true => write_debug_pictures(&folder.join(DEBUG_FOLDER), &record.map, &config.tracking),
        false => Ok(()),
    };
    let ending = Ending { output: &output, config, json: args.json, write_more: &write_more };
    // On the threads of the replay, to which the memory it freed belongs.
    let ended = pool.install(|| {
        ending.finish(&record, source.as_mut(), journal).map_err(|error| -> Box<SentError> {
            // Keeps the type that tells a reader that has gone from a failure.
            match error.downcast::<PrintError>() {
                Ok(error) => error,
                Err(error) => error.to_string().into(),
            }
        })
    });
    ended.map_err(|error| -> Box<dyn Error> { error })
}

/// The configuration with the arguments applied; an error if that cannot be replayed.
fn meant_config(
    config: &Config,
    args: &ReplayArgs,
    name: &SourceName,
) -> Result<Config, Box<dyn Error>> {
    if name.is_camera() {
        return Err(
            format!("{name}: a camera cannot be replayed; use `semidense run {name}`").into()
        );
    }
    let map = args.map.of(config)?;
    if args.poses == PoseOrigin::GroundTruth && !map.folder.is_empty() {
        return Err("--poses groundtruth cannot be used with a map: its poses would be those of another world".into());
    }
    let results = args.points.of(&config.results);
    let mut meant = Config { map, results, ..config.clone() };
    meant.capture.strict |= args.source.strict;
    let simulator = &mut meant.simulator;
    simulator.seed = args.seed.unwrap_or(simulator.seed);
    simulator.frames = args.frames.map_or(simulator.frames, |n| simulator.frames.min(n as usize));
    Ok(meant)
}

/// A finished replay.
struct Replayed {
    record: RunRecord,
    journal: Option<Journal>,
}

/// Prepares the source and replays it with a progress bar; `None` if a signal arrived before the first frame.
fn record(
    config: &ReplayConfig,
    source_name: &str,
    source: &mut dyn FrameSource,
    shutdown: &Shutdown,
    begin_journal: &dyn Fn() -> io::Result<ReplayJournal>,
) -> Result<Option<Replayed>, Box<dyn Error>> {
    let should_continue = || !shutdown.is_requested();
    let mut preparing: Option<Progress> = None;
    source.prepare(&mut |done, total| {
        let progress = preparing.get_or_insert_with(|| Progress::new("preparing", Some(total)));
        progress.update(done, "");
        should_continue()
    })?;
    preparing.iter().for_each(Progress::finish);
    if !should_continue() {
        return Ok(None);
    }
    let total = source.num_frames().map(|n| n.min(config.max_frames.unwrap_or(n)));
    let progress = Progress::new("replay", total);
    let mut journal = begin_journal()
        .inspect_err(|error| {
            tracing::warn!(
                "no journal is kept ({error}): if this process is killed, the replay is lost"
            )
        })
        .ok();
    let replayed = replay(source, source_name, config, &mut |frame| {
        progress.update(frame.done, frame.state.name());
        journal.iter_mut().for_each(|journal| journal.observe(frame));
        should_continue()
    });
    progress.finish();
    let journal = journal.map(ReplayJournal::into_journal);
    let (record, ended) = match replayed {
        Ok(record) if should_continue() => (record, EndOfRun::Finished),
        Ok(record) => (record, EndOfRun::Interrupted),
        Err(error) => {
            let fault = error.to_string();
            let (ReplayError::Cut { record, .. } | ReplayError::Unsaved { record, .. }) = error
            else {
                // Nothing could be lost.
                drop(journal.map(Journal::finish));
                return Err(error.into());
            };
            (*record, EndOfRun::Failed(fault))
        }
    };
    Ok(Some(Replayed { record: RunRecord { ended, ..record }, journal }))
}

/// The replay's settings from configuration and command line.
fn replay_config(config: &Config, args: &ReplayArgs) -> ReplayConfig {
    ReplayConfig {
        tracker: config.tracking.clone(),
        mapper: config.mapping.clone(),
        map: config.map.clone(),
        poses: args.poses,
        initial_depth: args.initial_depth,
        max_frames: args.frames.map(|frames| frames as usize),
        strict: config.capture.strict,
        corrections: config.capture.corrections(),
        mask: None,
    }
}
