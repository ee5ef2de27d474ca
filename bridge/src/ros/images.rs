//! Encoding of images: pixels, PNG or JPEG.

use clap::ValueEnum;

use crate::jpeg::{JpegError, encode_gray};

/// How images are sent and recorded. Measured for grey 640x480 of a camera (`fr1-floor`); the texts are those
/// of the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ImageFormat {
    /// PNG: lossless; 1.6 ms and 170 kB for 640x480
    Png,
    /// JPEG: lossy, replays differ slightly; 6 ms and 70 kB
    Jpeg,
    /// Pixels (mono8): no encoding, 307 kB; rerun shows them as depth
    Raw,
    /// No images; the recording cannot be replayed
    None,
}

/// Quality of JPEGs: below 90, blocks begin to show in gradients, on which direct tracking relies.
const JPEG_QUALITY: u8 = 90;

/// Why an image cannot be compressed.
#[derive(Debug, thiserror::Error)]
pub enum CompressError {
    /// The PNG encoder failed.
    #[error("an image cannot be written as PNG: {0}")]
    Png(#[from] png::EncodingError),
    /// The JPEG encoder failed.
    #[error("an image cannot be written as JPEG: {0}")]
    Jpeg(#[from] JpegError),
}

/// A grey image of `width * height` pixels as PNG.
pub fn png(width: u32, height: u32, pixels: &[u8]) -> Result<Vec<u8>, CompressError> {
    // The fastest level that still compresses; of the filters, Paeth leaves the fewest bytes for the same time.
    let mut bytes = Vec::with_capacity(pixels.len());
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_compression(png::Compression::Fastest);
    encoder.set_filter(png::Filter::Paeth);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    writer.finish()?;
    Ok(bytes)
}

/// A grey image of `width * height` pixels as JPEG.
pub fn jpeg(width: u32, height: u32, pixels: &[u8]) -> Result<Vec<u8>, CompressError> {
    Ok(encode_gray(pixels, [width as usize, height as usize], JPEG_QUALITY)?)
}
