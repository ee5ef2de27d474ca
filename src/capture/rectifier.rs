//! Converts the images that a source reads to the rectified ones that it returns.

use std::path::Path;

use crate::capture::rig::Rig;
use crate::capture::source_error::SourceError;
use crate::capture::v4l::pixel_format::{InvalidPicture, PixelFormat, unpack_gray};
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::rectification::Rectification;
use crate::slam::image::buffer::Image;

/// Rectifies the images of a source's camera.
#[derive(Debug)]
pub struct Rectifier {
    camera: CameraModel,
    readout_s: f64,
    rectification: Rectification,
    /// The raw image; empty if it is the rectified one.
    raw: Vec<u8>,
    /// Scratch memory of the decoders.
    samples: Vec<u8>,
}

impl Rectifier {
    /// Creates a rectifier for the camera of `rig`, which was read from `rig_path`.
    pub fn new(rig: &Rig, rig_path: &Path) -> Result<Self, SourceError> {
        let rectification = Rectification::new(&rig.camera)
            .map_err(|source| SourceError::Rectification { path: rig_path.to_owned(), source })?;
        let Intrinsics { width, height, .. } = *rectification.intrinsics();
        let raw = if rectification.is_identity() { Vec::new() } else { vec![0; width * height] };
        Ok(Self {
            camera: rig.camera,
            readout_s: 1e-3 * rig.readout_ms,
            rectification,
            raw,
            samples: Vec::new(),
        })
    }

    /// The camera of the raw images.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// Time in which all rows are read out, seconds.
    pub fn readout_s(&self) -> f64 {
        self.readout_s
    }

    /// Intrinsics of the rectified images; raw images have the same size.
    pub fn intrinsics(&self) -> Intrinsics {
        *self.rectification.intrinsics()
    }

    /// Rectifies into `pixels` the grey image that `read` writes; the second argument of `read` is reused memory.
    pub fn read_into<E>(
        &mut self,
        pixels: &mut [u8],
        read: impl FnOnce(&mut [u8], &mut Vec<u8>) -> Result<(), E>,
    ) -> Result<(), E> {
        if self.rectification.is_identity() {
            return read(pixels, &mut self.samples);
        }
        read(&mut self.raw, &mut self.samples)?;
        self.rectification.rectify_into(&self.raw, pixels);
        Ok(())
    }

    /// Rectifies into `pixels` a picture in a camera's format, with `stride` bytes from row to row. Grey without
    /// padding is read directly from `bytes`, which may be the driver's memory.
    pub fn unpack_into(
        &mut self,
        format: PixelFormat,
        bytes: &[u8],
        stride: usize,
        pixels: &mut [u8],
    ) -> Result<(), InvalidPicture> {
        let Intrinsics { width, height, .. } = self.intrinsics();
        let is_packed = format == PixelFormat::Grey && stride == width;
        if let (true, Some(packed)) = (is_packed, bytes.get(..width * height)) {
            self.rectification.rectify_into(packed, pixels);
            return Ok(());
        }
        self.read_into(pixels, |gray, samples| {
            unpack_gray(format, bytes, stride, (width, height), samples, gray)
        })
    }

    /// Rectifies a raw grey image.
    pub fn rectified(&self, raw: &[u8]) -> Vec<u8> {
        let mut rectified = raw.to_vec();
        if !self.rectification.is_identity() {
            self.rectification.rectify_into(raw, &mut rectified);
        }
        rectified
    }

    /// Rectifies a raw depth image; `None` if it has another size.
    pub fn rectify_depth(&self, raw: &Image<f32>) -> Option<Image<f32>> {
        self.rectification.rectify_depth(raw)
    }
}
