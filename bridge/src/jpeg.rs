//! Grey images to and from JPEG.

use jpeg_encoder::{ColorType, Encoder};
use zune_jpeg::JpegDecoder;
use zune_jpeg::errors::DecodeErrors;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Why an image cannot be encoded or decoded.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum JpegError {
    /// The size does not match the pixels, or exceeds what a JPEG can hold.
    #[error("{width} × {height} is not the size of this image")]
    Size {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// The encoder or decoder failed.
    #[error("JPEG: {0}")]
    Coding(String),
}

/// Encodes a grey image of `width` × `height` pixels as JPEG; `quality` from 1 to 100.
pub fn encode_gray(
    pixels: &[u8],
    [width, height]: [usize; 2],
    quality: u8,
) -> Result<Vec<u8>, JpegError> {
    let wrong = JpegError::Size { width, height };
    let side = |length: usize| u16::try_from(length).ok().filter(|side| *side > 0);
    let (Some(columns), Some(rows)) = (side(width), side(height)) else { return Err(wrong) };
    if pixels.len() != width * height {
        return Err(wrong);
    }
    let mut bytes = Vec::with_capacity(pixels.len() / 4);
    let encoder = Encoder::new(&mut bytes, quality.clamp(1, 100));
    encoder
        .encode(pixels, columns, rows, ColorType::Luma)
        .map_err(|error| JpegError::Coding(error.to_string()))?;
    Ok(bytes)
}

/// Decodes a JPEG of this size: one of another size is refused before memory is allocated for it.
pub fn decode_gray(bytes: &[u8], [width, height]: [usize; 2]) -> Result<Vec<u8>, JpegError> {
    let wrong = JpegError::Size { width, height };
    let failed = |error: DecodeErrors| JpegError::Coding(error.to_string());
    let options = DecoderOptions::default()
        .set_max_width(width)
        .set_max_height(height)
        .jpeg_set_out_colorspace(ColorSpace::Luma);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(failed)?;
    if decoder.dimensions() != Some((width, height)) {
        return Err(wrong);
    }
    let pixels = decoder.decode().map_err(failed)?;
    if pixels.len() == width * height { Ok(pixels) } else { Err(wrong) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_survives_a_round_trip_within_the_loss_of_jpeg() {
        let size = [64, 48];
        let pixels: Vec<u8> = (0..64 * 48).map(|i| (i % 64 * 2 + i / 64) as u8).collect();
        let bytes = encode_gray(&pixels, size, 90).unwrap();
        let back = decode_gray(&bytes, size).unwrap();
        let worst = pixels.iter().zip(&back).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst.is_some_and(|worst| worst < 12), "{worst:?}");
    }

    #[test]
    fn wrong_sizes_and_damaged_images_are_refused() {
        let bytes = encode_gray(&[7; 64 * 48], [64, 48], 90).unwrap();
        assert!(decode_gray(&bytes, [48, 64]).is_err());
        assert!(decode_gray(&bytes, [1 << 20, 1 << 20]).is_err());
        assert!(decode_gray(b"GIF89a", [64, 48]).is_err());
        for size in [[64, 47], [0, 0], [1 << 17, 1]] {
            assert!(encode_gray(&[7; 64 * 48], size, 90).is_err(), "{size:?}");
        }
    }
}
