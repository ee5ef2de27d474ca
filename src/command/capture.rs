//! `semidense capture`: publishes frames in shared memory.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use crate::capture::source_error::SourceError;
use crate::capture::source_name::SourceName;
use crate::command::print::note;
use crate::command::{CommandResult, INTERRUPTED};
use crate::service::capture::{CaptureOptions, run as run_shell};
use crate::service::config::{CaptureConfig, Config};
use crate::service::mode::Mode;
use crate::service::run_error::RunError;
use crate::service::shutdown::Shutdown;

/// Publish the frames of a source in shared memory
#[derive(Debug, Args)]
pub struct CaptureArguments {
    /// Where frames come from, and the camera's calibration.
    #[command(flatten)]
    pub source: SourceArguments,
    /// Lockstep or live.
    #[command(flatten)]
    pub mode: ModeArguments,
}

/// Where frames come from.
#[derive(Debug, Clone, Args)]
pub struct SourceArguments {
    /// Where frames come from.
    #[arg(
        value_name = "SOURCE",
        help = "Where frames come from: DIR (its layout is detected), sim, sim:SCENE, tum:DIR, euroc:DIR, \
                images:DIR, mcap:FILE[:TOPIC], v4l:DEVICE, ros2:TOPIC (images of ROS 2), stream:SOCKET (frames that \
                another program sends), or loop:FRAMES:HZ:SOURCE, which plays another source back and forth, FRAMES \
                frames at HZ [default: capture.source of the configuration, which is sim]"
    )]
    source: Option<OsString>,
    /// The same as SOURCE, for scripts written for earlier versions
    #[arg(long = "source", value_name = "SOURCE", hide = true, conflicts_with = "source")]
    source_option: Option<OsString>,
    /// Rig file with the camera's calibration; required for v4l, ros2 and stream [default: capture.rig of
    /// the configuration, for the source configured there]
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Mask of the camera: an image of it, unrectified, black where it sees the robot itself and white elsewhere
    /// [default: capture.mask of the configuration, for the source configured there]
    #[arg(long, value_name = "FILE")]
    mask: Option<PathBuf>,
    /// Stop with an error at a damaged or missing image of a recording; otherwise such an image is skipped,
    /// counted and reported [default: capture.strict of the configuration]
    #[arg(long)]
    pub strict: bool,
}

impl SourceArguments {
    /// The source from the command line, else from the configuration. One named on the command line does not use the
    /// configured rig and mask, which belong to another camera.
    pub fn named(self, config: &CaptureConfig) -> Result<NamedSource, SourceError> {
        let [rig, mask] =
            [&config.rig, &config.mask].map(|path| (!path.is_empty()).then(|| PathBuf::from(path)));
        let Some(source) = self.source.or(self.source_option) else {
            let (rig, mask) = (self.rig.or(rig), self.mask.or(mask));
            return Ok(NamedSource { name: config.source.parse()?, rig, mask });
        };
        let name = SourceName::parse(&source)?;
        let files = [("rig", rig, &self.rig), ("mask", mask, &self.mask)];
        for (kind, configured, named) in files {
            if let (Some(path), None) = (configured, named) {
                note(&format!(
                    "warning: capture.{kind} ({}) belongs to the configured source and is not used for {name}; \
                     name a {kind} with --{kind} FILE",
                    path.display()
                ));
            }
        }
        Ok(NamedSource { name, rig: self.rig, mask: self.mask })
    }
}

/// A source and the files that belong to its camera.
#[derive(Debug, Clone)]
pub struct NamedSource {
    /// Where frames come from.
    pub name: SourceName,
    /// The camera's rig file.
    pub rig: Option<PathBuf>,
    /// The camera's mask.
    pub mask: Option<PathBuf>,
}

/// How frames are paced.
#[derive(Debug, Clone, Copy, Args)]
pub struct ModeArguments {
    /// Process every frame in order; every run gives the same result [default of run and capture for recordings
    /// and the simulator]
    #[arg(long, conflicts_with = "live")]
    pub lockstep: bool,
    /// Keep the pace of the time stamps; the newest frame wins [default for cameras, and of tracker
    /// and mapper]
    #[arg(long)]
    pub live: bool,
}

impl ModeArguments {
    /// The requested mode, or the usual one.
    pub fn mode(self, usual: Mode) -> Mode {
        match (self.lockstep, self.live) {
            (true, _) => Mode::Lockstep,
            (_, true) => Mode::Live,
            _ => usual,
        }
    }
}

/// The usual mode of a source.
pub fn usual_mode(source: &SourceName) -> Mode {
    if source.is_camera() { Mode::Live } else { Mode::Lockstep }
}

/// Runs the capture process.
pub fn run(config: &Config, arguments: CaptureArguments) -> CommandResult {
    let mut config = config.clone();
    config.capture.strict |= arguments.source.strict;
    let NamedSource { name: source, rig, mask } = arguments.source.named(&config.capture)?;
    let mode = arguments.mode.mode(usual_mode(&source));
    let shutdown = Shutdown::install()?;
    let options = CaptureOptions { source, rig, mask, mode };
    match run_shell(&config, &options, &shutdown) {
        Ok(()) => Ok(ExitCode::SUCCESS),
        Err(RunError::Interrupted) => Ok(ExitCode::from(INTERRUPTED)),
        Err(error) => Err(error.into()),
    }
}
