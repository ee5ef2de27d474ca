//! The end of a run, a replay or a recovery: written results, final output, exit code.

use std::collections::BTreeSet;
use std::error::Error;
use std::path::Path;
use std::process::ExitCode;
use std::time::{SystemTime, UNIX_EPOCH};

use crate::capture::source::FrameSource;
use crate::capture::source_name::SourceName;
use crate::command::print::{note, print_as, print_outcome};
use crate::command::progress::Progress;
use crate::command::{CommandResult, INTERRUPTED, NOTHING_TRACKED};
use crate::service::config::{Config, MapConfig};
use crate::service::journal::folder::Unfinished;
use crate::service::journal::log::RunStart;
use crate::service::journal::{Journal, JournalOptions};
use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::service::map_folder::reading::read_manifest;
use crate::service::map_folder::session::first_own_id;
use crate::service::results::Results;
use crate::service::results::calibration::calibration_warning;
use crate::service::results::empty_map::empty_map_warning;
use crate::service::results::mapping_load::mapping_warning;
use crate::service::results::output_folder::OutputFolder;
use crate::service::results::record::{EndOfRun, RunMode, RunRecord};
use crate::service::results::results_error::ResultsError;
use crate::service::results::set::has_tracked_set;
use crate::service::results::summary::{PointCounts, Summary};
use crate::service::results::summary_text::{recovery_text, refused_text, summary_text};
use crate::slam::counted::counted;

/// Where and how results are written.
pub struct Ending<'a> {
    /// The results folder.
    pub output: &'a OutputFolder,
    /// Settings of the evaluation.
    pub config: &'a Config,
    /// Whether the summary is printed as JSON.
    pub json: bool,
    /// Writes further files of the result set into the given folder.
    pub write_more: &'a (dyn Fn(&Path) -> Result<(), ResultsError> + Sync),
}

impl Ending<'_> {
    /// Writes the results of `record` and prints the outcome. A run that tracked nothing does not replace one
    /// that did. The journal is removed once the results of its run are written.
    pub fn finish(
        &self,
        record: &RunRecord,
        source: &mut dyn FrameSource,
        journal: Option<Journal>,
    ) -> CommandResult {
        let output = self.output.path();
        let place = output.display().to_string();
        let progress = Progress::new("fusing the map", Some(record.map.keyframes.len()));
        let results = Results::new(record, source, &self.config.results, &mut |done, _| {
            progress.update(done, "");
        })?;
        progress.finish();
        let is_tracked = results.summary.frames.frames_tracked > 0;
        // A failed run with poses but no map: a full disk, a mapper that has died.
        let is_torn =
            matches!(record.ended, EndOfRun::Failed(_)) && results.summary.point_counts.points == 0;
        let keeps_earlier = (!is_tracked || is_torn) && has_tracked_set(output);
        let keeps_journal = is_torn && is_tracked && keeps_earlier;
        if !keeps_earlier {
            results
                .write(output, self.write_more)
                .map_err(|error| not_written_text(&error, output, journal.as_ref()))?;
        }
        if is_tracked && !keeps_earlier {
            self.output.become_latest().unwrap_or_else(|error| {
                note(&format!(
                    "warning: results in {place} are written, but output/latest cannot be linked to them ({error})"
                ));
            });
        }
        let kept = journal
            .as_ref()
            .filter(|_| keeps_journal)
            .map(|journal| recover_command(journal.folder().parent().unwrap_or(output), true));
        if let Some(Err(error)) = journal.filter(|_| !keeps_journal).map(Journal::finish) {
            note(&format!("warning: cannot remove the journal of this run ({error})"));
        }
        self.print_summary(&results.summary)?;
        let where_to = match (keeps_earlier, kept) {
            (true, Some(command)) => format!(
                "the earlier results in {place} are kept, and so is the journal of this run: `{command}` writes its results"
            ),
            (true, None) => format!("nothing was written, the earlier results in {place} are kept"),
            (false, _) => format!("results in {place}"),
        };
        if !self.json {
            let (recovery, refused) =
                (recovery_text(&results.summary), refused_text(&results.summary));
            let MapConfig { folder, read_only, .. } = &self.config.map;
            let loaded = record.loaded_map.iter().map(|of| (&of.folder, of.read_only));
            let maps = [(folder, *read_only)].into_iter().chain(loaded);
            let maps = maps.filter_map(|(folder, read_only)| map_text(folder, read_only));
            let map: String = maps.map(|text| format!("{text}\n")).collect();
            print_outcome(&format!("{map}{where_to}{recovery}{refused}\n"))?;
        }
        self.conclude(&record.ended, &results.summary, &where_to)
    }

    /// Prints the final message and chooses the exit code.
    fn conclude(&self, ended: &EndOfRun, summary: &Summary, where_to: &str) -> CommandResult {
        let untracked = summary.untracked.as_deref();
        if let EndOfRun::Failed(cause) = ended {
            return Err(cause.as_str().into());
        }
        // With the summary as JSON, standard output does not name the results folder.
        let place = Some(where_to).filter(|_| self.json);
        if let Some(words) = closing_text(ended, untracked, place) {
            note(&words);
        }
        Ok(match ended {
            EndOfRun::Interrupted => ExitCode::from(INTERRUPTED),
            _ if untracked.is_some() => ExitCode::from(NOTHING_TRACKED),
            _ => ExitCode::SUCCESS,
        })
    }

    /// Prints the figures, and warnings about what the user can change. If nothing was tracked, the reason is printed
    /// later.
    fn print_summary(&self, summary: &Summary) -> Result<(), Box<dyn Error>> {
        print_as(self.json, summary, summary_text)?;
        if self.json {
            return Ok(());
        }
        let Summary { mode, frames_in, frames_skipped_by_mapper: skipped, .. } = *summary;
        // Given poses contradict a map without the rig being wrong.
        let is_tracked = summary.times.track_ms.is_some();
        let rejections = summary.map_rejections.as_ref().filter(|_| is_tracked);
        let num_rejections = rejections.map_or(0, Vec::len);
        let calibration = calibration_warning(summary.whitened_residual_median, num_rejections);
        let mapping = mapping_warning(mode, skipped, frames_in);
        let PointCounts { points, map_points, .. } = summary.point_counts;
        let empty = empty_map_warning(points, map_points, self.config.results.map_resolution);
        let of_tracked = mapping.into_iter().chain(empty).filter(|_| summary.untracked.is_none());
        for warning in calibration.into_iter().chain(of_tracked) {
            note(&format!("warning: {warning}"));
        }
        Ok(())
    }
}

