//! From the images that a source reads to the rectified ones that it gives.

use std::path::Path;

use crate::capture::rig::Rig;
use crate::capture::source_error::SourceError;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::rectification::Rectification;
use crate::slam::image::buffer::Image;

/// Rectifies the images of a source's camera.
#[derive(Debug)]
pub struct Rectifier {
    rectification: Rectification,
    /// The raw image, where it is not the rectified one.
    raw: Vec<u8>,
}

impl Rectifier {
    /// For the camera of `rig`, which was read from `rig_path`.
    pub fn new(rig: &Rig, rig_path: &Path) -> Result<Self, SourceError> {
        let rectification = Rectification::new(&rig.camera)
            .map_err(|source| SourceError::Rectification { path: rig_path.to_owned(), source })?;
        let Intrinsics { width, height, .. } = *rectification.intrinsics();
        let raw = if rectification.is_identity() { Vec::new() } else { vec![0; width * height] };
        Ok(Self { rectification, raw })
    }

    /// Intrinsics of the rectified images; raw images have the same size.
    pub fn intrinsics(&self) -> Intrinsics {
        *self.rectification.intrinsics()
    }

    /// Writes the rectified image of the grey one that `read` writes.
    pub fn read_into<E>(
        &mut self,
        pixels: &mut [u8],
        read: impl FnOnce(&mut [u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        if self.rectification.is_identity() {
            return read(pixels);
        }
        read(&mut self.raw)?;
        self.rectification.rectify_into(&self.raw, pixels);
        Ok(())
    }

    /// Writes the rectified image of a grey one that is in memory already.
    pub fn rectify_into(&self, raw: &[u8], pixels: &mut [u8]) {
        self.rectification.rectify_into(raw, pixels);
    }

    /// The rectified depth image of a raw one; `None` of one that has another size.
    pub fn rectify_depth(&self, raw: &Image<f32>) -> Option<Image<f32>> {
        self.rectification.rectify_depth(raw)
    }
}
