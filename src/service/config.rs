//! The configuration: every parameter struct in one place, read once, checked once.
//!
//! Precedence: built-in < `semidense.toml` < `--set key=value`; a rig file holds only the camera. Unknown keys are
//! refused; an error names the place, the key, the value and what is allowed. A file has two parts, see `layout`: keys
//! that a user may want to set, and `[expert]`.

mod layout;
mod origins;

use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::de::DeTable;
use toml::{Table, Value};

use crate::capture::input_file;
use crate::capture::opening::SourceParams;
use crate::capture::rig::READOUT_MS_RANGE;
use crate::capture::simulator::params::SimulatorParams;
use crate::capture::v4l::params::CameraParams;
pub use crate::service::config::origins::{EffectiveKey, Origin};
pub use crate::service::config_error::ConfigError;
use crate::service::corrected::Corrections;
use crate::service::map_folder::depth_file::MapDetail;
use crate::service::results::ResultsParams;
use crate::service::schedule::{Background, SchedulingParams};
use crate::slam::image::noise::ImageNoise;
use crate::slam::mapper::MapperParams;
use crate::slam::mapper::observation::DepthFilter;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::tracker::TrackerParams;

/// Folder of the files that are read when no other is named: `<instance>.toml`, else `semidense.toml`.
pub const SYSTEM_FOLDER: &str = "/etc/semidense";
/// Largest configuration file, bytes; one with every key has 30 kB.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Read for every instance without its own file.
const COMMON_FILE: &str = "semidense.toml";

/// All settings. In a file most of them are below `[expert]`, see `layout`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// First part of every topic's name, so that two instances can run side by side.
    pub instance: String,
    /// Folder of sockets and locks; empty for the usual one (`SEMIDENSE_ROOT`, systemd's
    /// `RUNTIME_DIRECTORY`, `/run/semidense` for the user of the services, `$XDG_RUNTIME_DIR/semidense`, or one
    /// in the temporary folder).
    pub root: String,
    /// The capture process.
    pub capture: CaptureConfig,
    /// The tracker process.
    pub tracker: TrackerConfig,
    /// The mapper process.
    pub mapper: MapperConfig,
    /// Starting and watching the three processes.
    pub supervisor: SupervisorConfig,
    /// Noise of the camera's images, for tracking and mapping alike.
    pub noise: ImageNoise,
    /// The map on disk.
    pub map: MapConfig,
    /// Parameters of tracking.
    pub tracking: TrackerParams,
    /// Parameters of mapping.
    pub mapping: MapperParams,
    /// Contents of a run's files.
    pub results: ResultsParams,
    /// The simulated camera and its world.
    pub simulator: SimulatorParams,
}

/// The capture process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CaptureConfig {
    /// Source of the frames when the command line names none: a folder whose layout is recognised, `sim`, `sim:SCENE`,
    /// `tum:DIR`, `euroc:DIR`, `images:DIR`, `mcap:FILE[:TOPIC]`, `v4l:DEVICE`, `ros2:TOPIC`, `stream:SOCKET` or
    /// `loop:FRAMES:HZ:SOURCE`.
    pub source: String,
    /// The camera's rig file unless `--rig` names one; empty for none. In a configuration file a path is relative to
    /// that file.
    pub rig: String,
    /// The camera's mask unless `--mask` names one; empty for none: an image of the camera, unrectified, black where it
    /// sees the robot itself and white elsewhere. In a configuration file a path is relative to that file.
    pub mask: String,
    /// Whether a damaged or missing image of a recording ends the run with an error, as `--strict` does; otherwise it
    /// is left out and counted.
    pub strict: bool,
    /// Whether the grey levels of dim images are doubled up to three times before anything is estimated from them.
    pub brighten: bool,
    /// Whether the rolling shutter is undone: images are resampled as if all rows had been exposed together.
    pub undo_rolling_shutter: bool,
    /// Time in which the camera reads out all rows, milliseconds; 0 is what the rig says.
    pub readout_ms: f64,
    /// Whether the vignette of the lens is estimated and undone.
    pub undo_vignette: bool,
    /// Longest wait for tracker and mapper to get ready before a recording starts, seconds.
    pub connect_timeout_s: f64,
    /// Lockstep: longest wait for a frame to enter the map, seconds.
    pub step_timeout_s: f64,
    /// Scheduling it requests from the kernel. On a robot: fifo, above the tracker's priority.
    pub scheduling: SchedulingParams,
    /// Settings it requests from a camera (source `v4l:DEVICE`).
    pub camera: CameraParams,
}

