//! `semidense run`: the three processes, from the first frame to the report.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use crate::capture::source::SourceName;
use crate::command::capture::{ModeArguments, usual_mode};
use crate::command::print::{note, print};
use crate::command::run_progress::RunDisplay;
use crate::command::{CommandResult, CommonArguments, INTERRUPTED};
use crate::service::config::Config;
use crate::service::results::summary_text::summary_text;
use crate::service::results::{prepare_output, write_results};
use crate::service::shutdown::Shutdown;
use crate::service::supervisor::{Ended, RunOptions, run as supervise};

/// Start capture, tracker and mapper on a source, watch them, and write the results
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Where frames come from: sim, sim:SCENE, tum:DIR, euroc:DIR or images:DIR
    #[arg(long, value_name = "SOURCE", default_value = "sim")]
    source: String,
    /// Rig file with the camera's calibration
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    mode: ModeArguments,
    /// Folder for trajectory, keyframes, map, summary and report
    #[arg(long, value_name = "DIR", default_value = "output")]
    output: PathBuf,
    /// Print the summary as JSON, and no progress
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(config: &Config, common: &CommonArguments, arguments: RunArguments) -> CommandResult {
    let source: SourceName = arguments.source.parse()?;
    let mode = arguments.mode.mode(usual_mode(&source));
    prepare_output(&arguments.output)?;
    let shutdown = Shutdown::install()?;
    let options = RunOptions {
        source,
        rig: arguments.rig,
        mode,
        output: arguments.output.clone(),
        keeps_map: true,
        arguments: common.to_arguments(),
    };
    let mut display = RunDisplay::new(arguments.json);
    let mut outcome = supervise(config, &options, &shutdown, &mut |p| display.show(p))?;
    display.finish();
    if outcome.record.poses.is_empty() && outcome.ended == Ended::Interrupted {
        note("interrupted before the first pose: there are no results");
        return Ok(ExitCode::from(INTERRUPTED));
    }
    if let (true, Ended::Failed(cause)) = (outcome.record.poses.is_empty(), &outcome.ended) {
        return Err(cause.as_str().into());
    }
    let source = outcome.source.as_mut();
    let summary = write_results(&arguments.output, &outcome.record, source, &config.results)?;
    if arguments.json {
        print(&format!("{}\n", serde_json::to_string_pretty(&summary)?))?;
    } else {
        let place = arguments.output.display();
        print(&format!("{}results in {place}\n", summary_text(&summary)))?;
    }
    match outcome.ended {
        Ended::Finished => Ok(ExitCode::SUCCESS),
        Ended::Interrupted => {
            note(&format!("interrupted: the results so far are in {}", arguments.output.display()));
            Ok(ExitCode::from(INTERRUPTED))
        }
        Ended::Failed(cause) => Err(cause.into()),
    }
}
