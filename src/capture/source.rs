//! The trait of everything that frames come from.

use std::fmt;
use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::capture::image_file::ImageFileError;
use crate::capture::looped::Looped;
use crate::capture::rig::{Rig, RigError};
use crate::capture::simulator::Simulator;
use crate::capture::simulator::params::SimulatorParams;
use crate::capture::v4l::params::CameraParams;
use crate::capture::{euroc, image_folder, tum, v4l};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::rectification::RectificationError;
use crate::slam::image::buffer::Image;
use crate::slam::parameter::ParameterError;
use crate::slam::trajectory::StampedPose;

/// Stamp of a frame just read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStamp {
    /// Number of the frame at its source, from 0; a gap is a frame that the source lost.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    /// Exposure time in nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// Sensor gain, 0 where unknown.
    pub gain: f32,
}

/// What waiting for a frame came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Arrival {
    /// The next frame can be read at once.
    Frame,
    /// None yet: the time is over, or the caller was woken.
    Nothing,
    /// There is no camera to read from, for this reason; it is opened as soon as it can be.
    Absent(String),
}

/// Frames of a camera that did not become frames here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameLosses {
    /// Never came, by the driver's numbers.
    pub missing: u64,
    /// Came, and were passed over for a newer one.
    pub late: u64,
    /// Came damaged.
    pub broken: u64,
}

/// A remark of a source for the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Notice {
    /// What is remarked.
    pub text: String,
    /// Whether something is not as it was asked for.
    pub is_warning: bool,
}

/// Why a source cannot be opened or gave no frame; says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The name of a source is not understood.
    #[error("source `{name}`: {problem}; sources are {SOURCE_FORMS}")]
    Name {
        /// The name as it was given.
        name: String,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// The source exists but not in this binary or not by this way of opening.
    #[error("source `{name}`: {reason}")]
    Unavailable {
        /// The source.
        name: String,
        /// Why, and what to do.
        reason: &'static str,
    },
    /// The folder of a recording is not there.
    #[error("source `{name}`: there is no folder {}; check the path", folder.display())]
    NoFolder {
        /// The source.
        name: String,
        /// The folder.
        folder: PathBuf,
    },
    /// The folder has the layout of another kind of source.
    #[error("source `{name}`: the folder has not this layout; it looks like {likely}")]
    Layout {
        /// The source.
        name: String,
        /// What it could be named.
        likely: String,
    },
    /// A list, rig or calibration file cannot be read.
    #[error("{}: cannot be read: {source}; check the path and its permissions", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A line of a list or calibration file is wrong.
    #[error("{}, line {line}: {problem}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong and what to do.
        problem: String,
    },
    /// There is not a single frame.
    #[error("{}: has no frames; check that it is the recording that was meant", path.display())]
    Empty {
        /// The list or folder.
        path: PathBuf,
    },
    /// Nothing says what the camera is.
    #[error(
        "{}: has no camera.txt; name the camera with --rig FILE (examples: config/rigs, /usr/share/semidense/rigs)",
        folder.display()
    )]
    NoRig {
        /// The recording's folder.
        folder: PathBuf,
    },
    /// Nothing says when the images were taken.
    #[error(
        "{}: has no times.txt and {} names no rate_hz; add one of them (name a rig with --rig)",
        folder.display(), rig.display()
    )]
    NoStamps {
        /// The folder of images.
        folder: PathBuf,
        /// The rig or camera.txt.
        rig: PathBuf,
    },
    /// A list of stamps ends before the images do.
    #[error("{}: has {stamps} stamps for {images} images; give one to each", path.display())]
    FewStamps {
        /// The list.
        path: PathBuf,
        /// Stamps in it.
        stamps: usize,
        /// Images in the folder.
        images: usize,
    },
    /// The rig is not usable.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The rig's lens cannot be rectified.
    #[error("{}: {source}; check the calibration", path.display())]
    Rectification {
        /// The rig file.
        path: PathBuf,
        /// Why not.
        source: RectificationError,
    },
    /// A parameter of the simulator is out of its range.
    #[error("simulator.{0}")]
    Simulator(#[from] ParameterError),
    /// An image of the sequence is not usable.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// A camera without a calibration.
    #[error(
        "v4l:{name}: a camera needs a rig file, which says what its lens is: name it with --rig FILE (webcam.toml of config/rigs or /usr/share/semidense/rigs is a start, for a first try at 640x480)"
    )]
    CameraRig {
        /// The camera.
        name: String,
    },
    /// A camera that cannot serve.
    #[error("v4l:{name}: {reason}")]
    Camera {
        /// The camera.
        name: String,
        /// Why, and what to do.
        reason: String,
    },
    /// A frame came damaged; the next may be good.
    #[error("v4l:{name}: a damaged frame: {reason}")]
    BrokenFrame {
        /// The camera.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The caller's buffer does not fit the frames.
    #[error("a buffer of {found} bytes for frames of {width}x{height}; give width * height bytes")]
    Buffer {
        /// Bytes of the buffer.
        found: usize,
        /// Frame width, pixels.
        width: usize,
        /// Frame height, pixels.
        height: usize,
    },
}

