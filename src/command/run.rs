//! `semidense run`: the three processes, from the first frame to the report.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use crate::capture::source_name::SourceName;
use crate::command::bridge::{BridgeError, handed_on, program};
use crate::command::capture::{ModeArguments, SourceArguments, usual_mode};
use crate::command::ending::{Ending, note_unfinished, run_start};
use crate::command::map::MapOptions;
use crate::command::map_points::MapPointOptions;
use crate::command::print::note;
use crate::command::ros2_rig::{Ros2RigError, fetch as fetch_rig};
use crate::command::run_progress::start_display;
use crate::command::{CommandResult, CommonArguments, INTERRUPTED};
use crate::service::config::Config;
use crate::service::error_log::ErrorLog;
use crate::service::journal::folder::unfinished;
use crate::service::journal::log::RunStart;
use crate::service::journal::{Journal, JournalOptions};
use crate::service::mode::Mode;
use crate::service::results::output_folder::OutputFolder;
use crate::service::results::record::RunMode;
use crate::service::shutdown::Shutdown;
use crate::service::supervisor::{Ended, RunOptions, run as supervise};
use crate::service::view_child::{ViewChild, ViewOptions};
use crate::wire::place::Place;

/// Run capture, tracker and mapper on a source, supervise them and write the results
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Where frames come from and how the camera is.
    #[command(flatten)]
    source: SourceArguments,
    #[command(flatten)]
    mode: ModeArguments,
    #[command(flatten)]
    map: MapOptions,
    /// Folder for trajectory, keyframes, map, summary and report [default: a new folder under ./output named by the
    /// time (UTC); output/latest links to the newest]
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    points: MapPointOptions,
    /// Print the summary as JSON and show no progress
    #[arg(long)]
    json: bool,
    /// Serve the live page meanwhile [default address: 127.0.0.1:8765] (needs the package semidense-bridge)
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, require_equals = true, default_missing_value = USUAL_PAGE)]
    view: Option<SocketAddr>,
}

/// Where the live page is served where nothing else is said.
const USUAL_PAGE: &str = "127.0.0.1:8765";

/// Runs it.
pub fn run(
    config: &Config,
    common: &CommonArguments,
    log: &ErrorLog,
    arguments: RunArguments,
) -> CommandResult {
    let mut child_arguments = common.to_arguments();
    if arguments.source.strict {
        child_arguments.extend(["--set".into(), "capture.strict=true".into()]);
    }
    let map = arguments.map.of(config)?;
    if !map.folder.is_empty() {
        child_arguments.extend(MapOptions::settings(&map));
    }
    let results = arguments.points.of(&config.results);
    let config = &Config { map, results, ..config.clone() };
    let (source, rig) = arguments.source.source_and_rig(&config.capture)?;
    let mode = arguments.mode.mode(usual_mode(&source));
    let place = Place::new(&config.instance, &config.root)?;
    // First: a signal must find the folder's owner ready to remove it.
    let shutdown = Shutdown::install()?;
    let output = OutputFolder::prepare(arguments.output.as_deref())?;
    let rig = match (&source, rig) {
        (SourceName::Ros2(topic), None) => match fetch_rig(topic, output.path(), &shutdown) {
            Err(Ros2RigError::Interrupted) => return Ok(ExitCode::from(INTERRUPTED)),
            fetched => Some(fetched?),
        },
        (_, rig) => rig,
    };
    note_unfinished(&unfinished(Some(&place), output.path()));
    let journal = JournalOptions {
        output: output.path().to_owned(),
        start: RunStart {
            mode: if mode == Mode::Live { RunMode::Live } else { RunMode::Lockstep },
            ..run_start(config, &source, rig.as_deref())
        },
        max_depth_bytes: config.mapping.max_map_bytes() as u64,
    };
    let options = RunOptions {
        source,
        rig,
        mode,
        output: output.path().to_owned(),
        keeps_map: true,
        journal: Some(journal),
        arguments: child_arguments,
        log: log.clone(),
    };
    let mut page = arguments.view.map(|at| start_page(at, common, &place, log)).transpose()?;
    let display = start_display(arguments.json)?;
    let outcome = supervise(config, &options, &shutdown, &mut |progress| {
        display.show(progress);
        if let Some(address) = page.as_mut().and_then(ViewChild::look) {
            note(&format!("live page: {address}"));
        }
    });
    display.finish();
    drop(page);
    let mut outcome = outcome?;
    if outcome.record.poses.is_empty() && outcome.ended != Ended::Finished {
        // There is nothing that could be lost.
        drop(outcome.journal.take().map(Journal::finish));
        let Ended::Failed(cause) = outcome.ended else {
            note("interrupted before the first pose: there are no results");
            return Ok(ExitCode::from(INTERRUPTED));
        };
        return Err(cause.into());
    }
    let ending = Ending { output: &output, config, json: arguments.json, write_more: &|_| Ok(()) };
    ending.finish(&outcome.record, outcome.source.as_mut(), outcome.journal.take())
}

/// Starts the live page beside the run.
fn start_page(
    at: SocketAddr,
    common: &CommonArguments,
    place: &Place,
    log: &ErrorLog,
) -> Result<ViewChild, Box<dyn std::error::Error>> {
    let own = std::env::current_exe()?;
    // The instance may be named by `--set` as well.
    let common = CommonArguments { instance: Some(place.instance.clone()), ..common.clone() };
    let mut arguments = handed_on(&common);
    arguments.extend(["view".into(), "--listen".into(), at.to_string().into()]);
    let program = program(&own).ok_or(BridgeError::Missing { command: "run --view", own })?;
    let (root, log) = (place.root.clone(), log.clone());
    Ok(ViewChild::start(ViewOptions { program, arguments, root, log })?)
}
