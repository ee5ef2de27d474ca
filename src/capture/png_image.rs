//! Decodes grey and depth images from a PNG in memory, and encodes the PNG files of datasets.

use std::io::Cursor;

use png::{BitDepth, ColorType, Decoder, Limits, Reader, Transformations};

use crate::capture::decode_error::{DecodeError, MAX_SIDE};
use crate::slam::image::gray::gray_from_interleaved;

/// The first bytes of every PNG.
pub const SIGNATURE: [u8; 8] = [0x89, b'P', b'N', b'G', b'\r', b'\n', 0x1a, b'\n'];

const FORMAT: &str = "PNG";

/// Memory that a decoder may use: the largest image with four 16-bit channels.
const MAX_DECODER_BYTES: usize = MAX_SIDE * MAX_SIDE * 8;

fn damaged(error: png::DecodingError) -> DecodeError {
    DecodeError::Damaged { format: FORMAT, reason: error.to_string() }
}

/// Decodes a PNG of `width * height` pixels, of any colour type and bit depth, into grey values;
/// 16-bit samples keep their high byte, alpha is ignored. `samples` is reused memory.
pub fn decode_gray_into(
    bytes: &[u8],
    width: usize,
    height: usize,
    samples: &mut Vec<u8>,
    gray: &mut [u8],
) -> Result<(), DecodeError> {
    // Palettes and low bit depths become 8-bit samples, 16-bit ones too.
    let wanted = Transformations::EXPAND | Transformations::STRIP_16;
    let mut reader = open(bytes, width, height, wanted)?;
    if gray.len() != width * height {
        return Err(DecodeError::Size { found: (width, height), expected: (width, height) });
    }
    let (color, _) = reader.output_color_type();
    if color == ColorType::Grayscale {
        return finish(&mut reader, gray);
    }
    samples.resize(width * height * color.samples(), 0);
    finish(&mut reader, samples)?;
    match color {
        ColorType::GrayscaleAlpha => {
            for (gray, pixel) in gray.iter_mut().zip(samples.chunks_exact(2)) {
                *gray = pixel[0];
            }
        }
        ColorType::Rgb => gray_from_interleaved::<3>(samples, gray),
        ColorType::Rgba => gray_from_interleaved::<4>(samples, gray),
        ColorType::Grayscale | ColorType::Indexed => {
            let reason = "its palette could not be applied".to_owned();
            return Err(DecodeError::Damaged { format: FORMAT, reason });
        }
    }
    Ok(())
}

/// Whether any pixel of a PNG of `width * height` pixels is transparent, even in part.
pub fn is_transparent(bytes: &[u8], width: usize, height: usize) -> Result<bool, DecodeError> {
    let wanted = Transformations::EXPAND | Transformations::STRIP_16;
    let mut reader = open(bytes, width, height, wanted)?;
    let (color, _) = reader.output_color_type();
    if !matches!(color, ColorType::GrayscaleAlpha | ColorType::Rgba) {
        return Ok(false);
    }
    let mut samples = vec![0; width * height * color.samples()];
    finish(&mut reader, &mut samples)?;
    Ok(samples.chunks_exact(color.samples()).any(|pixel| pixel.last() < Some(&u8::MAX)))
}

/// Decodes a 16-bit grey PNG of `width * height` pixels into its raw samples.
pub fn decode_u16(bytes: &[u8], width: usize, height: usize) -> Result<Vec<u16>, DecodeError> {
    let mut reader = open(bytes, width, height, Transformations::IDENTITY)?;
    let kind = reader.output_color_type();
    if kind != (ColorType::Grayscale, BitDepth::Sixteen) {
        return Err(DecodeError::Samples {
            found: format!("{:?} samples of {} bits", kind.0, kind.1 as u8),
            expected: "16-bit grey",
        });
    }
    let mut samples = vec![0; width * height * 2];
    finish(&mut reader, &mut samples)?;
    let pair = |pair: &[u8]| u16::from_be_bytes([pair[0], pair[1]]);
    Ok(samples.chunks_exact(2).map(pair).collect())
}

/// Returns a reader past the header, whose size has been checked.
fn open(
    bytes: &[u8],
    width: usize,
    height: usize,
    transformations: Transformations,
) -> Result<Reader<Cursor<&[u8]>>, DecodeError> {
    let limits = Limits { bytes: MAX_DECODER_BYTES };
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(transformations);
    let header = decoder.read_header_info().map_err(damaged)?;
    let found = (header.width as usize, header.height as usize);
    if found != (width, height) {
        return Err(DecodeError::Size { found, expected: (width, height) });
    }
    decoder.read_info().map_err(damaged)
}

/// Reads the pixels and continues to the end of the file, so that a truncated file is noticed.
fn finish(reader: &mut Reader<Cursor<&[u8]>>, samples: &mut [u8]) -> Result<(), DecodeError> {
    reader.next_frame(samples).map_err(damaged)?;
    reader.finish().map_err(damaged)
}

/// Encodes a grey PNG; `samples` are rows of `width` samples, big-endian if 16-bit.
pub fn encode_gray(
    width: usize,
    height: usize,
    depth: BitDepth,
    samples: &[u8],
) -> Result<Vec<u8>, png::EncodingError> {
    // Sequences are written at many frames per second and read once or twice.
    encode((width, height), (ColorType::Grayscale, depth), png::Compression::Fast, samples)
}

/// Encodes an 8-bit grey PNG for small size, which takes three times as long.
pub fn encode_gray_small(
    width: usize,
    height: usize,
    samples: &[u8],
) -> Result<Vec<u8>, png::EncodingError> {
    let format = (ColorType::Grayscale, BitDepth::Eight);
    encode((width, height), format, png::Compression::Balanced, samples)
}

/// Encodes a colour PNG; `samples` are rows of `width` times red, green, blue.
pub fn encode_rgb(
    width: usize,
    height: usize,
    samples: &[u8],
) -> Result<Vec<u8>, png::EncodingError> {
    let format = (ColorType::Rgb, BitDepth::Eight);
    encode((width, height), format, png::Compression::Balanced, samples)
}

fn encode(
    (width, height): (usize, usize),
    (color, depth): (ColorType, BitDepth),
    compression: png::Compression,
    samples: &[u8],
) -> Result<Vec<u8>, png::EncodingError> {
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, side(width), side(height));
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(compression);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(samples)?;
    writer.finish()?;
    Ok(bytes)
}
