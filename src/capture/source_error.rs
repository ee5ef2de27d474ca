//! Errors of sources of frames: what is wrong, where, and what to do.

use std::path::PathBuf;

use crate::capture::image_file::ImageFileError;
use crate::capture::rig_error::RigError;
use crate::slam::counted::counted;
use crate::slam::geometry::rectification::RectificationError;
use crate::slam::parameter::ParameterError;

pub use crate::capture::bag::bag_error::{BagError, BagImageError};

/// Why a source cannot be opened or returned no frame; states what is wrong, where, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The name of a source is not understood, or cannot be opened.
    #[error("source `{name}`: {problem}")]
    Name {
        /// The name as given.
        name: String,
        /// The problem, and what to do.
        problem: String,
    },
    /// A path that does not exist.
    #[error("there is no such file or folder: {path}; {hint}")]
    NoPath {
        /// The path as given.
        path: String,
        /// What may have been meant.
        hint: String,
    },
    /// A video, which must first be converted to a folder of images.
    #[error(
        "source `{path}`: this looks like a video file: make a folder of images and times from it with the command below, \
         then name that folder, with --rig FILE for the camera"
    )]
    Video {
        /// The path as given.
        path: String,
        /// The command that makes the folder, for the shell.
        command: String,
    },
    /// A list, rig or calibration file cannot be read.
    #[error("{}: cannot be read: {source}; check the path and its permissions", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A line of a list or calibration file is wrong.
    #[error("{}, line {line}: {problem}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// The problem, and what to do.
        problem: String,
    },
    /// No frames.
    #[error("{}: has no frames; check that this is the right recording", path.display())]
    Empty {
        /// The list or folder.
        path: PathBuf,
    },
    /// No description of the camera.
    #[error(
        "{}: has no camera.txt; name the camera with --rig FILE (examples: config/rigs, /usr/share/semidense/rigs)",
        folder.display()
    )]
    NoRig {
        /// The recording's folder.
        folder: PathBuf,
    },
    /// No stamps for the images.
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
    /// Fewer stamps than images.
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
        /// The cause.
        source: RectificationError,
    },
    /// A parameter of the simulator is out of its range.
    #[error("simulator.{0}")]
    Simulator(#[from] ParameterError),
    /// An image of the sequence is not usable.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// A mask does not belong to the camera, or hides almost everything.
    #[error("{}: {problem}", path.display())]
    Mask {
        /// The mask's file.
        path: PathBuf,
        /// The problem, and what to do.
        problem: String,
    },
    /// A camera or a stream of frames cannot be used.
    #[error("{name}: {reason}")]
    Camera {
        /// The source.
        name: String,
        /// The reason, and what to do.
        reason: String,
    },
    /// A frame arrived damaged; the next one may be valid.
    #[error("{name}: a damaged frame: {reason}")]
    BrokenFrame {
        /// The source.
        name: String,
        /// The problem.
        reason: String,
    },
    /// A bag cannot be used.
    #[error("{}: {problem}", path.display())]
    Bag {
        /// The file.
        path: PathBuf,
        /// The reason, and what to do.
        problem: BagError,
    },
    /// An image of a bag is not usable; the next one may be valid.
    #[error("{}: an image on {topic} {problem}", path.display())]
    BagImage {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// The problem.
        problem: BagImageError,
    },
    /// A recording without a usable image.
    #[error("none of its {count} images can be used; the first: {first}")]
    AllDamaged {
        /// Number of images.
        count: u64,
        /// The first image and its error.
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
    /// A command that the message refers to; printed on a separate line, it can be copied.
    pub fn command(&self) -> Option<&str> {
        match self {
            Self::Video { command, .. } => Some(command),
            _ => None,
        }
    }

    /// Whether only this frame is lost and the next one may be valid: a damaged frame of a camera, a damaged or missing
    /// image of a recording.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::BrokenFrame { .. } | Self::Image(_) | Self::BagImage { .. })
    }
}
