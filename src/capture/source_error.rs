//! Why frames cannot be had: what is wrong with a source, where, and what to do.

use std::path::PathBuf;

use crate::capture::image_file::ImageFileError;
use crate::capture::rig_error::RigError;
use crate::slam::counted::counted;
use crate::slam::geometry::rectification::RectificationError;
use crate::slam::parameter::ParameterError;

pub use crate::capture::bag::bag_error::{BagError, BagImageError};

/// Why a source cannot be opened or gave no frame; says what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The name of a source is not understood, or nothing can be opened by it.
    #[error("source `{name}`: {problem}")]
    Name {
        /// The name as it was given.
        name: String,
        /// What is wrong with it, and what to do.
        problem: String,
    },
    /// A path that leads nowhere.
    #[error("there is no such file or folder: {path}; {hint}")]
    NoPath {
        /// The path as it was given.
        path: String,
        /// What may have been meant.
        hint: String,
    },
    /// A video, which has to be made a folder of images first.
    #[error(
        "source `{path}`: by its name this is a video: make a folder of images and times from it with the command below, \
         then name that folder, with --rig FILE for the camera"
    )]
    Video {
        /// The path as it was given.
        path: String,
        /// The command that makes the folder, for the shell.
        command: String,
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
    #[error(
        "{}: has {} for {}; give each image one", path.display(), counted(*stamps, "time stamp"),
        counted(*images, "image")
    )]
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
    /// A camera, or a stream of frames, that cannot serve.
    #[error("{name}: {reason}")]
    Camera {
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
    /// A command that the message refers to; printed on a line of its own, it can be copied.
    pub fn command(&self) -> Option<&str> {
        match self {
            Self::Video { command, .. } => Some(command),
            _ => None,
        }
    }

    /// Whether only this frame is lost and the next may be good: a damaged frame of a camera, a damaged or
    /// missing image of a recording.
    pub fn is_passing(&self) -> bool {
        matches!(self, Self::BrokenFrame { .. } | Self::Image(_) | Self::BagImage { .. })
    }
}
