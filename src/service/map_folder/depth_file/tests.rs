//! A keyframe survives its file, and a damaged file is an error.

use super::*;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::places::{Description, Feature, FeaturePlace};

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
fn full_detail_is_read_back_bit_for_bit() {
    for own in [0.0, 0.25] {
        let of = keyframe(own);
        let bytes = encode(&of, MapDetail::Full);
        assert!(decoded(&bytes).unwrap() == of, "{own}");
        assert!(bytes.len() <= max_file_bytes(WIDTH * HEIGHT));
    }
    let mut none = keyframe(0.0);
    none.points.clear();
    assert!(decoded(&encode(&none, MapDetail::Full)).unwrap() == none);
}

#[test]
fn small_detail_takes_half_a_byte_per_pixel_and_stays_close() {
    let mut of = keyframe(0.0);
    // A view of a room, not noise.
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
    let furthest = of.image.iter().zip(&small.image[..]).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(furthest <= Some(8), "{furthest:?}");
    // A small one stays the same when it is written again.
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
fn invalid_sizes_and_numbers_with_a_valid_checksum_are_refused() {
    let whole = encode(&keyframe(0.0), MapDetail::Full);
    let with = |at: usize, value: &[u8]| {
        let mut bytes = whole.clone();
        bytes[at..at + value.len()].copy_from_slice(value);
        seal(&mut bytes);
        decoded(&bytes)
    };
    let (points_at, image_bytes_at, place_bytes_at, description_bytes_at) = (40, 52, 76, 80);
    for count in [1, 1041, u32::MAX] {
        assert!(with(points_at, &count.to_le_bytes()).is_err(), "{count} points");
    }
    for count in [0, 1, u64::MAX] {
        assert!(with(image_bytes_at, &count.to_le_bytes()).is_err(), "{count} image bytes");
    }
    assert!(matches!(with(16, &3u32.to_le_bytes()), Err(DepthFileError::Version(3))));
    for count in [0, 1, u32::MAX] {
        assert!(with(place_bytes_at, &count.to_le_bytes()).is_err(), "{count} bytes of places");
    }
    for count in [1, 100, u32::MAX] {
        assert!(with(description_bytes_at, &count.to_le_bytes()).is_err(), "{count} of looks");
    }
    assert!(matches!(with(24, &6u64.to_le_bytes()), Err(DepthFileError::Foreign)));
    let numbers = whole.len() - CHECKSUM_BYTES - 8;
    assert!(matches!(with(numbers, &f32::NAN.to_le_bytes()), Err(DepthFileError::Points(_))));
    assert!(with(HEAD_BYTES, &[0xff]).is_err(), "a bit more than there are points");
}

/// A keyframe with a description.
fn described() -> Keyframe {
    let feature = |k: u16| Feature {
        place: FeaturePlace {
            u: k % 65,
            v: k % 48,
            orientation: (k % 32) as u8,
            scale: (k % 7) as u8,
        },
        bits: [u64::from(k), 2, 3, u64::MAX],
    };
    let description = Description::of_features(WIDTH, HEIGHT, (0..200).map(feature).collect());
    Keyframe { description: Some(Arc::new(description.unwrap())), ..keyframe(0.0) }
}

#[test]
fn a_description_is_read_back_and_damage_to_it_costs_nothing_else() {
    let of = described();
    for detail in [MapDetail::Full, MapDetail::Small] {
        let whole = encode(&of, detail);
        let without = encode(&keyframe(0.0), detail);
        let length = whole.len() - without.len();
        assert!(length <= 7700, "{length}");
        let back = decoded(&whole).unwrap();
        assert_eq!(back.description, of.description);
        assert_ne!(checksum_of(&whole), checksum_of(&without), "its length is in the head");
        for at in (0..length).step_by(5).chain([length - 1]) {
            let mut broken = whole.clone();
            broken[HEAD_BYTES + at] ^= 1 << (at % 8);
            let read = decoded(&broken).unwrap();
            assert!(read.description.is_none(), "byte {at}");
            assert!(read.points == back.points && read.image == back.image, "byte {at}");
        }
        for at in (0..HEAD_BYTES).chain((HEAD_BYTES + length..whole.len()).step_by(11)) {
            let mut broken = whole.clone();
            broken[at] ^= 1 << (at % 8);
            assert!(decoded(&broken).is_err(), "byte {at}");
        }
    }
}

#[test]
fn an_invalid_description_is_left_out() {
    let whole = encode(&described(), MapDetail::Full);
    // The first feature's column, row, orientation, scale; with a valid checksum.
    for (at, value) in [(0, 65), (2, 48), (4, 32), (5, 7)] {
        let mut bytes = whole.clone();
        bytes[HEAD_BYTES + 4 + at] = value;
        let end = HEAD_BYTES + 4 + 200 * 38;
        let checksum = crc32fast::hash(&bytes[HEAD_BYTES..end]);
        bytes[end..end + 4].copy_from_slice(&checksum.to_le_bytes());
        assert!(decoded(&bytes).unwrap().description.is_none(), "{at}");
        bytes[HEAD_BYTES + 4 + at] = whole[HEAD_BYTES + 4 + at];
        let checksum = crc32fast::hash(&bytes[HEAD_BYTES..end]);
        bytes[end..end + 4].copy_from_slice(&checksum.to_le_bytes());
        assert!(decoded(&bytes).unwrap().description.is_some(), "{at}");
    }
}

#[test]
fn files_of_the_previous_version_are_read() {
    for detail in [MapDetail::Full, MapDetail::Small] {
        let of = keyframe(0.0);
        let now = encode(&of, detail);
        let mut rest = &now[..];
        let (head, parts) = take_head(&mut rest).unwrap();
        let (places, rest) = rest.split_at(parts.unwrap().places as usize);
        let mut bits = vec![0u8; pixels::bit_bytes(WIDTH * HEIGHT)];
        let set = pixels::decode(places, WIDTH * HEIGHT, head.num_points as usize).unwrap();
        set.iter().for_each(|pixel| bits[pixel / 8] |= 1 << (pixel % 8));
        let mut before = [&now[..PREVIOUS_HEAD_BYTES], &bits, rest].concat();
        before[16] = PREVIOUS_VERSION as u8;
        seal(&mut before);
        assert_eq!(crc32fast::hash(&before[..before.len() - 4]), checksum_of(&before));
        assert!(decoded(&before).unwrap() == decoded(&now).unwrap());
    }
}
