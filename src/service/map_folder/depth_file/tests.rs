//! A keyframe comes back from its file, and a damaged file is an error.

use super::*;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::sim3::Sim3;

const WIDTH: usize = 65;
const HEIGHT: usize = 48;

fn keyframe(own_brightness: f32) -> Keyframe {
    let image: Vec<u8> = (0..WIDTH * HEIGHT).map(|i| ((i * i) >> 4) as u8).collect();
    let points = (0..WIDTH * HEIGHT).filter(|i| i % 3 == 1).map(|i| DepthPoint {
        u: (i % WIDTH) as u16,
        v: (i / WIDTH) as u16,
        inverse_depth: 0.3 + (i % 97) as f32 * 0.01,
        variance: 1e-4 * (1.0 + (i % 7) as f32),
        intensity: f32::from(image[i]) + own_brightness,
    });
    let points = points.collect();
    let camera = Intrinsics::pinhole(WIDTH, HEIGHT, 60.0);
    let at = Keyframe::at(Sim3::identity(), camera, points, image);
    Keyframe { keyframe_id: 5, revision: 9, ..at }
}

fn decoded(bytes: &[u8]) -> Result<Keyframe, DepthFileError> {
    let mut into = keyframe(0.0).without_depth();
    decode_into(bytes, &mut into).map(|()| into)
}

#[test]
fn full_detail_gives_the_same_bits_back() {
    for own in [0.0, 0.25] {
        let of = keyframe(own);
        let bytes = encode(&of, MapDetail::Full);
        assert!(decoded(&bytes).unwrap() == of, "{own}");
        assert!(bytes.len() <= most_bytes(WIDTH * HEIGHT));
    }
    let mut none = keyframe(0.0);
    none.points.clear();
    assert!(decoded(&encode(&none, MapDetail::Full)).unwrap() == none);
}

#[test]
fn small_detail_takes_half_a_byte_a_pixel_and_stays_near() {
    let mut of = keyframe(0.0);
    // A view of a room, not of noise.
    of.image = (0..WIDTH * HEIGHT).map(|i| ((i % WIDTH) * 3 + i / WIDTH) as u8).collect();
    let bytes = encode(&of, MapDetail::Small);
    assert!(bytes.len() <= HEAD_BYTES + 4 + WIDTH * HEIGHT / 2, "{}", bytes.len());
    let small = decoded(&bytes).unwrap();
    assert!(small.points.len() > 90, "{}", small.points.len());
    for point in &small.points {
        let pixel = |p: &&DepthPoint| (p.u, p.v) == (point.u, point.v);
        let exact = of.points.iter().find(pixel).unwrap();
        assert!((point.inverse_depth / exact.inverse_depth - 1.0).abs() < 1e-4);
        assert!((point.variance / exact.variance - 1.0).abs() < 0.03);
    }
    let furthest = of.image.iter().zip(&small.image).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(furthest <= Some(8), "{furthest:?}");
    // What was small stays the same when it is written again.
    assert!(decoded(&encode(&small, MapDetail::Full)).unwrap() == small);
}

#[test]
fn every_cut_and_every_wrong_bit_is_an_error() {
    for detail in [MapDetail::Full, MapDetail::Small] {
        let whole = encode(&keyframe(0.0), detail);
        for length in (0..whole.len()).step_by(7).chain([whole.len() - 1]) {
            assert!(decoded(&whole[..length]).is_err(), "{length}");
        }
        assert!(decoded(&[&whole[..], &[0]].concat()).is_err());
        for byte in (0..HEAD_BYTES).chain((HEAD_BYTES..whole.len()).step_by(11)) {
            let mut broken = whole.clone();
            broken[byte] ^= 1 << (byte % 8);
            assert!(decoded(&broken).is_err(), "byte {byte}");
        }
    }
}

#[test]
fn hostile_sizes_and_numbers_with_a_right_checksum_are_refused() {
    let whole = encode(&keyframe(0.0), MapDetail::Full);
    let with = |at: usize, value: &[u8]| {
        let mut bytes = whole.clone();
        bytes[at..at + value.len()].copy_from_slice(value);
        let end = bytes.len() - CHECKSUM_BYTES;
        let checksum = crc32fast::hash(&bytes[..end]);
        bytes[end..].copy_from_slice(&checksum.to_le_bytes());
        decoded(&bytes)
    };
    let (points_at, image_bytes_at) = (40, 52);
    for count in [1, 1041, u32::MAX] {
        assert!(with(points_at, &count.to_le_bytes()).is_err(), "{count} points");
    }
    for count in [0, 1, u64::MAX] {
        assert!(with(image_bytes_at, &count.to_le_bytes()).is_err(), "{count} image bytes");
    }
    assert!(matches!(with(16, &2u32.to_le_bytes()), Err(DepthFileError::Version(2))));
    assert!(matches!(with(24, &6u64.to_le_bytes()), Err(DepthFileError::Foreign)));
    let numbers = whole.len() - CHECKSUM_BYTES - 8;
    assert!(matches!(with(numbers, &f32::NAN.to_le_bytes()), Err(DepthFileError::Points(_))));
    assert!(with(HEAD_BYTES, &[0xff]).is_err(), "a bit more than there are points");
}