impl Default for CaptureConfig {
    fn default() -> Self {
        Self {
            source: "sim".to_owned(),
            rig: String::new(),
            mask: String::new(),
            strict: false,
            brighten: true,
            undo_rolling_shutter: true,
            readout_ms: 0.0,
            undo_vignette: true,
            connect_timeout_s: 30.0,
            step_timeout_s: 60.0,
            scheduling: SchedulingParams { priority: 80, ..SchedulingParams::default() },
            camera: CameraParams::default(),
        }
    }
}

impl CaptureConfig {
    /// What is corrected in the images.
    pub fn corrections(&self) -> Corrections {
        let configured_s = (self.readout_ms > 0.0).then_some(1e-3 * self.readout_ms);
        let readout_s = if self.undo_rolling_shutter { configured_s } else { Some(0.0) };
        Corrections { brighten: self.brighten, readout_s, undo_vignette: self.undo_vignette }
    }
}

/// The tracker process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackerConfig {
    /// Live: time from a frame's arrival to its pose, milliseconds; 0 is half the time between two
    /// frames. At the deadline the best pose so far is published as degraded (budget).
    pub deadline_ms: f64,
    /// Live: the frame loop wakes this long before a frame is expected and polls for it until as long after,
    /// microseconds; 0 sleeps until it arrives. A sleeping CPU takes about 100 to wake; 300 costs 2 % of a CPU at 30
    /// Hz. Only while frames arrive when expected.
    pub early_wake_us: f64,
    /// Live: frame periods without a frame after which tracker and mapper are stale.
    pub stale_periods: f64,
    /// Scheduling its frame loop requests from the kernel. On a robot: fifo, and locked memory.
    pub scheduling: SchedulingParams,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        let scheduling = SchedulingParams::default();
        Self { deadline_ms: 0.0, early_wake_us: 0.0, stale_periods: 10.0, scheduling }
    }
}

/// The mapper process.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapperConfig {
    /// Threads of its pool; 0 is one per CPU. The map does not depend on it.
    pub threads: usize,
    /// Live: scheduling of the thread that estimates keyframes jointly, which no frame waits for: `idle`, when a CPU
    /// has nothing else to do, or `other`, like its other threads, where idle leaves it no time.
    pub background: Background,
    /// Scheduling it requests from the kernel for all its threads. It has no deadline: where there are enough CPUs,
    /// keep it off the tracker's.
    pub scheduling: SchedulingParams,
}

/// The map on disk.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapConfig {
    /// Folder of the map that a run begins or continues unless `--map` names one; empty for none. In a configuration
    /// file a path is relative to that file.
    pub folder: String,
    /// Whether the camera is only located in it, as with `--read-only`: nothing in the folder changes.
    pub read_only: bool,
    /// How much of each keyframe a new map keeps: `full` or `small`.
    pub detail: MapDetail,
}

/// Starting and watching the three processes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SupervisorConfig {
    /// Live: how often in a row processes that die within two seconds of their start are restarted before the run is
    /// given up. A process that has lived longer is always restarted, and so is one that was ready and was killed
    /// (SIGKILL), up to ten times in a row.
    pub max_restarts: u32,
    /// Longest time without a sign of life from a process before it is killed, seconds; live it is restarted, in
    /// lockstep the run ends. 0 waits forever.
    pub watchdog_s: f64,
    /// Longest wait for a process to end before it is killed, seconds.
    pub stop_timeout_s: f64,
    /// Longest wait for the mapper to write its map, seconds.
    pub save_timeout_s: f64,
}

