//! Compresses payloads for the network, losslessly except for frames: points by columns and LZ4, images as PNG.
//!
//! Points are ordered row by row, so that differences of u and v are nearly all small; the bytes of equal
//! significance of the real numbers are stored together, because exponents repeat and mantissas do not.

use std::io::Cursor;

use semidense::slam::keyframe::{DepthPoint, MAX_KEYFRAME_POINTS};
use zerocopy::IntoBytes;

use crate::ros::images::{CompressError, png};
use crate::zenoh::envelope::{Opened, Packed, Packing};

/// Bytes of a point.
const POINT_BYTES: usize = size_of::<DepthPoint>();

/// A payload that does not match its envelope.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a payload that does not unpack to the announced size")]
pub struct UnpackError;

/// Packs fixed-size elements unchanged, for graphs.
pub fn pack_plain(bytes: &[u8]) -> Packed {
    Packed { packing: Packing::Plain, unpacked_bytes: bytes.len(), bytes: bytes.to_vec() }
}

/// Packs the depth of a keyframe.
pub fn pack_points(points: &[DepthPoint]) -> Packed {
    let mut planes = vec![0; points.len() * POINT_BYTES];
    let mut before = [0; 2];
    for (index, point) in points.iter().enumerate() {
        let delta = [point.u.wrapping_sub(before[0]), point.v.wrapping_sub(before[1])];
        before = [point.u, point.v];
        let coded = DepthPoint { u: delta[0], v: delta[1], ..*point };
        for (rank, byte) in coded.as_bytes().iter().enumerate() {
            planes[rank * points.len() + index] = *byte;
        }
    }
    lz4(&planes)
}

/// Unpacks the depth of a keyframe, bit for bit.
pub fn unpack_points(opened: &Opened<'_>) -> Result<Vec<DepthPoint>, UnpackError> {
    let bytes = opened.envelope.payload_bytes as usize;
    let count = bytes / POINT_BYTES;
    if !bytes.is_multiple_of(POINT_BYTES) || count > MAX_KEYFRAME_POINTS {
        return Err(UnpackError);
    }
    let planes = unlz4(opened, bytes)?;
    let mut points = vec![DepthPoint::default(); count];
    let mut before = [0_u16; 2];
    for (index, point) in points.iter_mut().enumerate() {
        for (rank, byte) in point.as_mut_bytes().iter_mut().enumerate() {
            *byte = planes[rank * count + index];
        }
        (point.u, point.v) = (point.u.wrapping_add(before[0]), point.v.wrapping_add(before[1]));
        before = [point.u, point.v];
    }
    Ok(points)
}

/// Packs a grey image of `width` × `height` pixels.
pub fn pack_image(pixels: &[u8], width: u32, height: u32) -> Result<Packed, CompressError> {
    let bytes = png(width, height, pixels)?;
    Ok(Packed { packing: Packing::Png, unpacked_bytes: pixels.len(), bytes })
}

/// Unpacks a grey image of `width` × `height` pixels, bit for bit; one of another size is refused before unpacking.
pub fn unpack_image(opened: &Opened<'_>, width: u32, height: u32) -> Result<Vec<u8>, UnpackError> {
    let length = width as usize * height as usize;
    if opened.packing != Packing::Png || opened.envelope.payload_bytes as usize != length {
        return Err(UnpackError);
    }
    let limits = png::Limits { bytes: length.saturating_mul(2) };
    let decoder = png::Decoder::new_with_limits(Cursor::new(opened.packed), limits);
    let mut reader = decoder.read_info().map_err(|_| UnpackError)?;
    let expected = (width, height, png::ColorType::Grayscale, png::BitDepth::Eight);
    let header = reader.info();
    if (header.width, header.height, header.color_type, header.bit_depth) != expected {
        return Err(UnpackError);
    }
    let mut pixels = vec![0; length];
    reader.next_frame(&mut pixels).map_err(|_| UnpackError)?;
    Ok(pixels)
}

/// Compresses with LZ4.
fn lz4(bytes: &[u8]) -> Packed {
    let packed = lz4_flex::block::compress(bytes);
    Packed { packing: Packing::Lz4, unpacked_bytes: bytes.len(), bytes: packed }
}

/// Decompresses exactly `length` bytes, never more, whatever the input.
fn unlz4(opened: &Opened<'_>, length: usize) -> Result<Vec<u8>, UnpackError> {
    if opened.packing != Packing::Lz4 || opened.envelope.payload_bytes as usize != length {
        return Err(UnpackError);
    }
    let mut bytes = vec![0; length];
    let unpacked = lz4_flex::block::decompress_into(opened.packed, &mut bytes);
    if unpacked.ok() == Some(length) { Ok(bytes) } else { Err(UnpackError) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::zenoh::envelope::{Origin, open, seal};
    use crate::zenoh::kind::Kind;

    const ORIGIN: Origin = Origin { sender: 1, run: 1, sent_nanos: 0, realtime_offset_nanos: 0 };

    fn points(count: usize) -> Vec<DepthPoint> {
        let point = |i: usize| DepthPoint {
            u: (i * 3 % 640) as u16,
            v: (i * 3 / 640) as u16,
            inverse_depth: 1.0 / (1.0 + i as f32),
            variance: 1e-3 * (i % 17) as f32,
            intensity: (i % 256) as f32,
        };
        (0..count).map(point).collect()
    }

    fn sealed(payload: &Packed) -> Vec<u8> {
        seal(&ORIGIN, Kind::Keyframe, 1, &0_u64, payload)
    }

    #[test]
    fn packing_preserves_every_bit() {
        for count in [0, 1, 1000] {
            let points = points(count);
            let bytes = sealed(&pack_points(&points));
            assert_eq!(unpack_points(&open(&bytes).unwrap()), Ok(points));
        }
        let pixels: Vec<u8> = (0..4800_u32).map(|i| (i * i / 7) as u8).collect();
        let bytes = sealed(&pack_image(&pixels, 80, 60).unwrap());
        let opened = open(&bytes).unwrap();
        assert_eq!(unpack_image(&opened, 80, 60), Ok(pixels));
        for (width, height) in [(60, 80), (80, 59), (8192, 8192), (0, 0)] {
            assert_eq!(unpack_image(&opened, width, height), Err(UnpackError));
        }
    }

    #[test]
    fn malformed_payloads_are_refused() {
        let good = pack_points(&points(100));
        let cut = Packed { bytes: good.bytes[..good.bytes.len() / 2].to_vec(), ..good.clone() };
        let more = Packed { unpacked_bytes: good.unpacked_bytes + POINT_BYTES, ..good.clone() };
        let bomb = lz4(&vec![0; (MAX_KEYFRAME_POINTS + 1) * POINT_BYTES]);
        let plain = Packed { packing: Packing::Plain, ..good };
        for payload in [cut, more, bomb, plain] {
            let bytes = sealed(&payload);
            assert_eq!(unpack_points(&open(&bytes).unwrap()), Err(UnpackError));
        }
    }
}
