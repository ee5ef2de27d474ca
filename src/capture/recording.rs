//! Frames of a recording, whatever its layout: listed images of one camera, played in order.
//!
//! Errors in a recording's lists, such as a bad line or a stamp out of order, are found when it is opened. Errors in an
//! image, including a missing one, are found when it is reached, and the caller decides whether to continue with the
//! next.

use std::path::PathBuf;

use crate::capture::image_file::ImageFileReader;
use crate::capture::rectifier::Rectifier;
use crate::capture::rig::Rig;
use crate::capture::source::{FrameSource, FrameStamp};
use crate::capture::source_error::SourceError;
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
use crate::slam::trajectory::StampedPose;

/// A depth image belongs to a frame when their stamps differ by no more than this: two thirds of a
/// period at 30 Hz, the customary bound of the TUM RGB-D tools.
const DEPTH_ASSOCIATION_NANOS: u64 = 20_000_000;

/// An image file with its stamp.
#[derive(Debug, Clone, PartialEq)]
pub struct ListedImage {
    /// Stamp, nanoseconds of the recording's clock.
    pub nanos: i64,
    /// The image file.
    pub path: PathBuf,
    /// Exposure time in nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
}

/// Contents of a recording's lists; every list is in order of its stamps.
#[derive(Debug, Clone, Default)]
pub struct Contents {
    /// The frames.
    pub frames: Vec<ListedImage>,
    /// Depth images (16-bit PNG), empty if there are none.
    pub depths: Vec<ListedImage>,
    /// Ground-truth camera poses, empty if there are none.
    pub ground_truth: Vec<StampedPose>,
}

/// A recording as a source of rectified frames.
#[derive(Debug)]
pub struct Recording {
    contents: Contents,
    rectifier: Rectifier,
    reader: ImageFileReader,
    next: usize,
}

impl Recording {
    /// Creates a recording with these contents, taken with the camera of `rig`; `rig_path` is the file of the rig and
    /// `listed_in` the list or folder of the frames, both for errors.
    pub fn new(
        contents: Contents,
        rig: &Rig,
        rig_path: PathBuf,
        listed_in: PathBuf,
    ) -> Result<Self, SourceError> {
        if contents.frames.is_empty() {
            return Err(SourceError::Empty { path: listed_in });
        }
        let rectifier = Rectifier::new(rig, &rig_path)?;
        Ok(Self { contents, rectifier, reader: ImageFileReader::default(), next: 0 })
    }

    /// Returns the depth image nearest to a stamp, if it is near enough.
    fn nearest_depth(&self, nanos: i64) -> Option<&ListedImage> {
        let depths = &self.contents.depths;
        let after = depths.partition_point(|depth| depth.nanos < nanos);
        let neighbours = &depths[after.saturating_sub(1)..depths.len().min(after + 1)];
        neighbours
            .iter()
            .min_by_key(|depth| depth.nanos.abs_diff(nanos))
            .filter(|depth| depth.nanos.abs_diff(nanos) <= DEPTH_ASSOCIATION_NANOS)
    }
}

impl FrameSource for Recording {
    fn intrinsics(&self) -> Intrinsics {
        self.rectifier.intrinsics()
    }

    fn camera(&self) -> CameraModel {
        *self.rectifier.camera()
    }

    fn readout_s(&self) -> Option<f64> {
        Some(self.rectifier.readout_s())
    }

    fn rectified(&self, raw: &[u8]) -> Vec<u8> {
        self.rectifier.rectified(raw)
    }

    fn num_frames(&self) -> Option<usize> {
        Some(self.contents.frames.len())
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        self.check_buffer(pixels)?;
        let Some(frame) = self.contents.frames.get(self.next) else { return Ok(None) };
        let sequence = self.next as u64;
        // Counted before it is read: a caller that continues after a bad image gets the next one.
        self.next += 1;
        let Intrinsics { width, height, .. } = self.rectifier.intrinsics();
        self.rectifier.read_into(pixels, |gray, _| {
            self.reader.read_gray_into(&frame.path, width, height, gray)
        })?;
        let (capture_nanos, exposure_nanos) = (frame.nanos, frame.exposure_nanos);
        Ok(Some(FrameStamp { sequence, capture_nanos, exposure_nanos, gain: 0.0, clocks: None }))
    }

    fn skip_to(&mut self, sequence: u64) -> Result<(), SourceError> {
        // Sequences are positions in the list: no image needs to be read.
        let next = usize::try_from(sequence).unwrap_or(usize::MAX).saturating_add(1);
        self.next = self.next.max(next);
        Ok(())
    }

    fn ground_truth(&self) -> &[StampedPose] {
        &self.contents.ground_truth
    }

    fn depth_at(&mut self, capture_nanos: i64) -> Result<Option<Image<f32>>, SourceError> {
        let Some(path) = self.nearest_depth(capture_nanos).map(|depth| depth.path.clone()) else {
            return Ok(None);
        };
        let Intrinsics { width, height, .. } = self.rectifier.intrinsics();
        let raw = self.reader.read_depth(&path, width, height)?;
        Ok(self.rectifier.rectify_depth(&raw))
    }
}
