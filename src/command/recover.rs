//! `semidense recover`: writes the results of a killed run from its journal.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::SystemTime;

use clap::Args;
use serde_json::Value;

use crate::capture::opening::open;
use crate::capture::source::{FrameSource, FrameStamp};
use crate::capture::source_error::SourceError;
use crate::capture::source_name::SourceName;
use crate::command::ending::{Ending, print_unfinished};
use crate::command::map_points::MapPointOptions;
use crate::command::print::note;
use crate::command::{CommandResult, NOTHING_TRACKED};
use crate::service::config::Config;
use crate::service::journal::Journal;
use crate::service::journal::any_bytes::AnyBytes;
use crate::service::journal::folder::{LOG, Unfinished, unfinished};
use crate::service::journal::log::RunStart;
use crate::service::journal::recovered::Recovered;
use crate::service::results::output_folder::{OutputFolder, PARENT, utc_text};
use crate::service::results::record::{EndOfRun, RunRecord};
use crate::service::results::set::has_set_since;
use crate::service::results::summary::without_depth;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::map::Map;
use crate::wire::place::Place;

/// Write the results of a killed run from the journal it left
#[derive(Debug, Args)]
pub struct RecoverArguments {
    /// Output folder of the run [default: the newest killed run of this instance]
    #[arg(value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Write the results to another folder
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    points: MapPointOptions,
    /// Keep the journal, so that the run can be recovered again
    #[arg(long)]
    keep: bool,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// Writes the results.
pub fn run(config: &Config, arguments: &RecoverArguments) -> CommandResult {
    let place = Place::new(&config.instance, &config.root)?;
    let found = find(&place, arguments.folder.as_deref())?;
    let recovered = Recovered::read(&found.folder)?;
    let output = arguments.output.clone().unwrap_or_else(|| found.output().to_owned());
    let output = std::path::absolute(output)?;
    if arguments.output.is_none()
        && has_set_since(&output, recovered.start.began())
        && !holds_recovery(&output, recovered.ended)
    {
        return Err(format!(
            "{} holds results of a later run: choose another folder with --output",
            output.display()
        )
        .into());
    }
    let held = Journal::take_over(&found.folder)?.ok_or_else(|| {
        format!(
            "{} is in use by another process, which writes or recovers it: wait until it has ended",
            found.folder.display()
        )
    })?;
    // Before the folder is locked: nothing will be written to it.
    if recovered.recording.num_poses() == 0 {
        let outcome = nothing_to_recover(&recovered, held, arguments.keep);
        forget_removed_journals(&place);
        return outcome;
    }
    let output = OutputFolder::of_recovery(&output)?;
    let start = recovered.start.clone();
    let config = Config::from_text(&start.config, "the journal's configuration");
    let mut config = config.unwrap_or_else(|error| {
        note(&format!(
            "warning: {error}; it was written by another version, and the results are made with the defaults"
        ));
        Config::default()
    });
    config.results = arguments.points.of(&config.results);
    let mut source = source_of(&start, &config);
    let record = record_of(recovered, &config, &found.folder, source.as_ref());
    if let Some(warning) = depth_warning(&record.map, &config, &found.folder) {
        note(&format!("warning: {warning}"));
    }
    let ending =
        Ending { output: &output, config: &config, json: arguments.json, write_more: &|_| Ok(()) };
    let outcome = ending.finish(&record, source.as_mut(), (!arguments.keep).then_some(held));
    forget_removed_journals(&place);
    outcome
}

/// Searching for journals removes the pointers to removed ones.
fn forget_removed_journals(place: &Place) {
    drop(unfinished(Some(place), Path::new(PARENT)));
}

/// A run that was killed before its first pose: removes its journal, and its folder if otherwise empty.
fn nothing_to_recover(recovered: &Recovered, journal: Journal, keep: bool) -> CommandResult {
    let folder = journal.folder().to_owned();
    let journal_text = match keep {
        true => format!("its journal is {}", folder.display()),
        false => "its journal is removed".to_owned(),
    };
    if !keep {
        journal.finish()?;
        drop(folder.parent().map(OutputFolder::of_recovery));
    }
    note(&format!(
        "nothing to recover: the run that ended at {} was killed before its first pose; no results are written, {journal_text}",
        utc_text(recovered.ended)
    ));
    Ok(ExitCode::from(NOTHING_TRACKED))
}

/// The warning for keyframes without depth, with the reason.
fn depth_warning(map: &Map, config: &Config, journal: &Path) -> Option<String> {
    /// A disk with less room than a few keyframes counts as full.
    const FULL_BYTES: u64 = 8 << 20;
    let missing = without_depth(map);
    let all = map.keyframes.len();
    let bytes: usize =
        map.keyframes.iter().map(|k| k.image.len() + size_of_val(&k.points[..])).sum();
    let free = rustix::fs::statvfs(journal).map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize));
    let why = if bytes >= config.mapping.max_map_bytes() {
        "only the newest is kept (mapping.max_map_megabytes)".to_owned()
    } else if let Ok(free) = free.as_ref().map(|free| free >> 20)
        && free < FULL_BYTES >> 20
    {
        format!(
            "the disk is full ({free} MB free), and the journal gave up depth to keep the poses"
        )
    } else {
        "it was not on the disk yet when the run was killed, or the disk was full".to_owned()
    };
    (missing > 0).then(|| {
        format!("depth of {missing} of {all} keyframes is missing: {why}; trajectory and keyframe poses are not affected")
    })
}

