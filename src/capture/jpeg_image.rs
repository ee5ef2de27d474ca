//! Decodes grey values of a JPEG in memory, completely or not at all.

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use crate::capture::decode_error::{DecodeError, MAX_SIDE};
use crate::slam::image::gray::gray_from_interleaved;

/// The first bytes of every JPEG: start of image, and the start of a marker.
pub const SIGNATURE: [u8; 3] = [0xff, 0xd8, 0xff];

/// Decodes a JPEG of `width * height` pixels into grey values; `samples` is reused memory for the rare files whose luma
/// is not stored as such (RGB, CMYK). A file that ends early is an error: the decoder alone would fill the missing part
/// with grey. A file that has its end marker but lacks blocks in a scan goes unnoticed: the decoder fills them.
pub fn decode_gray_into(
    bytes: &[u8],
    width: usize,
    height: usize,
    samples: &mut Vec<u8>,
    gray: &mut [u8],
) -> Result<(), DecodeError> {
    let damaged = |reason: String| DecodeError::Damaged { format: "JPEG", reason };
    if !reaches_end_of_image(bytes) {
        return Err(damaged("it ends before its last marker".to_owned()));
    }
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(MAX_SIDE)
        .set_max_height(MAX_SIDE)
        .jpeg_set_out_colorspace(ColorSpace::Luma);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| damaged(e.to_string()))?;
    let found = decoder.dimensions().ok_or_else(|| damaged("it has no image size".to_owned()))?;
    if found != (width, height) || gray.len() != width * height {
        return Err(DecodeError::Size { found, expected: (width, height) });
    }
    if matches!(decoder.input_colorspace(), Some(ColorSpace::YCbCr | ColorSpace::Luma)) {
        return decoder.decode_into(gray).map_err(|e| damaged(e.to_string()));
    }
    decoder.set_options(options.jpeg_set_out_colorspace(ColorSpace::RGB));
    samples.resize(width * height * 3, 0);
    decoder.decode_into(samples).map_err(|e| damaged(e.to_string()))?;
    gray_from_interleaved::<3>(samples, gray);
    Ok(())
}

/// Whether the markers of a JPEG (ITU-T T.81, annex B) lead from its start to its end of image. Embedded previews lie
/// inside segments and are skipped.
fn reaches_end_of_image(bytes: &[u8]) -> bool {
    const END_OF_IMAGE: u8 = 0xd9;
    const START_OF_SCAN: u8 = 0xda;
    let mut at = 2;
    loop {
        // A marker is 0xff, possibly repeated as padding, and its code.
        if bytes.get(at) != Some(&0xff) {
            return false;
        }
        while bytes.get(at) == Some(&0xff) {
            at += 1;
        }
        let Some(&code) = bytes.get(at) else { return false };
        at += 1;
        match code {
            END_OF_IMAGE => return true,
            // Markers without a segment: restart 0 to 7, start of image, TEM.
            0xd0..=0xd8 | 0x01 => continue,
            _ => {}
        }
        let Some(&[high, low]) = bytes.get(at..at + 2) else { return false };
        at += usize::from(u16::from_be_bytes([high, low]));
        if code == START_OF_SCAN {
            let Some(length) = bytes.get(at..).and_then(entropy_coded_length) else { return false };
            at += length;
        }
    }
}

/// Bytes of entropy-coded data up to the next marker that is not a restart.
fn entropy_coded_length(bytes: &[u8]) -> Option<usize> {
    let is_end = |pair: &[u8]| pair[0] == 0xff && !matches!(pair[1], 0x00 | 0xd0..=0xd7 | 0xff);
    bytes.windows(2).position(is_end)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markers_are_followed_to_the_end() {
        // A preview with its own end of image inside an APP1 segment, a scan with a stuffed 0xff
        // and a restart, then the end.
        let head: &[u8] = &[0xff, 0xd8, 0xff, 0xe1, 0, 6, 0xff, 0xd8, 0xff, 0xd9];
        let scan: &[u8] = &[0xff, 0xda, 0, 3, 1, 9, 9, 0xff, 0, 7, 0xff, 0xd3, 8];
        let whole = [head, scan, &[0xff, 0xd9]].concat();
        assert!(reaches_end_of_image(&whole));
        for length in 0..whole.len() {
            assert!(!reaches_end_of_image(&whole[..length]), "{length} bytes");
        }
        // Padding after the end, as cameras write it, does no harm.
        assert!(reaches_end_of_image(&[&whole[..], &[0; 5]].concat()));
    }

    #[test]
    fn noise_is_an_error_without_a_panic() {
        let mut state = 1u32;
        for length in 0..400 {
            let mut bytes = vec![0xff, 0xd8, 0xff, 0xdb];
            for _ in 0..length {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                bytes.push((state >> 24) as u8);
            }
            bytes.extend([0xff, 0xd9]);
            let result = decode_gray_into(&bytes, 16, 16, &mut Vec::new(), &mut [0; 256]);
            assert!(result.is_err());
        }
    }
}
