//! The trait of everything that frames come from.

use std::fs::File;
use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};

use crate::capture::bag::{self, BagError, BagImageError};
use crate::capture::image_file::ImageFileError;
use crate::capture::looped::Looped;
use crate::capture::rig::{Rig, RigError};
use crate::capture::simulator::Simulator;
use crate::capture::simulator::params::SimulatorParams;
pub use crate::capture::source_name::SourceName;
use crate::capture::v4l::params::CameraParams;
use crate::capture::{euroc, image_folder, stream, tum, v4l};
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
    /// The same instant by this machine's clocks, where the source knows it; otherwise capture finds it.
    pub clocks: Option<FrameClocks>,
}

/// An instant by the clocks of this machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameClocks {
    /// CLOCK_MONOTONIC, nanoseconds: what latency counts from.
    pub clock_nanos: i64,
    /// CLOCK_REALTIME, nanoseconds, or what the sender has in its place: the stamp exactly as it came, so that who
    /// reads poses can match them with the images by equality.
    pub realtime_nanos: i64,
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
    #[error("source `{name}`: {problem}")]
    Name {
        /// The name as it was given.
        name: String,
        /// What is wrong with it, and what to do.
        problem: String,
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
    #[error("source `{name}`: the folder does not have this layout; it looks like {likely}")]
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
    #[error("{}: has no frames; check that this is the right recording", path.display())]
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
    #[error("{}: has {stamps} time stamps for {images} images; give each image one", path.display())]
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
        "v4l:{name}: a camera needs a rig file with its calibration: name it with --rig FILE (for a first try at 640x480, webcam.toml in config/rigs or /usr/share/semidense/rigs will do)"
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
    /// A stream of frames without a calibration.
    #[error("{name}: needs a rig file with the camera's calibration: name it with --rig FILE")]
    StreamRig {
        /// The source.
        name: String,
    },
    /// A stream that cannot serve.
    #[error("{name}: {reason}")]
    Stream {
        /// The source.
        name: String,
        /// Why, and what to do.
        reason: String,
    },
    /// A frame came damaged; the next may be good.
    #[error("{name}: a damaged frame: {reason}")]
    BrokenFrame {
        /// The source.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A bag cannot be used.
    #[error("{}: {problem}", path.display())]
    Bag {
        /// The file.
        path: PathBuf,
        /// Why, and what to do.
        problem: BagError,
    },
    /// An image of a bag is not usable; the next may be good.
    #[error("{}: an image on {topic} {problem}", path.display())]
    BagImage {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// What is wrong with it.
        problem: BagImageError,
    },
    /// A recording without one image that can be used.
    #[error("none of its {count} images can be used; the first: {first}")]
    AllDamaged {
        /// Images.
        count: u64,
        /// Which the first is, and what is wrong with it.
        first: String,
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
    /// Whether only this frame is lost and the next may be good: a damaged frame of a camera, a damaged or
    /// missing image of a recording.
    pub fn is_passing(&self) -> bool {
        matches!(self, Self::BrokenFrame { .. } | Self::Image(_) | Self::BagImage { .. })
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
        SourceName::Mcap { file, topic } => Ok(Box::new(bag::open(file, topic.as_deref(), rig)?)),
        SourceName::Simulator { .. } if rig.is_some() => Err(unavailable(
            "the simulator takes no rig; its camera is in the table [simulator] of the configuration",
        )),
        SourceName::Simulator { scene } => {
            let mut params = params.simulator.clone();
            if let Some(scene) = scene {
                params = params.with_scene(scene.parse().map_err(|problem: &str| {
                    SourceError::Name { name: name.to_string(), problem: problem.to_owned() }
                })?);
            }
            Ok(Box::new(Simulator::unpainted(params)?))
        }
        SourceName::Looped { inner, .. } if inner.is_camera() => {
            Err(unavailable("a camera cannot be repeated; name a recording or the simulator"))
        }
        SourceName::Looped { num_frames, rate_hz, inner } => {
            let source = open(inner, rig, params)?;
            Ok(Box::new(Looped::new(name.clone(), source, *num_frames, *rate_hz)))
        }
        SourceName::Camera(device) => Ok(Box::new(v4l::open(device, rig, &params.camera)?)),
        SourceName::Stream(path) => {
            Ok(Box::new(stream::open_socket(path, rig, params.camera.stall_s)?))
        }
        SourceName::Ros2(topic) => {
            Ok(Box::new(stream::open_ros2(topic, rig, params.camera.stall_s)?))
        }
    }
}

/// What a folder without the layout that its source names is by the layout that it has.
fn misnamed(name: &SourceName) -> Option<SourceName> {
    let (SourceName::Tum(folder) | SourceName::Euroc(folder) | SourceName::Images(folder)) = name
    else {
        // What a loop repeats is looked at when that is opened.
        return None;
    };
    if name.has_layout() { None } else { SourceName::of_folder(folder) }
}

/// Where the recording's own camera is another than that of the `rig` which wins over it: what differs,
/// in one line. `None` where they agree, or the recording brings no camera that can be read.
fn rig_conflict(name: &SourceName, rig: Option<&Path>) -> Option<String> {
    /// Displacement that no calibration of the same camera brings about, pixels: files are written
    /// with few digits, and calibrations of one camera differ by tenths.
    const MAX_SHIFT_PX: f64 = 2.0;
    let (folder, rig) = (name.folder()?, rig?);
    let (own, own_path) = own_rig(name, folder)?;
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

/// What may be wrong with the camera of a source, one line each: it is another than the recording's own, or
/// its field of view is unusual.
pub fn rig_remarks(name: &SourceName, rig: Option<&Path>) -> Vec<String> {
    let used = match (name.folder(), rig) {
        (_, Some(path)) => Rig::read(path).ok().map(|rig| (rig, path.to_owned())),
        (Some(folder), None) => own_rig(name, folder),
        (None, None) => None,
    };
    let unusual =
        used.and_then(|(rig, path)| Some(format!("{}: {}", path.display(), rig.remark()?)));
    rig_conflict(name, rig).into_iter().chain(unusual).collect()
}

/// The camera that a recording brings, and where it says so.
fn own_rig(name: &SourceName, folder: &Path) -> Option<(Rig, PathBuf)> {
    match name {
        SourceName::Euroc(_) => euroc::own_rig(folder),
        _ => tum::own_rig(folder),
    }
}

/// Rectified, photometrically corrected grey frames in the order of their stamps.
pub trait FrameSource: Send {
    /// Intrinsics of the rectified frames.
    fn intrinsics(&self) -> Intrinsics;

    /// How many frames there will be, where that is known (recordings, simulator).
    fn num_frames(&self) -> Option<usize>;

    /// Keeps frames that are prepared in `file` and takes those that are there: of a process of the same source
    /// that was killed. Sources that prepare none have no use for it.
    fn keep_prepared_in(&mut self, file: File) -> std::io::Result<()> {
        drop(file);
        Ok(())
    }

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
        loop {
            match self.next_into(&mut pixels) {
                Ok(Some(stamp)) if stamp.sequence < sequence => {}
                Err(error) if error.is_passing() => {}
                Err(error) => return Err(error),
                Ok(_) => return Ok(()),
            }
        }
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
