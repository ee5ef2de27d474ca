//! Decodes grey values of a JPEG in memory, completely or not at all.

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use crate::capture::decode_error::{DecodeError, MAX_SIDE};
use crate::slam::image::gray::gray_from_interleaved;

/// The first bytes of every JPEG: start of image, and the start of a marker.
pub const SIGNATURE: [u8; 3] = [0xff, 0xd8, 0xff];

/// The segment by which the decoder knows a frame of Motion JPEG and assumes the Huffman tables of ITU-T T.81, annex
/// K.3, for those that the frame lacks.
const MOTION_JPEG: &[u8] = b"\xff\xe0\x00\x07AVI1\0";

/// Decodes a JPEG of `width * height` pixels into grey values; `samples` is reused memory for the rare files whose luma
/// is not stored as such (RGB, CMYK), and for frames of cameras that omit the Huffman tables, which are then the
/// standard's. A file that ends early is an error: the decoder alone would fill the missing part with grey. A file that
/// has its end marker but lacks blocks in a scan goes unnoticed: the decoder fills them.
pub fn decode_gray_into(
    bytes: &[u8],
    width: usize,
    height: usize,
    samples: &mut Vec<u8>,
    gray: &mut [u8],
) -> Result<(), DecodeError> {
    let Some(has_tables) = follow_markers(bytes) else {
        return Err(damaged("it ends before its last marker".to_owned()));
    };
    if has_tables {
        return decode_whole_into(bytes, width, height, samples, gray);
    }
    let mut frame = std::mem::take(samples);
    let (start, rest) = bytes.split_at(2);
    frame.clear();
    [start, MOTION_JPEG, rest].iter().for_each(|part| frame.extend_from_slice(part));
    let decoded = decode_whole_into(&frame, width, height, samples, gray);
    *samples = frame;
    decoded
}

/// The same for a JPEG that has its end and tables.
fn decode_whole_into(
    bytes: &[u8],
    width: usize,
    height: usize,
    samples: &mut Vec<u8>,
    gray: &mut [u8],
) -> Result<(), DecodeError> {
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

fn damaged(reason: String) -> DecodeError {
    DecodeError::Damaged { format: "JPEG", reason }
}

/// Follows the markers of a JPEG (ITU-T T.81, annex B) from its start to its end of image, and returns whether it has
/// Huffman tables; `None` if they do not lead there. Embedded previews lie inside segments and are skipped.
fn follow_markers(bytes: &[u8]) -> Option<bool> {
    const HUFFMAN_TABLES: u8 = 0xc4;
    const END_OF_IMAGE: u8 = 0xd9;
    const START_OF_SCAN: u8 = 0xda;
    let mut at = 2;
    let mut has_tables = false;
    loop {
        // A marker is 0xff, possibly repeated as padding, and its code.
        if bytes.get(at) != Some(&0xff) {
            return None;
        }
        while bytes.get(at) == Some(&0xff) {
            at += 1;
        }
        let &code = bytes.get(at)?;
        at += 1;
        match code {
            END_OF_IMAGE => return Some(has_tables),
            HUFFMAN_TABLES => has_tables = true,
            // Markers without a segment: restart 0 to 7, start of image, TEM.
            0xd0..=0xd8 | 0x01 => continue,
            _ => {}
        }
        let Some(&[high, low]) = bytes.get(at..at + 2) else { return None };
        at += usize::from(u16::from_be_bytes([high, low]));
        if code == START_OF_SCAN {
            at += bytes.get(at..).and_then(entropy_coded_length)?;
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
        assert_eq!(follow_markers(&whole), Some(false));
        for length in 0..whole.len() {
            assert_eq!(follow_markers(&whole[..length]), None, "{length} bytes");
        }
        // Padding after the end, as cameras write it, does no harm.
        assert_eq!(follow_markers(&[&whole[..], &[0; 5]].concat()), Some(false));
    }

    #[test]
    fn a_frame_without_huffman_tables_has_the_standards() {
        // One grey block, 38 darker than medium: category 6 (1110) and 011001, then "end of block" (1010) and padding.
        let mut frame = vec![0xff, 0xd8, 0xff, 0xdb, 0, 67, 0];
        frame.extend([8; 64]);
        frame.extend([0xff, 0xc0, 0, 11, 8, 0, 8, 0, 8, 1, 1, 0x11, 0]);
        frame.extend([0xff, 0xda, 0, 8, 1, 1, 0, 0, 63, 0]);
        frame.extend([0b1110_0110, 0b0110_1011, 0xff, 0xd9]);
        let (mut samples, mut gray) = (Vec::new(), [0; 64]);
        for _ in 0..2 {
            decode_gray_into(&frame, 8, 8, &mut samples, &mut gray).unwrap();
            assert_eq!(gray, [90; 64]);
        }
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