impl SourceError {
    /// Whether only this frame is lost, as is usual with cameras.
    pub fn is_passing(&self) -> bool {
        matches!(self, Self::BrokenFrame { .. })
    }
}

/// The forms of a source name, for errors and help.
pub const SOURCE_FORMS: &str =
    "sim[:SCENE], tum:DIR, euroc:DIR, images:DIR, v4l:DEVICE and loop:FRAMES:HZ:SOURCE";

/// The name of a source, as the command line takes it.
#[derive(Debug, Clone, PartialEq)]
pub enum SourceName {
    /// `sim[:SCENE]`: the simulator.
    Simulator {
        /// The scene, where one is named.
        scene: Option<String>,
    },
    /// `tum:DIR`: a recording in the layout of TUM RGB-D.
    Tum(PathBuf),
    /// `euroc:DIR`: a recording in the layout of EuRoC (ASL).
    Euroc(PathBuf),
    /// `images:DIR`: a folder of images.
    Images(PathBuf),
    /// `v4l:DEVICE`: a camera, by its path, its number or the name that udev gives it.
    Camera(String),
    /// `loop:FRAMES:HZ:SOURCE`: a recording to and fro, for benches and soak tests.
    Looped {
        /// Frames in all.
        num_frames: u64,
        /// Frames in a second.
        rate_hz: f64,
        /// What is repeated.
        inner: Box<SourceName>,
    },
}

impl SourceName {
    /// Whether frames come at their own pace, whether or not somebody takes them.
    pub fn is_camera(&self) -> bool {
        matches!(self, Self::Camera(_))
    }

    /// The folder of a recording; `None` for what is none.
    pub fn folder(&self) -> Option<&Path> {
        match self {
            Self::Tum(folder) | Self::Euroc(folder) | Self::Images(folder) => Some(folder),
            Self::Looped { inner, .. } => inner.folder(),
            Self::Simulator { .. } | Self::Camera(_) => None,
        }
    }
}

impl FromStr for SourceName {
    type Err = SourceError;

    fn from_str(name: &str) -> Result<Self, SourceError> {
        let error = |problem| SourceError::Name { name: name.to_owned(), problem };
        let (kind, rest) = match name.split_once(':') {
            Some((kind, rest)) => (kind, Some(rest)),
            None => (name, None),
        };
        if kind == "loop" {
            return parse_loop(rest.unwrap_or(""))
                .ok_or_else(|| error("write loop:FRAMES:HZ:SOURCE, as loop:9000:30:sim"));
        }
        if kind == "sim" {
            return match rest {
                Some("") => Err(error("the scene's name is missing")),
                scene => Ok(Self::Simulator { scene: scene.map(str::to_owned) }),
            };
        }
        let form = match kind {
            "tum" => Self::Tum,
            "euroc" => Self::Euroc,
            "images" => Self::Images,
            "v4l" => {
                return match rest {
                    None | Some("") => Err(error("the device is missing, as in v4l:/dev/video0")),
                    Some(device) => Ok(Self::Camera(device.to_owned())),
                };
            }
            _ if Path::new(name).exists() => {
                return Err(error("say what kind of recording it is, as in tum:DIR"));
            }
            _ => return Err(error("this kind is not known")),
        };
        match rest {
            None | Some("") => Err(error("the folder is missing")),
            Some(place) => Ok(form(PathBuf::from(place))),
        }
    }
}