impl Default for SupervisorConfig {
    fn default() -> Self {
        Self { max_restarts: 5, watchdog_s: 10.0, stop_timeout_s: 5.0, save_timeout_s: 120.0 }
    }
}

impl Default for Config {
    fn default() -> Self {
        Self {
            instance: "semidense".to_owned(),
            root: String::new(),
            capture: CaptureConfig::default(),
            tracker: TrackerConfig::default(),
            mapper: MapperConfig::default(),
            supervisor: SupervisorConfig::default(),
            noise: ImageNoise::default(),
            map: MapConfig::default(),
            tracking: TrackerParams::default(),
            mapping: MapperParams::default(),
            results: ResultsParams::default(),
            simulator: SimulatorParams::default(),
        }
    }
}

impl Config {
    /// Reads the file, if one is named, and applies `settings`, each `key=value`, in order.
    pub fn load(file: Option<&Path>, settings: &[String]) -> Result<Self, ConfigError> {
        let mut table = Table::new();
        if let Some(path) = file {
            table = Self::read_table(path)?;
            place_beside(&mut table, path, ["capture", "rig"]);
            place_beside(&mut table, path, ["capture", "mask"]);
            place_beside(&mut table, path, ["map", "folder"]);
        }
        let mut config = Self::from_table(&table, "the built-in configuration")?;
        for setting in settings {
            let place = format!("--set {setting}");
            apply(&mut table, setting)
                .map_err(|reason| ConfigError::Syntax { place: place.clone(), reason })?;
            config = Self::from_table(&table, &place)?;
        }
        Ok(config)
    }

    /// Reads the keys that a file names, without `expert.`.
    fn read_table(file: &Path) -> Result<Table, ConfigError> {
        let text = input_file::read_text(file, MAX_FILE_BYTES)
            .map_err(|source| ConfigError::Read { path: file.to_owned(), source })?;
        Ok(Self::read(&text, &file.display().to_string())?.1)
    }

    /// Parameters of the sources.
    pub fn source_params(&self) -> SourceParams {
        SourceParams { simulator: self.simulator.clone(), camera: self.capture.camera.clone() }
    }

    /// The configuration as TOML with every key, in the two parts of the shipped file.
    pub fn to_text(&self) -> String {
        // Every field is a plain value that TOML can hold. As text, numbers keep their shortest form.
        let flat = toml::to_string(self).unwrap_or_default().parse().unwrap_or_default();
        toml::to_string(&layout::split(&flat)).unwrap_or_default()
    }

    /// Reads the text of a configuration that came from `file`; keys it does not name have their defaults.
    pub fn from_text(text: &str, file: &str) -> Result<Self, ConfigError> {
        Self::read(text, file).map(|(config, _)| config)
    }

    /// The configuration in a text, and the keys that the text names, without `expert.`.
    fn read(text: &str, file: &str) -> Result<(Self, Table), ConfigError> {
        let syntax = |span: Option<Range<usize>>, message: &str| {
            let before = span.as_ref().and_then(|span| text.get(..span.start));
            let line = before.map_or(1, |before| before.matches('\n').count() + 1);
            ConfigError::Syntax {
                place: format!("{file}:{line}"),
                reason: one_line(message, span, text),
            }
        };
        let of_parser = |error: toml::de::Error| syntax(error.span(), error.message());
        let mut root = DeTable::parse(text).map_err(of_parser)?;
        layout::merge(root.get_mut())
            .and_then(|()| layout::find_moved(root.get_ref()))
            .map_err(|e| syntax(Some(e.span), &e.reason))?;
        let mut config =
            Self::deserialize(toml::Deserializer::from(root.clone())).map_err(of_parser)?;
        config.complete(file)?;
        let table = Table::deserialize(toml::Deserializer::from(root)).map_err(of_parser)?;
        Ok((config, table))
    }

