//! `semidense map`: commands for maps on disk.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant, UNIX_EPOCH};

use clap::{Args, Subcommand};

use crate::command::CommandResult;
use crate::command::map_points::MapPointOptions;
use crate::command::parse::no_instance;
use crate::command::print::{note, print, print_as};
use crate::command::progress::Progress;
use crate::service::config::{Config, MapConfig};
use crate::service::health::ProcessState;
use crate::service::map_folder::merge::merge;
use crate::service::map_folder::reading::{Loaded, load};
use crate::service::map_folder::report::{MapReport, export};
use crate::service::map_folder::session::check;
use crate::service::peers::Peer;
use crate::service::results::empty_map::empty_map_warning;
use crate::service::results::output_folder::utc_text;
use crate::slam::counted::counted;
use crate::wire::command::{Command, CommandClient};
use crate::wire::place::Place;
use crate::wire::port::{Access, Hub, wait};
use crate::wire::topic::MAPPER_HEALTH;

/// Check, export, save, load and merge maps on disk
///
/// A map is a folder that `run`, `replay` and the services start or continue with --map DIR.
#[derive(Debug, Args)]
pub struct MapArguments {
    #[command(subcommand)]
    command: MapCommand,
}

/// The map on disk that a command starts or continues.
#[derive(Debug, Clone, Args)]
pub struct MapOptions {
    /// Start a map in this folder, or continue the one it contains: the camera is relocalised in it and
    /// mapping continues there [default: map.folder of the configuration, empty unless set]
    #[arg(long, value_name = "DIR")]
    map: Option<PathBuf>,
    /// Only localise the camera in the map: nothing in its folder changes
    #[arg(long)]
    read_only: bool,
}

impl MapOptions {
    /// The configuration with the options of the command line. Checks the folder before anything is started.
    pub fn of(&self, config: &Config) -> Result<MapConfig, Box<dyn std::error::Error>> {
        let mut map = config.map.clone();
        if let Some(folder) = &self.map {
            let folder = std::path::absolute(folder)?;
            map.folder = folder.into_os_string().into_string().map_err(|folder| {
                format!("--map {}: name a folder whose name is UTF-8", folder.display())
            })?;
        }
        map.read_only |= self.read_only;
        if map.read_only && map.folder.is_empty() {
            return Err("--read-only locates the camera in a map: name it with --map DIR".into());
        }
        check(&map)?;
        Ok(map)
    }

    /// The same, as arguments for a child process.
    pub fn settings(map: &MapConfig) -> Vec<OsString> {
        let folder = toml::Value::String(map.folder.clone());
        let settings = [format!("map.folder={folder}"), format!("map.read_only={}", map.read_only)];
        settings.into_iter().flat_map(|setting| ["--set".into(), setting.into()]).collect()
    }
}

#[derive(Debug, Subcommand)]
enum MapCommand {
    Info(InfoArguments),
    Export(ExportArguments),
    Save(SaveArguments),
    Load(LoadArguments),
    Merge(MergeArguments),
}

/// Have the running mapper save its map now
#[derive(Debug, Args)]
struct SaveArguments {
    /// Folder without a map [default: the folder of the map in use]
    #[arg(value_name = "DIR")]
    folder: Option<PathBuf>,
}

/// Have the running mapper switch to the map in another folder
///
/// The mapper first saves its own map if that has a folder, then relocalises the camera in the other map and
/// continues there; if the camera is not found for two seconds, a new epoch starts alongside it. A map that
/// does not fit is refused, and the mapper continues with its own.
#[derive(Debug, Args)]
struct LoadArguments {
    /// Folder of the map
    #[arg(value_name = "MAP")]
    folder: PathBuf,
    /// Only localise the camera in the map: nothing in its folder changes
    #[arg(long)]
    read_only: bool,
}

/// Write two maps of one camera into one
///
/// The epochs of both are kept, each with its own origin and unit, and the camera can be found in either.
/// They are not aligned with each other, even where they show the same place.
#[derive(Debug, Args)]
#[command(arg = no_instance())]
struct MergeArguments {
    /// The first map, which keeps its numbers
    #[arg(value_name = "A")]
    first: PathBuf,
    /// The second map, whose keyframes and epochs get new numbers
    #[arg(value_name = "B")]
    second: PathBuf,
    /// Folder of the new map
    #[arg(long, value_name = "DIR")]
    output: PathBuf,
}

