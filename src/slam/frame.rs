//! The frame type of the algorithms: one rectified grey image with its stamp and sequence.

use crate::slam::geometry::intrinsics::Intrinsics;

/// A borrowed rectified grey image, whether it lies in shared memory or in a buffer.
#[derive(Debug, Clone, Copy)]
pub struct FrameView<'a> {
    /// Frame number assigned by the source; gaps reveal lost frames.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds (CLOCK_MONOTONIC live, the recording's clock otherwise).
    pub capture_nanos: i64,
    /// Exposure time in nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Rows of `width` grey values without padding, `width * height` bytes; [`NO_DATA`](crate::slam::image::NO_DATA)
    /// where it shows nothing of the scene.
    pub pixels: &'a [u8],
}

impl<'a> FrameView<'a> {
    /// A frame of this camera, of unknown exposure.
    pub fn new(camera: &Intrinsics, sequence: u64, capture_nanos: i64, pixels: &'a [u8]) -> Self {
        let Intrinsics { width, height, .. } = *camera;
        Self { sequence, capture_nanos, exposure_nanos: 0, width, height, pixels }
    }

    /// Whether the number of pixels matches the size.
    pub fn is_consistent(&self) -> bool {
        self.width.checked_mul(self.height) == Some(self.pixels.len())
    }
}