    fn from_table(table: &Table, place: &str) -> Result<Self, ConfigError> {
        let mut config: Self = table.clone().try_into().map_err(|error: toml::de::Error| {
            let known = Table::try_from(Self::default()).unwrap_or_default();
            let unknown = unknown_key(table, &known, "");
            let reason = unknown.unwrap_or_else(|| one_line(error.message(), None, ""));
            ConfigError::Syntax { place: place.to_owned(), reason }
        })?;
        config.complete(place)?;
        Ok(config)
    }

    /// Checks every value, with errors that name `place` and the key as the shipped file lists it, and passes on shared
    /// values.
    fn complete(&mut self, place: &str) -> Result<(), ConfigError> {
        self.validate().map_err(|source| {
            let source = ParameterError { key: layout::listed(&source.key), ..source };
            ConfigError::Value { place: place.to_owned(), source }
        })?;
        self.share();
        Ok(())
    }

    /// Gives tracker and mapper the values they share.
    fn share(&mut self) {
        let (tracking, mapping) = (&mut self.tracking, &mut self.mapping);
        mapping.reuse.distance = tracking.keyframe_distance();
        tracking.alignment.noise = self.noise;
        tracking.reference.selection.noise = self.noise;
        mapping.matching.noise = self.noise;
        mapping.two_frame.fit.noise = self.noise;
        self.results.has_spread_points = mapping.depth_filter == DepthFilter::Interval;
    }

    /// Checks every value.
    fn validate(&self) -> Result<(), ParameterError> {
        // More than an hour is a mistaken unit.
        let seconds = 0.1..=3600.0;
        let capture = &self.capture;
        check_range("capture.readout_ms", capture.readout_ms, READOUT_MS_RANGE)?;
        check_range("capture.connect_timeout_s", capture.connect_timeout_s, seconds.clone())?;
        check_range("capture.step_timeout_s", capture.step_timeout_s, seconds.clone())?;
        capture.camera.validate().map_err(|e| e.within("capture.camera"))?;
        check_range("tracker.deadline_ms", self.tracker.deadline_ms, 0.0..=10_000.0)?;
        check_range("tracker.early_wake_us", self.tracker.early_wake_us, 0.0..=10_000.0)?;
        check_range("tracker.stale_periods", self.tracker.stale_periods, 2.0..=1e6)?;
        for (process, scheduling) in [
            ("capture", &self.capture.scheduling),
            ("tracker", &self.tracker.scheduling),
            ("mapper", &self.mapper.scheduling),
        ] {
            scheduling.validate().map_err(|e| e.within(&format!("{process}.scheduling")))?;
        }
        check_range("mapper.threads", self.mapper.threads, 0..=256)?;
        let supervisor = &self.supervisor;
        check_range("supervisor.max_restarts", supervisor.max_restarts, 0..=1000)?;
        // Signs of life arrive once a second: less than two would kill processes that a busy machine delays.
        if supervisor.watchdog_s != 0.0 {
            let checked = check_range("supervisor.watchdog_s", supervisor.watchdog_s, 2.0..=3600.0);
            checked.map_err(|e| ParameterError { allowed: format!("0 or {}", e.allowed), ..e })?;
        }
        check_range("supervisor.stop_timeout_s", supervisor.stop_timeout_s, seconds.clone())?;
        check_range("supervisor.save_timeout_s", supervisor.save_timeout_s, seconds)?;
        self.noise.validate().map_err(|e| e.within("noise"))?;
        self.tracking.validate().map_err(|e| e.within("tracking"))?;
        self.mapping.validate().map_err(|e| e.within("mapping"))?;
        self.results.validate().map_err(|e| e.within("results"))?;
        self.simulator.validate().map_err(|e| e.within("simulator"))
    }
}

/// The file in `folder` for `instance`: its own, else the common one; `None` where neither exists.
pub fn file_for(folder: &Path, instance: Option<&str>) -> Option<PathBuf> {
    // An invalid name must not lead out of the folder; it is refused later.
    let instance = instance.filter(|name| !name.contains('/'));
    let own = instance.map(|name| folder.join(format!("{name}.toml")));
    own.into_iter().chain([folder.join(COMMON_FILE)]).find(|file| file.exists())
}