/// Check every file of a map and list what it contains; exit code 1 if anything is damaged
#[derive(Debug, Args)]
#[command(arg = no_instance())]
struct InfoArguments {
    /// The map's folder
    #[arg(value_name = "MAP")]
    folder: PathBuf,
    /// Print the list as JSON
    #[arg(long)]
    json: bool,
}

/// Write a map's points (map.ply) and the poses of its keyframes (keyframes.txt, TUM format)
#[derive(Debug, Args)]
struct ExportArguments {
    /// The map's folder
    #[arg(value_name = "MAP")]
    folder: PathBuf,
    /// Folder to write into
    #[arg(long, value_name = "DIR")]
    output: PathBuf,
    /// The epoch to write: each has its own origin and unit [default: the one with the most keyframes]
    #[arg(long, value_name = "N")]
    epoch: Option<u32>,
    #[command(flatten)]
    points: MapPointOptions,
}

/// Runs the chosen map command.
pub fn run(config: &Config, arguments: MapArguments) -> CommandResult {
    match arguments.command {
        MapCommand::Info(arguments) => info(&arguments),
        MapCommand::Export(arguments) => export_map(config, &arguments),
        MapCommand::Save(arguments) => save(config, &arguments),
        MapCommand::Load(arguments) => load_running(config, &arguments),
        MapCommand::Merge(arguments) => merge_maps(&arguments),
    }
}

/// Loads the whole map and prints a warning for each damaged file.
fn load_all(folder: &Path) -> Result<Loaded, Box<dyn std::error::Error>> {
    let loaded = load(folder, usize::MAX)?;
    loaded.problems.iter().for_each(|problem| note(&format!("warning: {problem}")));
    Ok(loaded)
}

fn info(arguments: &InfoArguments) -> CommandResult {
    let loaded = load_all(&arguments.folder)?;
    let report = MapReport::of(&arguments.folder, &loaded);
    print_as(arguments.json, &report, text_of)?;
    Ok(ExitCode::from(u8::from(!report.problems.is_empty())))
}

fn text_of(report: &MapReport) -> String {
    const MEGABYTE: f64 = 1e6;
    let [fx, fy, cx, cy] = report.intrinsics;
    let saved = UNIX_EPOCH + Duration::from_secs(report.saved_secs);
    let detail = serde_json::to_value(report.detail).ok();
    let detail = detail.as_ref().and_then(serde_json::Value::as_str).unwrap_or_default();
    let mut lines = vec![
        format!("version    {}, {detail} detail", report.version),
        format!(
            "camera     {}x{}, fx {fx:.2}, fy {fy:.2}, cx {cx:.2}, cy {cy:.2}",
            report.width, report.height
        ),
        format!(
            "keyframes  {}, {} of them with depth, {}, certain or not",
            report.keyframes,
            report.keyframes_with_depth,
            counted(report.points, "point")
        ),
        format!("size       {:.1} MB", report.bytes as f64 / MEGABYTE),
        format!(
            "saved      {} (UTC), {}; corrected {}",
            utc_text(saved),
            counted(report.saves, "time"),
            counted(report.revision, "time")
        ),
    ];
    lines.extend(report.epochs.iter().map(|of| {
        format!(
            "epoch {:<4} {}, path {:.2} map units",
            of.epoch,
            counted(of.keyframes, "keyframe"),
            of.path_length
        )
    }));
    lines.join("\n") + "\n"
}

