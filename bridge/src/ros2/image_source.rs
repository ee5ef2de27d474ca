//! Converts ROS images to frames of a stream for capture.

use semidense::capture::decode_error::{DecodeError, MAX_SIDE};
use semidense::capture::image_file::{decode_gray_into, image_size};
use semidense::capture::ros_image::{RosImage, RosImageError};
use semidense::capture::stream::format::{StreamClock, StreamHeader};

use crate::ros::message::{CompressedImage, Image, Time};

/// A stamp further than this from the arrival belongs to another clock: a recording's, a simulation's.
const PLAUSIBLE_NANOS: u64 = 10_000_000_000;

/// Why an image is not forwarded.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// Invalid format or bytes.
    #[error(transparent)]
    Raw(#[from] RosImageError),
    /// Invalid format or bytes of a compressed image.
    #[error("a compressed image ({format}): {source}")]
    Compressed {
        /// The sender's name of the format.
        format: String,
        /// What is wrong.
        source: DecodeError,
    },
    /// An impossible size.
    #[error("invalid image size {0}x{1}")]
    Size(usize, usize),
}

/// A grey frame whose memory is reused from image to image.
#[derive(Debug, Default)]
pub struct GrayFrame {
    /// Grey values, row by row.
    pub pixels: Vec<u8>,
    samples: Vec<u8>,
    size: (u32, u32),
}

impl GrayFrame {
    fn resize(&mut self, width: usize, height: usize) -> Result<(), ImageError> {
        if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
            return Err(ImageError::Size(width, height));
        }
        self.size = (width as u32, height as u32);
        self.pixels.resize(width * height, 0);
        Ok(())
    }

    /// Converts an image to grey and returns its stamp.
    pub fn unpack(&mut self, image: &Image) -> Result<Time, ImageError> {
        let Image { header, encoding, width, height, step, is_bigendian, data } = image;
        // Before memory is allocated: each pixel has at least one byte.
        if (data.len() as u64) < u64::from(*width) * u64::from(*height) {
            return Err(ImageError::Size(*width as usize, *height as usize));
        }
        self.resize(*width as usize, *height as usize)?;
        let image = RosImage {
            encoding,
            width: *width,
            height: *height,
            step: *step,
            is_bigendian: *is_bigendian != 0,
            data,
        };
        image.unpack_gray(&mut self.pixels)?;
        Ok(header.stamp)
    }

    /// Decodes a compressed image, JPEG or PNG, to grey and returns its stamp.
    pub fn decode(&mut self, image: &CompressedImage) -> Result<Time, ImageError> {
        let broken = |source| ImageError::Compressed { format: image.format.clone(), source };
        let (width, height) = image_size(&image.data).map_err(broken)?;
        self.resize(width, height)?;
        decode_gray_into(&image.data, width, height, &mut self.samples, &mut self.pixels)
            .map_err(broken)?;
        Ok(image.header.stamp)
    }

    /// The stream header of this frame. `stamp` is ROS's, `now_nanos` is CLOCK_REALTIME.
    pub fn header(&self, stamp: Time, sequence: u64, now_nanos: i64) -> StreamHeader {
        let (clock, nanos) = clock_of(stamp, now_nanos);
        StreamHeader::gray(self.size, clock, nanos, sequence)
    }
}

/// The clock of a stamp, and its time. An image without a stamp gets that of its arrival.
fn clock_of(stamp: Time, now_nanos: i64) -> (StreamClock, i64) {
    let nanos = stamp.nanos();
    match nanos {
        0 => (StreamClock::Realtime, now_nanos),
        _ if nanos.abs_diff(now_nanos) <= PLAUSIBLE_NANOS => (StreamClock::Realtime, nanos),
        // There are no stamps before 1970.
        _ => (StreamClock::Other, nanos.max(0)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::message::Header;

    const NOW: i64 = 1_700_000_000_000_000_000;

    fn image(encoding: &str, step: u32, data: Vec<u8>) -> Image {
        let header = Header::default();
        let encoding = encoding.to_owned();
        Image { header, height: 2, width: 4, encoding, is_bigendian: 0, step, data }
    }

    #[test]
    fn an_image_becomes_a_frame_with_its_stamp() {
        let mut frame = GrayFrame::default();
        frame.unpack(&image("rgb8", 12, [255, 0, 0].repeat(8))).unwrap();
        assert_eq!(frame.pixels, [76; 8]);
        let header = frame.header(Time::from_nanos(NOW - 5), 3, NOW);
        assert_eq!(header, StreamHeader::gray((4, 2), StreamClock::Realtime, NOW - 5, 3));
        let recorded = Time::from_nanos(1_300_000_000_000_000_001);
        let header = frame.header(recorded, 3, NOW);
        assert_eq!((header.clock, header.stamp_nanos), (StreamClock::Other, recorded.nanos()));
        assert_eq!(frame.header(Time::default(), 3, NOW).stamp_nanos, NOW);
    }

    #[test]
    fn malformed_images_are_errors_and_allocate_no_memory() {
        let mut frame = GrayFrame::default();
        let huge = Image { width: 8192, height: 8192, ..image("mono8", 8192, vec![0; 8]) };
        assert!(frame.unpack(&huge).is_err());
        assert!(frame.pixels.is_empty());
        assert!(frame.unpack(&image("32FC1", 16, vec![0; 32])).is_err());
        let compressed = |data: &[u8]| CompressedImage {
            header: Header::default(),
            format: "jpeg".to_owned(),
            data: data.to_vec(),
        };
        assert!(frame.decode(&compressed(b"\xff\xd8\xff")).is_err());
        let error = frame.decode(&compressed(b"ConfigHeader")).unwrap_err().to_string();
        assert!(error.contains("compressed image (jpeg)"), "{error}");
    }
}
