//! `semidense run`: the three processes, from the first frame to the report.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use crate::command::capture::{ModeArguments, SourceArguments, usual_mode};
use crate::command::ending::{Ending, note_unfinished, run_start};
use crate::command::map::MapOptions;
use crate::command::print::note;
use crate::command::run_progress::start_display;
use crate::command::{CommandResult, CommonArguments, INTERRUPTED};
use crate::service::config::Config;
use crate::service::error_log::ErrorLog;
use crate::service::journal::folder::unfinished;
use crate::service::journal::log::RunStart;
use crate::service::journal::{Journal, JournalOptions};
use crate::service::mode::Mode;
use crate::service::results::RunMode;
use crate::service::results::output_folder::OutputFolder;
use crate::service::shutdown::Shutdown;
use crate::service::supervisor::{Ended, RunOptions, run as supervise};
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
    /// Print the summary as JSON and show no progress
    #[arg(long)]
    json: bool,
}

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
    let config = &Config { map, ..config.clone() };
    let (source, rig) = arguments.source.source_and_rig(&config.capture)?;
    let mode = arguments.mode.mode(usual_mode(&source));
    let place = Place::new(&config.instance, &config.root)?;
    // First: a signal must find the folder's owner ready to remove it.
    let shutdown = Shutdown::install()?;
    let output = OutputFolder::prepare(arguments.output.as_deref())?;
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
    let display = start_display(arguments.json)?;
    let outcome = supervise(config, &options, &shutdown, &mut |p| display.show(p));
    display.finish();
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
