//! Kernel cameras (V4L2): named, opened, read, lost and found again.
//!
//! The kernel is called directly, through the few structures of `linux/videodev2.h` in `kernel`. The crate `v4l` (0.14,
//! last released in 2023) would need libclang at build time, and its stream cannot continue after one timeout: it
//! enqueues a buffer that the kernel still owns. The interface is the kernel's ABI, so nothing here ages.
//!
//! From the inside out: `video_device` is the interface of a device, `device` the kernel's implementation;
//! `negotiation`, `controls`, `stamps` and `pixel_format` each decide one thing; `connection` is a camera that appears
//! and disappears, and this file turns it into a [`FrameSource`].

pub(crate) mod connection;
mod controls;
pub(in crate::capture) mod device;
mod device_name;
#[cfg(test)]
mod fake;
mod kernel;
pub mod listing;
pub(crate) mod negotiation;
pub mod params;
pub(crate) mod pixel_format;
pub(in crate::capture) mod stamps;
pub mod video_device;

use std::os::fd::BorrowedFd;
use std::path::Path;

use self::connection::Camera;
use self::device::Kernel;
use self::negotiation::StreamRequest;
use self::params::CameraParams;
use self::video_device::VideoSystem;
use crate::capture::rectifier::Rectifier;
use crate::capture::rig::Rig;
use crate::capture::source::{Arrival, FrameLosses, FrameSource, FrameStamp, Notice};
use crate::capture::source_error::SourceError;
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;

pub use self::pixel_format::{InvalidPicture, PixelFormat};

/// Timeout of each wait by a reader that has not awaited the frame, milliseconds.
pub(in crate::capture) const READ_MILLIS: u32 = 1000;

/// A camera as a source of rectified frames: an endless source of the newest frame.
pub struct CameraSource<S: VideoSystem> {
    name: String,
    camera: Camera<S>,
    rectifier: Rectifier,
}

/// Creates the source for the camera of this name (a path, a number or udev's name), with the lens of a rig file. The
/// camera itself is opened when a frame is awaited: it may be connected later.
pub fn open(
    name: &str,
    rig: Option<&Path>,
    params: &CameraParams,
) -> Result<CameraSource<impl VideoSystem + use<>>, SourceError> {
    const NO_RIG: &str = "a camera needs a rig file with its calibration: name it with --rig FILE (for a first try at \
                          640x480, webcam.toml in config/rigs or /usr/share/semidense/rigs is enough)";
    let path = rig.ok_or_else(|| SourceError::Camera {
        name: format!("v4l:{name}"),
        reason: NO_RIG.to_owned(),
    })?;
    CameraSource::new(Kernel, name, &Rig::read(path)?, path, params)
}

impl<S: VideoSystem> CameraSource<S> {
    fn new(
        system: S,
        name: &str,
        rig: &Rig,
        rig_path: &Path,
        params: &CameraParams,
    ) -> Result<Self, SourceError> {
        let rectifier = Rectifier::new(rig, rig_path)?;
        let Intrinsics { width, height, .. } = rectifier.intrinsics();
        let own_rate = (params.rate_hz > 0.0).then_some(params.rate_hz);
        let requested = StreamRequest {
            width: width as u32,
            height: height as u32,
            format: params.format.format(),
            rate_hz: own_rate.or(rig.rate_hz),
        };
        let camera = Camera::new(system, name.to_owned(), params.clone(), requested);
        Ok(Self { name: format!("v4l:{name}"), camera, rectifier })
    }

    fn failed(&self, reason: String) -> SourceError {
        SourceError::Camera { name: self.name.clone(), reason }
    }

    /// Converts the held frame; the error says why it is not a picture.
    fn convert(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, InvalidPicture> {
        let Some((held, grant, bytes)) = self.camera.held() else { return Ok(None) };
        self.rectifier.unpack_into(grant.format, bytes, grant.stride, pixels)?;
        Ok(Some(held.stamp))
    }
}

impl<S: VideoSystem> FrameSource for CameraSource<S> {
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

    fn await_frame(&mut self, wake: BorrowedFd<'_>, millis: u32) -> Result<Arrival, SourceError> {
        self.camera.await_frame(Some(wake), millis).map_err(|reason| self.failed(reason))
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        self.check_buffer(pixels)?;
        while self.camera.held().is_none() {
            let arrival = self.camera.await_frame(None, READ_MILLIS);
            if let Arrival::Absent(reason) = arrival.map_err(|reason| self.failed(reason))? {
                return Err(self.failed(reason));
            }
        }
        let converted = self.convert(pixels);
        self.camera.release(converted.is_err());
        converted.map_err(|broken| SourceError::BrokenFrame {
            name: self.name.clone(),
            reason: broken.to_string(),
        })
    }

    fn skip_to(&mut self, _sequence: u64) -> Result<(), SourceError> {
        // A camera's numbers start anew with every opening.
        Ok(())
    }

    fn losses(&self) -> Option<FrameLosses> {
        Some(self.camera.losses())
    }

    fn take_notice(&mut self) -> Option<Notice> {
        self.camera.take_notice()
    }
}

#[cfg(test)]
mod tests;