/// How a run ended if not normally, and the `place` of its results.
fn closing_text(ended: &EndOfRun, untracked: Option<&str>, place: Option<&str>) -> Option<String> {
    let how = match (ended, untracked) {
        (EndOfRun::Interrupted, None) => "interrupted".to_owned(),
        (EndOfRun::Interrupted, Some(why)) => {
            format!("interrupted, and nothing was tracked: {why}")
        }
        (_, Some(why)) => format!("nothing was tracked: {why}"),
        (_, None) => return None,
    };
    Some(match place {
        Some(place) => format!("{how}; {place}"),
        None => how,
    })
}

/// What the folder of a map of the run holds now; `None` where the run had none.
fn map_text(folder: &str, read_only: bool) -> Option<String> {
    if folder.is_empty() {
        return None;
    }
    Some(match read_manifest(Path::new(folder)) {
        Ok((manifest, _)) => {
            let keyframes = counted(manifest.keyframes.len(), "keyframe");
            let epochs: BTreeSet<u32> =
                manifest.keyframes.iter().map(|listed| listed.keyframe.epoch).collect();
            let in_epochs = counted(epochs.len(), "epoch");
            let unchanged = if read_only { ", unchanged" } else { "" };
            format!("map in {folder}: {keyframes} in {in_epochs}{unchanged}")
        }
        Err(MapFolderError::Missing(_)) => format!("no map was begun in {folder}"),
        Err(error) => error.to_string(),
    })
}

/// The message for results that could not be written: nothing is lost.
fn not_written_text(error: &ResultsError, output: &Path, journal: Option<&Journal>) -> String {
    let Some(journal) = journal else { return error.to_string() };
    format!(
        "{error}; {} is unchanged and the journal of this run is in {}: `{}` writes its results",
        output.display(),
        journal.folder().display(),
        recover_command(journal.folder().parent().unwrap_or(output), false)
    )
}

/// The command that recovers the journal in a folder, next to existing results or over them.
fn recover_command(output: &Path, beside: bool) -> String {
    let quoted = |path: String| {
        let is_plain = |c: char| c.is_alphanumeric() || "/._-".contains(c);
        match path.chars().all(is_plain) {
            true => path,
            false => format!("'{}'", path.replace('\'', r"'\''")),
        }
    };
    let path = output.display().to_string();
    let elsewhere = format!(" --output {}", quoted(format!("{path}-recovered")));
    format!("semidense recover {}{}", quoted(path), if beside { &elsewhere } else { "" })
}

/// Prints where the journals of killed runs are and the command that recovers them.
pub fn print_unfinished(found: &[Unfinished]) {
    for unfinished in found {
        note(&format!(
            "a run was killed before its results were written; its journal is {}: write them with `{}`",
            unfinished.folder.display(),
            recover_command(unfinished.output(), has_tracked_set(unfinished.output()))
        ));
    }
}

/// Journal of a replay that is starting, from which it can be recovered if it is killed.
pub fn journal_options(
    config: &Config,
    source: &SourceName,
    rig: Option<&Path>,
    output: &Path,
) -> JournalOptions {
    let folder = std::env::current_dir().unwrap_or_default();
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let start = RunStart {
        mode: RunMode::Replay,
        source: source.to_os_string().into(),
        rig: rig.map(Into::into),
        folder: folder.into(),
        config: config.to_text(),
        poses_given: false,
        is_depth_from_sensor: false,
        first_keyframe_id: first_own_id(&config.map),
        began_nanos: since.map_or(0, |since| since.as_nanos() as u64),
    };
    let max_depth_bytes = config.mapping.max_map_bytes() as u64;
    JournalOptions { output: output.to_owned(), start, max_depth_bytes }
}
