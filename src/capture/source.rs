//! The trait of everything that frames come from.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
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

/// Why a source gave no frame.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// Reading failed; says what, where and what to do.
    #[error("{0}")]
    Read(String),
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

    /// Writes the next frame into `pixels` (`width * height` of [`FrameSource::intrinsics`]);
    /// `None` after the last.
    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError>;

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
