//! The trait of all sources of frames.

use std::fs::File;
use std::os::fd::BorrowedFd;

use crate::capture::source_error::SourceError;
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
use crate::slam::trajectory::StampedPose;

/// Stamp of a frame just read.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FrameStamp {
    /// Number of the frame at its source, from 0; a gap means frames that the source lost.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    /// Exposure time in nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// Sensor gain, 0 where unknown.
    pub gain: f32,
    /// The same instant by this machine's clocks, if the source has it; otherwise capture determines it.
    pub clocks: Option<FrameClocks>,
}

/// An instant by the clocks of this machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameClocks {
    /// CLOCK_MONOTONIC, nanoseconds: latency counts from here.
    pub clock_nanos: i64,
    /// CLOCK_REALTIME, nanoseconds, or the sender's clock in its place: the stamp exactly as received, so that a reader
    /// of poses can match them with the images by equality.
    pub realtime_nanos: i64,
}

/// Outcome of waiting for a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Arrival {
    /// The next frame can be read at once.
    Frame,
    /// No frame yet: the time has passed, or the caller was woken.
    Nothing,
    /// There is no camera to read from, for this reason; it is opened as soon as possible.
    Absent(String),
}

/// Why there is no camera or sender to read from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::capture) struct Absence {
    /// The reason, for the user.
    pub reason: String,
    /// Whether it may pass without intervention.
    pub passes: bool,
}

impl Absence {
    /// An absence that may pass without intervention.
    pub fn transient(reason: String) -> Self {
        Self { reason, passes: true }
    }
}

/// Frames of a camera that were not delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameLosses {
    /// Never arrived, by the driver's numbers.
    pub missing: u64,
    /// Arrived, and were skipped for a newer one.
    pub late: u64,
    /// Arrived damaged.
    pub broken: u64,
}

/// A remark of a source for the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Notice {
    /// The remark.
    pub text: String,
    /// Whether something differs from what was requested.
    pub is_warning: bool,
}

/// Rectified, photometrically corrected grey frames in the order of their stamps.
pub trait FrameSource: Send {
    /// Intrinsics of the rectified frames.
    fn intrinsics(&self) -> Intrinsics;

    /// The camera of the images before they are rectified.
    fn camera(&self) -> CameraModel {
        CameraModel::undistorted(self.intrinsics())
    }

    /// Time in which the camera reads out all rows, seconds; 0 if they are exposed together, `None` if its frames have
    /// been corrected already or cannot be.
    fn readout_s(&self) -> Option<f64> {
        Some(0.0)
    }

    /// An image of this source's camera, `width * height` pixels, rectified like the frames.
    fn rectified(&self, raw: &[u8]) -> Vec<u8> {
        raw.to_vec()
    }

    /// Whether grey level 0 of its frames marks pixels without data, as in our own recordings; otherwise it is black.
    fn marks_hidden(&self) -> bool {
        false
    }

    /// Total number of frames, if known (recordings, simulator).
    fn num_frames(&self) -> Option<usize> {
        None
    }

    /// Keeps prepared frames in `file` and takes over those already in it, from a killed process with the same source.
    /// Sources that prepare no frames ignore it.
    fn keep_prepared_in(&mut self, file: File) -> std::io::Result<()> {
        drop(file);
        Ok(())
    }

    /// Does the work that must be finished before the first frame is published (the simulator renders here). `progress`
    /// is called with (done, total) and returns false to stop early.
    fn prepare(
        &mut self,
        progress: &mut dyn FnMut(usize, usize) -> bool,
    ) -> Result<(), SourceError> {
        let _ = progress;
        Ok(())
    }

    /// Waits up to `millis` until the next frame can be read, or until `wake` can be read. Recordings always have a
    /// next frame, or their end.
    fn await_frame(&mut self, wake: BorrowedFd<'_>, millis: u32) -> Result<Arrival, SourceError> {
        let _ = (wake, millis);
        Ok(Arrival::Frame)
    }

    /// Writes the next frame into `pixels` (`width * height` of [`FrameSource::intrinsics`]); `None` after the last.
    /// After an error the next call continues with the frame after it; the contents of `pixels` are then not a frame.
    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError>;

    /// Checks that `pixels` has room for a frame and no more.
    fn check_buffer(&self, pixels: &[u8]) -> Result<(), SourceError> {
        let Intrinsics { width, height, .. } = self.intrinsics();
        match pixels.len() == width * height {
            true => Ok(()),
            false => Err(SourceError::Buffer { found: pixels.len(), width, height }),
        }
    }

    /// Skips frames until the next one comes after `sequence`.
    fn skip_to(&mut self, sequence: u64) -> Result<(), SourceError> {
        let k = self.intrinsics();
        let mut pixels = vec![0; k.width * k.height];
        loop {
            match self.next_into(&mut pixels) {
                Ok(Some(stamp)) if stamp.sequence < sequence => {}
                Err(error) if error.is_transient() => {}
                Err(error) => return Err(error),
                Ok(_) => return Ok(()),
            }
        }
    }

    /// Frames that a camera has lost so far; `None` for recordings, which lose none.
    fn losses(&self) -> Option<FrameLosses> {
        None
    }

    /// Takes the next remark for the log, on what was granted or refused.
    fn take_notice(&mut self) -> Option<Notice> {
        None
    }

    /// Ground-truth camera poses in order of their stamps, empty if there are none.
    fn ground_truth(&self) -> &[StampedPose] {
        &[]
    }

    /// Ground-truth depth in metres (0 where none) of the frame with this stamp, rectified like the frames; `None` if
    /// the source has none for it.
    fn depth_at(&mut self, capture_nanos: i64) -> Result<Option<Image<f32>>, SourceError> {
        let _ = capture_nanos;
        Ok(None)
    }
}