/// Makes a path in the configuration `file` relative to that file, wherever the program is started.
fn place_beside(table: &mut Table, file: &Path, [part, key]: [&str; 2]) {
    let part = table.get_mut(part).and_then(Value::as_table_mut);
    let Some(Value::String(path)) = part.and_then(|part| part.get_mut(key)) else {
        return;
    };
    if let (false, Some(folder)) = (path.is_empty(), file.parent()) {
        *path = folder.join(&*path).to_string_lossy().into_owned();
    }
}

/// Rewords a message of the parser for the author of a configuration.
fn without_types(message: &str) -> String {
    const NAMES: [(&str, &str); 8] = [
        ("usize", "a whole number, 0 or more"),
        ("u64", "a whole number, 0 or more"),
        ("u32", "a whole number, 0 or more"),
        ("u16", "a whole number, 0 to 65535"),
        ("u8", "a whole number, 0 to 255"),
        ("i64", "a whole number"),
        ("f64", "a number"),
        ("f32", "a number"),
    ];
    let named = NAMES.iter().find_map(|(of_type, name)| {
        let before = message.strip_suffix(&format!("expected {of_type}"))?;
        Some(format!("{before}expected {name}"))
    });
    let of_table = || {
        let (before, _) = message.split_once("expected struct ")?;
        Some(format!("{before}expected keys below it, as in mapper.threads=2"))
    };
    named.or_else(of_table).unwrap_or_else(|| message.to_owned())
}

/// The parser's message with the line it points to, on one line.
fn one_line(message: &str, span: Option<Range<usize>>, text: &str) -> String {
    let message = message.split_whitespace().collect::<Vec<_>>().join(" ");
    let message = without_types(&message);
    let line = span.and_then(|span| {
        let begin = text.get(..span.start)?.rfind('\n').map_or(0, |newline| newline + 1);
        text.get(begin..)?.lines().next()
    });
    match line.map(str::trim) {
        Some(line) if !line.is_empty() => format!("`{line}`: {message}"),
        _ => message,
    }
}

/// The first key of `table`, in full, that is not in `known`, and the keys allowed in its place.
fn unknown_key(table: &Table, known: &Table, prefix: &str) -> Option<String> {
    table.iter().find_map(|(key, value)| match (value, known.get(key)) {
        (_, None) => {
            let there_are = known.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
            let place = match prefix.strip_suffix('.') {
                Some(outer) => format!("keys of `{outer}` are"),
                None => "keys are".to_owned(),
            };
            Some(format!("unknown key `{prefix}{key}`; {place} {there_are}"))
        }
        (Value::Table(inner), Some(Value::Table(known))) => {
            unknown_key(inner, known, &format!("{prefix}{key}."))
        }
        _ => None,
    })
}

/// Puts `key.of.tables=value` into `table`. A value that is not valid TOML is taken as text.
fn apply(table: &mut Table, setting: &str) -> Result<(), String> {
    let form = "write it as key=value, as in mapper.threads=2";
    let (path, value) = setting.split_once('=').ok_or_else(|| form.to_owned())?;
    let value = value.trim();
    let value = format!("value = {value}")
        .parse::<Table>()
        .ok()
        .and_then(|mut parsed| (parsed.len() == 1).then(|| parsed.remove("value"))?)
        .unwrap_or_else(|| Value::String(value.to_owned()));
    let key = layout::plain(path.trim());
    if let Some(now) = layout::moved(key) {
        return Err(format!("`{key}` is now `{now}`"));
    }
    if key.is_empty() || key.ends_with('.') {
        return Err(form.to_owned());
    }
    if key.trim() == layout::EXPERT {
        return Err("it has keys below it, as in expert.mapping.min_gradient=5.0".to_owned());
    }
    layout::put(table, key, value)
}

#[cfg(test)]
mod tests;