/// `FRAMES:HZ:SOURCE`.
fn parse_loop(text: &str) -> Option<SourceName> {
    let mut parts = text.splitn(3, ':');
    let num_frames = parts.next()?.parse().ok().filter(|&frames| frames > 0)?;
    let rate_hz = parts.next()?.parse().ok().filter(|rate| (0.01..=10_000.0).contains(rate))?;
    let inner = parts.next().filter(|inner| !inner.starts_with("loop"))?.parse().ok()?;
    Some(SourceName::Looped { num_frames, rate_hz, inner: Box::new(inner) })
}

impl fmt::Display for SourceName {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Simulator { scene: None } => write!(out, "sim"),
            Self::Simulator { scene: Some(scene) } => write!(out, "sim:{scene}"),
            Self::Tum(folder) => write!(out, "tum:{}", folder.display()),
            Self::Euroc(folder) => write!(out, "euroc:{}", folder.display()),
            Self::Images(folder) => write!(out, "images:{}", folder.display()),
            Self::Camera(device) => write!(out, "v4l:{device}"),
            Self::Looped { num_frames, rate_hz, inner } => {
                write!(out, "loop:{num_frames}:{rate_hz}:{inner}")
            }
        }
    }
}

/// What can be set about sources.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SourceParams {
    /// The simulated camera and its world.
    pub simulator: SimulatorParams,
    /// What is asked of a camera.
    pub camera: CameraParams,
}

/// Opens a source. `rig` is a rig file, which wins over the calibration that a recording brings. A camera
/// is opened when its first frame is awaited.
pub fn open(
    name: &SourceName,
    rig: Option<&Path>,
    params: &SourceParams,
) -> Result<Box<dyn FrameSource>, SourceError> {
    let unavailable = |reason| SourceError::Unavailable { name: name.to_string(), reason };
    if let Some(folder) = name.folder().filter(|folder| !folder.is_dir()) {
        return Err(SourceError::NoFolder { name: name.to_string(), folder: folder.to_owned() });
    }
    if let Some(likely) = misnamed(name) {
        return Err(SourceError::Layout { name: name.to_string(), likely: likely.to_string() });
    }
    match name {
        SourceName::Tum(folder) => Ok(Box::new(tum::open(folder, rig)?)),
        SourceName::Euroc(folder) => Ok(Box::new(euroc::open(folder, rig)?)),
        SourceName::Images(folder) => Ok(Box::new(image_folder::open(folder, rig)?)),
        SourceName::Simulator { .. } if rig.is_some() => Err(unavailable(
            "the simulator takes no rig; its camera is in the table [simulator] of the configuration",
        )),
        SourceName::Simulator { scene } => {
            let mut params = params.simulator.clone();
            if let Some(scene) = scene {
                params.scene = scene
                    .parse()
                    .map_err(|problem| SourceError::Name { name: name.to_string(), problem })?;
            }
            Ok(Box::new(Simulator::new(params)?))
        }
        SourceName::Looped { inner, .. } if inner.is_camera() => {
            Err(unavailable("a camera cannot be repeated; name a recording or the simulator"))
        }
        SourceName::Looped { num_frames, rate_hz, inner } => {
            let source = open(inner, rig, params)?;
            Ok(Box::new(Looped::new(name.clone(), source, *num_frames, *rate_hz)))
        }
        SourceName::Camera(device) => Ok(Box::new(v4l::open(device, rig, &params.camera)?)),
    }
}

/// What a folder without the layout that its source names is by the layout that it has.
fn misnamed(name: &SourceName) -> Option<SourceName> {
    let (SourceName::Tum(folder) | SourceName::Euroc(folder) | SourceName::Images(folder)) = name
    else {
        // What a loop repeats is looked at when that is opened.
        return None;
    };
    let layouts = [
        SourceName::Tum(folder.to_owned()),
        SourceName::Euroc(folder.to_owned()),
        SourceName::Images(folder.to_owned()),
    ];
    if has_layout(name) { None } else { layouts.into_iter().find(has_layout) }
}

