//! `semidense recover`: the results of a run that was killed, from its journal.

use std::error::Error;
use std::path::{Path, PathBuf};

use clap::Args;

use crate::capture::source::{FrameSource, FrameStamp, SourceError, SourceName, open};
use crate::command::CommandResult;
use crate::command::ending::{Ending, note_unfinished};
use crate::command::print::note;
use crate::service::config::Config;
use crate::service::journal::Journal;
use crate::service::journal::folder::{Unfinished, unfinished};
use crate::service::journal::log::RunStart;
use crate::service::journal::recovered::Recovered;
use crate::service::recording::RecordParts;
use crate::service::results::output_folder::{OutputFolder, PARENT};
use crate::service::results::set::has_set_since;
use crate::service::results::{EndOfRun, RunRecord};
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::wire::place::Place;

/// Write the results of a run that was killed, from the journal that it has left
#[derive(Debug, Args)]
pub struct RecoverArguments {
    /// Output folder of the run [default: the newest run of this instance that was killed]
    #[arg(value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Another folder for the results
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Keep the journal, to recover the run again
    #[arg(long)]
    keep: bool,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(config: &Config, arguments: &RecoverArguments) -> CommandResult {
    let place = Place::new(&config.instance, &config.root)?;
    let found = find(&place, arguments.folder.as_deref())?;
    let recovered = Recovered::read(&found.folder)?;
    let output = arguments.output.clone().unwrap_or_else(|| found.output().to_owned());
    let output = std::path::absolute(output)?;
    if arguments.output.is_none() && has_set_since(&output, recovered.start.began()) {
        return Err(format!(
            "{} has results of a later run: name another folder with --output",
            output.display()
        )
        .into());
    }
    let output = OutputFolder::prepare(Some(&output))?;
    let held = Journal::take_over(&found.folder)?.ok_or_else(|| {
        format!("{} is being written or recovered by another process", found.folder.display())
    })?;
    let start = recovered.start.clone();
    let config = Config::from_text(&start.config, "the journal's configuration")?;
    let mut source = source_of(&start, &config);
    let record = record_of(recovered, &config, &found.folder, source.as_ref());
    let ending =
        Ending { output: &output, config: &config, json: arguments.json, write_more: &|_| Ok(()) };
    ending.finish(&record, source.as_mut(), (!arguments.keep).then_some(held))
}

/// The journal that is meant: the newest one of the folder, or of all.
fn find(place: &Place, folder: Option<&Path>) -> Result<Unfinished, Box<dyn Error>> {
    let mut found = match folder {
        Some(folder) => {
            if !folder.is_dir() {
                return Err(
                    format!("there is no folder {}; check the path", folder.display()).into()
                );
            }
            let wanted = folder.canonicalize()?;
            let all = unfinished(None, folder).into_iter();
            all.filter(|f| f.output() == wanted || f.folder == wanted).collect()
        }
        None => unfinished(Some(place), Path::new(PARENT)),
    };
    let newest = found.pop().ok_or_else(|| match folder {
        Some(folder) => format!("{} has no journal of a run that was killed", folder.display()),
        None => format!(
            "instance `{}` has left no journal, and there is none in ./{PARENT}: name the output folder of the run",
            place.instance
        ),
    })?;
    note_unfinished(&found);
    Ok(newest)
}

/// The source of the run once more, for its true poses and depth; none where it cannot be opened.
fn source_of(start: &RunStart, config: &Config) -> Box<dyn FrameSource> {
    let opened = || -> Result<Box<dyn FrameSource>, Box<dyn Error>> {
        let name: SourceName = start.source.parse()?;
        if name.is_camera() {
            return Ok(Box::new(NoSource));
        }
        // Its paths are relative to where the run was started.
        std::env::set_current_dir(&start.folder)
            .map_err(|error| format!("{}: {error}", start.folder))?;
        Ok(open(&name, start.rig.as_deref().map(Path::new), &config.source_params())?)
    };
    opened().unwrap_or_else(|error| {
        note(&format!("no figures against ground truth: the source cannot be opened ({error})"));
        Box::new(NoSource)
    })
}

/// What the journal has of the run.
fn record_of(
    recovered: Recovered,
    config: &Config,
    folder: &Path,
    source: &dyn FrameSource,
) -> RunRecord {
    let start = &recovered.start;
    let depth_scale = if start.poses_given { DepthScale::Given } else { DepthScale::MedianRatio };
    let parts = RecordParts {
        mode: start.mode,
        source: start.source.clone(),
        map: recovered.map(folder, config.mapping.max_map_bytes() as u64),
        ground_truth: source.ground_truth().to_vec(),
        depth_scale,
        deadline_ms: config.tracker.deadline_ms,
        counters: recovered.counters,
    };
    let record = recovered.recording.into_record(parts);
    RunRecord { ended: EndOfRun::Recovered, ..record }
}

/// A source that is not there any more, or never had any truth.
struct NoSource;

impl FrameSource for NoSource {
    fn intrinsics(&self) -> Intrinsics {
        Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 1, height: 1 }
    }

    fn num_frames(&self) -> Option<usize> {
        Some(0)
    }

    fn next_into(&mut self, _pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        Ok(None)
    }
}