fn export_map(config: &Config, arguments: &ExportArguments) -> CommandResult {
    let loaded = load_all(&arguments.folder)?;
    let report = MapReport::of(&arguments.folder, &loaded);
    let largest = report.epochs.iter().rev().max_by_key(|of| of.keyframes).map(|of| of.epoch);
    let epoch = arguments.epoch.or(largest).ok_or_else(|| {
        format!("{} holds no keyframes yet: there is nothing to export", arguments.folder.display())
    })?;
    if report.epochs.iter().all(|of| of.epoch != epoch) {
        let known: Vec<String> = report.epochs.iter().map(|of| of.epoch.to_string()).collect();
        return Err(format!(
            "{} has no epoch {epoch}: it has {}",
            arguments.folder.display(),
            known.join(", ")
        )
        .into());
    }
    let params = arguments.points.of(&config.results);
    let progress = Progress::new("fusing the map", Some(loaded.map.keyframes.len()));
    let mut show = |done, _| progress.update(done, "");
    let exported = export(&arguments.output, &loaded.map, epoch, &params, &mut show);
    progress.finish();
    let (points, keyframes) =
        exported.map_err(|error| format!("{}: {error}", arguments.output.display()))?;
    if let Some(warning) = empty_map_warning(report.points, points, params.map_resolution) {
        note(&format!("warning: {warning}"));
    }
    print(&format!(
        "{}: map.ply with {}, keyframes.txt with {} of epoch {epoch}\n",
        arguments.output.display(),
        counted(points, "point"),
        counted(keyframes, "pose")
    ))?;
    Ok(ExitCode::SUCCESS)
}

fn save(config: &Config, arguments: &SaveArguments) -> CommandResult {
    let folder = arguments.folder.as_ref().map(std::path::absolute).transpose()?;
    ask(config, "map-save", &Command::SaveFolder(folder.clone().unwrap_or_default()))?;
    let place = folder
        .map_or("the folder of the map in use".to_owned(), |folder| folder.display().to_string());
    print(&format!("saved in {place}\n"))?;
    Ok(ExitCode::SUCCESS)
}

fn load_running(config: &Config, arguments: &LoadArguments) -> CommandResult {
    let folder = std::path::absolute(&arguments.folder)?;
    let read_only = arguments.read_only;
    ask(config, "map-load", &Command::LoadFolder { folder: folder.clone(), read_only })?;
    print(&format!("loaded {}; the camera is relocalised in it\n", folder.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Sends the command to the running mapper and waits until it is done.
fn ask(config: &Config, name: &str, command: &Command) -> Result<(), Box<dyn std::error::Error>> {
    let place = Place::new(&config.instance, &config.root)?;
    let hub = Hub::join(&place, name, Access::Observer)?;
    let mut mapper = ready_mapper(&hub)?;
    let timeout = Duration::from_secs_f64(config.supervisor.save_timeout_s);
    let is_alive = || {
        let is_over = matches!(mapper.state(), Some(ProcessState::Finished | ProcessState::Failed));
        mapper.update().is_ok() && !is_over
    };
    Ok(CommandClient::open(&hub)?.ask(command, timeout, is_alive)?)
}

/// The running mapper, once it accepts commands.
fn ready_mapper(hub: &Hub) -> Result<Peer, Box<dyn std::error::Error>> {
    /// Longer than the period of the health reports.
    const LONGEST: Duration = Duration::from_secs(3);
    const PAUSE: Duration = Duration::from_millis(20);
    let mut mapper = Peer::open(hub, &MAPPER_HEALTH)?;
    let begin = Instant::now();
    while begin.elapsed() < LONGEST {
        mapper.update()?;
        if mapper.is_ready() {
            return Ok(mapper);
        }
        wait(&[], None, PAUSE)?;
    }
    Err("no mapper is running: a run with --map DIR loads and saves its map by itself".into())
}

fn merge_maps(arguments: &MergeArguments) -> CommandResult {
    let same =
        || Some(arguments.first.canonicalize().ok()? == arguments.second.canonicalize().ok()?);
    if same().unwrap_or(false) {
        let folder = arguments.first.display();
        return Err(format!("{folder} is named twice: name two maps").into());
    }
    let (first, second) = (load_all(&arguments.first)?, load_all(&arguments.second)?);
    let map = merge(&arguments.output, [first, second], [&arguments.first, &arguments.second])?;
    print(&format!(
        "{}: {}; the epochs of both maps are kept apart\n",
        arguments.output.display(),
        counted(map.keyframes.len(), "keyframe")
    ))?;
    Ok(ExitCode::SUCCESS)
}