/// Whether the list by which a layout is known, or an image, is where it belongs.
fn has_layout(name: &SourceName) -> bool {
    match name {
        SourceName::Tum(folder) => folder.join("rgb.txt").is_file(),
        SourceName::Euroc(folder) => euroc::frame_list(folder).is_file(),
        SourceName::Images(folder) => image_folder::has_images(folder),
        _ => false,
    }
}

/// Where the recording's own camera is another than that of the `rig` which wins over it: what differs,
/// in one line. `None` where they agree, or the recording brings no camera that can be read.
pub fn rig_conflict(name: &SourceName, rig: Option<&Path>) -> Option<String> {
    /// Displacement that no calibration of the same camera brings about, pixels: files are written
    /// with few digits, and calibrations of one camera differ by tenths.
    const MAX_SHIFT_PX: f64 = 2.0;
    let (folder, rig) = (name.folder()?, rig?);
    let (own, own_path) = match name {
        SourceName::Euroc(_) => euroc::own_rig(folder),
        _ => tum::own_rig(folder),
    }?;
    let shift_px = own.largest_shift_px(&Rig::read(rig).ok()?);
    let difference = match shift_px.is_finite() {
        true => format!("differ by up to {shift_px:.0} px"),
        false => "see different parts of the world or have images of different sizes".to_owned(),
    };
    (shift_px > MAX_SHIFT_PX).then(|| {
        format!(
            "the camera of {} and that of {} {difference}; the first is used, leave out --rig for the second",
            rig.display(),
            own_path.display()
        )
    })
}

/// Rectified, photometrically corrected grey frames in the order of their stamps.
pub trait FrameSource: Send {
    /// Intrinsics of the rectified frames.
    fn intrinsics(&self) -> Intrinsics;

    /// How many frames there will be, where that is known (recordings, simulator).
    fn num_frames(&self) -> Option<usize>;

    /// Work that must be over before the first frame is published (the simulator renders here).
    /// `progress` is called with (done, total) and returns false to stop early.
    fn prepare(
        &mut self,
        progress: &mut dyn FnMut(usize, usize) -> bool,
    ) -> Result<(), SourceError> {
        let _ = progress;
        Ok(())
    }

    /// Waits until the next frame can be read, at most `millis`, or until `wake` can be read. Recordings
    /// always have one, or their end.
    fn await_frame(&mut self, wake: BorrowedFd<'_>, millis: u32) -> Result<Arrival, SourceError> {
        let _ = (wake, millis);
        Ok(Arrival::Frame)
    }

    /// Writes the next frame into `pixels` (`width * height` of [`FrameSource::intrinsics`]);
    /// `None` after the last. After an error the next call goes on with the frame after it; what
    /// `pixels` holds then is not a frame.
    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError>;

    /// Leaves out frames until the next one comes after `sequence`.
    fn skip_to(&mut self, sequence: u64) -> Result<(), SourceError> {
        let k = self.intrinsics();
        let mut pixels = vec![0; k.width * k.height];
        while self.next_into(&mut pixels)?.is_some_and(|stamp| stamp.sequence < sequence) {}
        Ok(())
    }

    /// What a camera has lost so far; `None` for recordings, which lose nothing.
    fn losses(&self) -> Option<FrameLosses> {
        None
    }

    /// A remark for the log that nobody has taken yet: what was granted, what was refused.
    fn take_notice(&mut self) -> Option<Notice> {
        None
    }

    /// Ground-truth camera poses in order of their stamps, empty where there are none.
    fn ground_truth(&self) -> &[StampedPose] {
        &[]
    }

    /// Ground-truth depth in metres (0 where none) of the frame with this stamp, rectified like the
    /// frames; `None` where the source has none for it.
    fn depth_at(&mut self, capture_nanos: i64) -> Result<Option<Image<f32>>, SourceError> {
        let _ = capture_nanos;
        Ok(None)
    }
}