/// Whether the results in a folder were recovered from the journal of the run that ended then.
fn holds_recovery(output: &Path, ended: SystemTime) -> bool {
    let text = fs::read_to_string(output.join("summary.json")).unwrap_or_default();
    let summary: Value = serde_json::from_str(&text).unwrap_or_default();
    summary["recovered_run_end"] == utc_text(ended).as_str()
}

/// The journal to recover: the newest one of the folder, or of all.
fn find(place: &Place, folder: Option<&Path>) -> Result<Unfinished, Box<dyn Error>> {
    let mut found = match folder {
        Some(folder) => {
            if !folder.is_dir() {
                return Err(format!("{} is not a folder; check the path", folder.display()).into());
            }
            let wanted = folder.canonicalize()?;
            // The folder of the run, or its journal.
            let is_journal = wanted.join(LOG).is_file();
            let output = wanted.parent().filter(|_| is_journal).unwrap_or(&wanted);
            let all = unfinished(None, output).into_iter();
            all.filter(|f| f.output() == wanted || f.folder == wanted).collect()
        }
        None => unfinished(Some(place), Path::new(PARENT)),
    };
    let newest = found.pop().ok_or_else(|| match folder {
        Some(folder) => format!("{} holds no journal of a killed run; check the path", folder.display()),
        None => format!(
            "no killed run of instance `{}` was found, nor one in ./{PARENT}: name the output folder of the run",
            place.instance
        ),
    })?;
    print_unfinished(&found);
    Ok(newest)
}

/// Reopens the source of the run for its true poses and depth; a source without truth if it cannot be opened.
fn source_of(start: &RunStart, config: &Config) -> Box<dyn FrameSource> {
    let opened = || -> Result<Box<dyn FrameSource>, Box<dyn Error>> {
        let name = SourceName::parse(&start.source.to_os_string())?;
        if name.is_camera() {
            return Ok(Box::new(NoSource));
        }
        // Its paths are relative to where the run was started.
        let folder = start.folder.to_os_string();
        std::env::set_current_dir(&folder)
            .map_err(|error| format!("{}: {error}", folder.display()))?;
        let rig = start.rig.as_ref().map(AnyBytes::to_os_string);
        Ok(open(&name, rig.as_deref().map(Path::new), &config.source_params())?)
    };
    opened().unwrap_or_else(|error| {
        note(&format!("no comparison with ground truth: the source cannot be opened ({error})"));
        Box::new(NoSource)
    })
}

/// The record of the run from its journal.
fn record_of(
    recovered: Recovered,
    config: &Config,
    folder: &Path,
    source: &dyn FrameSource,
) -> RunRecord {
    let start = &recovered.start;
    let loaded_map = recovered.loaded_map.clone();
    let depth_scale = if start.poses_given { DepthScale::Given } else { DepthScale::MedianRatio };
    let known = RunRecord {
        ended: EndOfRun::Recovered(recovered.ended),
        map: recovered.map(folder, config.mapping.max_map_bytes() as u64),
        first_keyframe_id: loaded_map
            .as_ref()
            .map_or(start.first_keyframe_id, |map| map.first_keyframe_id),
        loaded_map,
        ground_truth: source.ground_truth().to_vec(),
        counters: recovered.counters,
        depth_scale,
        is_depth_from_sensor: start.is_depth_from_sensor,
        ..RunRecord::empty(start.mode, &start.source.to_os_string().to_string_lossy())
    };
    recovered.recording.into_record(known, config.tracker.deadline_ms)
}

/// A source that no longer exists, or never had ground truth.
struct NoSource;

impl FrameSource for NoSource {
    fn intrinsics(&self) -> Intrinsics {
        Intrinsics::pinhole(1, 1, 1.0)
    }

    fn num_frames(&self) -> Option<usize> {
        Some(0)
    }

    fn next_into(&mut self, _pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        Ok(None)
    }
}
