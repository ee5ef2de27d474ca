//! `semidense run`: the three processes, from the first frame to the report.

use std::error::Error;
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use crate::capture::source_name::SourceName;
use crate::command::bridge::bridge;
use crate::command::capture::{ModeArguments, NamedSource, SourceArguments, usual_mode};
use crate::command::ending::{Ending, journal_options, print_unfinished};
use crate::command::map::MapOptions;
use crate::command::map_points::MapPointOptions;
use crate::command::print::note;
use crate::command::ros2_rig::fetch as fetch_rig;
use crate::command::run_progress::start_display;
use crate::command::{CommandResult, CommonArguments, INTERRUPTED};
use crate::service::config::{Config, MapConfig};
use crate::service::error_log::ErrorLog;
use crate::service::journal::Journal;
use crate::service::journal::folder::unfinished;
use crate::service::mode::Mode;
use crate::service::results::output_folder::OutputFolder;
use crate::service::results::record::{EndOfRun, RunMode};
use crate::service::shutdown::Shutdown;
use crate::service::supervisor::{RunOptions, RunOutcome, run as supervise};
use crate::service::view_child::{ViewChild, ViewOptions};
use crate::wire::limits::raise_open_files;
use crate::wire::place::Place;

/// Run capture, tracker and mapper on a source, supervise them and write the results
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Where frames come from, and the camera's calibration.
    #[command(flatten)]
    source: SourceArguments,
    #[command(flatten)]
    mode: ModeArguments,
    #[command(flatten)]
    map: MapOptions,
    /// Folder for trajectory, keyframes, map, summary and report [default: a new folder under ./output named
    /// after the time (UTC); output/latest links to the newest]
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    points: MapPointOptions,
    /// Print the summary as JSON and show no progress
    #[arg(long)]
    json: bool,
    /// Serve the live page during the run [default address: 127.0.0.1:8765] (needs the package semidense-bridge)
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, require_equals = true, default_missing_value = USUAL_PAGE)]
    view: Option<SocketAddr>,
}

/// Address of the live page if none is given.
const USUAL_PAGE: &str = "127.0.0.1:8765";

/// Runs the three processes and writes the results.
pub fn run(
    config: &Config,
    common: &CommonArguments,
    log: &ErrorLog,
    arguments: RunArguments,
) -> CommandResult {
    let map = arguments.map.of(config)?;
    let child_arguments = child_arguments(common, &arguments, &map);
    let results = arguments.points.of(&config.results);
    let config = &Config { map, results, ..config.clone() };
    let NamedSource { name: source, rig, mask } = arguments.source.named(&config.capture)?;
    let mode = arguments.mode.mode(usual_mode(&source));
    let place = Place::new(&config.instance, &config.root)?;
    // Otherwise a lack of file descriptors would be blamed on whatever is opened next.
    raise_open_files()?;
    // First: on a signal, the owner of the folder must be ready to remove it.
    let shutdown = Shutdown::install()?;
    let output = OutputFolder::prepare(arguments.output.as_deref())?;
    let rig = match (&source, rig) {
        // A ROS 2 topic carries its own calibration.
        (SourceName::Ros2(topic), None) => match fetch_rig(topic, output.path(), &shutdown)? {
            None => return Ok(ExitCode::from(INTERRUPTED)),
            rig => rig,
        },
        (_, rig) => rig,
    };
    print_unfinished(&unfinished(Some(&place), output.path()));
    let mut journal = journal_options(config, &source, rig.as_deref(), output.path());
    journal.start.mode = if mode == Mode::Live { RunMode::Live } else { RunMode::Lockstep };
    let options = RunOptions {
        source,
        rig,
        mask,
        mode,
        output: output.path().to_owned(),
        keeps_map: true,
        journal: Some(journal),
        arguments: child_arguments,
        log: log.clone(),
    };
    let page = arguments.view.map(|at| start_page(at, common, &place, log)).transpose()?;
    let mut outcome = supervise_with_display(config, &options, &shutdown, page, arguments.json)?;
    if outcome.record.poses.is_empty() && outcome.record.ended != EndOfRun::Finished {
        return end_without_results(outcome);
    }
    let ending = Ending { output: &output, config, json: arguments.json, write_more: &|_| Ok(()) };
    ending.finish(&outcome.record, outcome.source.as_mut(), outcome.journal.take())
}

/// Arguments of each process: the common ones, and those of this command that concern them.
fn child_arguments(
    common: &CommonArguments,
    arguments: &RunArguments,
    map: &MapConfig,
) -> Vec<OsString> {
    let mut told = common.to_arguments();
    if arguments.source.strict {
        told.extend(["--set".into(), "capture.strict=true".into()]);
    }
    if !map.folder.is_empty() {
        told.extend(MapOptions::settings(map));
    }
    told
}

/// Supervises the processes under a progress display that names the live page once it is served.
fn supervise_with_display(
    config: &Config,
    options: &RunOptions,
    shutdown: &Shutdown,
    mut page: Option<ViewChild>,
    json: bool,
) -> Result<RunOutcome, Box<dyn Error>> {
    let display = start_display(json)?;
    let outcome = supervise(config, options, shutdown, &mut |progress| {
        display.show(progress);
        if let Some(address) = page.as_mut().and_then(ViewChild::poll) {
            note(&format!("live page: {address}"));
        }
    });
    display.finish();
    drop(page);
    Ok(outcome?)
}

/// Ends a run that stopped before its first pose: nothing could be lost.
fn end_without_results(outcome: RunOutcome) -> CommandResult {
    drop(outcome.journal.map(Journal::finish));
    let EndOfRun::Failed(cause) = outcome.record.ended else {
        note("interrupted before the first pose: there are no results");
        return Ok(ExitCode::from(INTERRUPTED));
    };
    Err(cause.into())
}

/// Starts the live page alongside the run.
fn start_page(
    at: SocketAddr,
    common: &CommonArguments,
    place: &Place,
    log: &ErrorLog,
) -> Result<ViewChild, Box<dyn Error>> {
    // The instance may also be set with `--set`.
    let common = CommonArguments { instance: Some(place.instance.clone()), ..common.clone() };
    let mut arguments = common.of_bridge();
    arguments.extend(["view".into(), "--listen".into(), at.to_string().into()]);
    let program = bridge("run --view")?;
    let (root, log) = (place.root.clone(), log.clone());
    Ok(ViewChild::start(ViewOptions { program, arguments, root, log })?)
}
