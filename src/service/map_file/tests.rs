//! A map survives its file, and a corrupt file is an error.

use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, MapState};
use crate::slam::keyframe_pose_covariance::{KeyframePoseCovariance, KeyframePoseMatrix};
use crate::slam::modes::ModeCovariance;
use nalgebra::Vector6;

fn map() -> Map {
    let rigid = SE3::exp(&Vector6::new(0.3, -0.2, 0.1, 0.4, 0.5, -0.6));
    let point = DepthPoint { u: 3, v: 15, inverse_depth: 0.7, variance: 0.01, intensity: 128.5 };
    let keyframe = Keyframe {
        keyframe_id: 7,
        epoch: 1,
        revision: 42,
        sequence: 99,
        capture_nanos: -5,
        map_state: MapState::Established,
        world_from_keyframe: Sim3::new(rigid, 1.7),
        map_from_keyframe: Sim3::new(rigid.inverse(), 2.3),
        map_revision: 3,
        mode_covariance: ModeCovariance::of_std_devs([0.1, 0.2, 0.3]),
        place_covariance: KeyframePoseCovariance::bounded(&(KeyframePoseMatrix::identity() * 0.01)),
        is_refined: true,
        intrinsics: Intrinsics { fx: 20.0, fy: 21.0, cx: 8.0, cy: 7.5, width: 17, height: 16 },
        image: (0..17 * 16).map(|i| (i % 251) as u8).collect(),
        points: vec![point; 5],
        description: None,
    };
    let keyframes = vec![keyframe.clone(), Keyframe { keyframe_id: 8, ..keyframe }];
    let frame = FramePose { sequence: 100, keyframe_id: 7, keyframe_from_camera: rigid };
    let confirmed = ConfirmedPoint {
        keyframe_id: 8,
        u: 16,
        v: 3,
        confirmations: 5,
        inverse_depth: 0.3,
        intensity: 77.0,
    };
    Map {
        keyframes,
        frames: vec![frame, FramePose { sequence: 101, ..frame }],
        confirmed: vec![confirmed; 3],
        loops: Arc::new(crate::service::loop_bytes::tests::loops()),
        free_epoch: 18,
        revision: 4,
        active: Some(7),
    }
}

#[test]
fn a_map_survives_the_file_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.bin");
    write_map(&path, &map(), &mut || ()).unwrap();
    let read = read_map(&path).unwrap();
    assert_eq!((read.free_epoch, read.revision, read.active), (18, 4, Some(7)));
    assert_eq!(read.keyframes, map().keyframes);
    assert_eq!((read.frames, read.confirmed), (map().frames, map().confirmed));
    assert_eq!(read.loops, map().loops);
}

#[test]
fn in_the_layout_before_covariances_were_stored_places_were_relative() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.bin");
    write_map(&path, &map(), &mut || ()).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[..16].copy_from_slice(&MAGIC_9);
    assert!(matches!(parse_map(&bytes[..]), Err(MapFault::Trailing)));
    bytes.truncate(bytes.len() - 8 - covariance_bytes(&map().loops).len());
    let read = parse_map(&bytes[..]).unwrap();
    assert_eq!(read.keyframes, map().keyframes);
    let covariances = &read.loops.relative_covariances;
    assert!(covariances.keys().eq(&[7, 8]) && *covariances != map().loops.relative_covariances);
    // Of the unit, which no adjoint changes.
    assert!((covariances[&7][(6, 6)] - 0.01).abs() < 1e-12, "{covariances:?}");
    assert!(parse_map(&bytes[..bytes.len() - 1]).is_err());
}

#[test]
fn points_of_the_joint_estimation_lie_in_their_keyframes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.bin");
    let mut wrong = map();
    wrong.confirmed[0].keyframe_id = 9;
    wrong.confirmed[1].u = 17;
    wrong.confirmed.push(ConfirmedPoint { inverse_depth: f32::NAN, ..wrong.confirmed[2] });
    write_map(&path, &wrong, &mut || ()).unwrap();
    assert_eq!(read_map(&path).unwrap().confirmed, map().confirmed[2..]);
}

#[test]
fn cut_or_corrupt_bytes_never_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.bin");
    write_map(&path, &map(), &mut || ()).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for length in 0..whole.len() {
        std::fs::write(&path, &whole[..length]).unwrap();
        let error = read_map(&path).unwrap_err().to_string();
        assert!(error.contains("map.bin") && error.lines().count() == 1, "{error}");
    }
    for index in 0..300 {
        let mut broken = whole.clone();
        broken[index] ^= 0xff;
        std::fs::write(&path, &broken).unwrap();
        let _ = read_map(&path); // an error or another value, never a panic
    }
    std::fs::write(&path, [whole, vec![0]].concat()).unwrap();
    assert!(matches!(read_map(&path), Err(MapFileError { fault: MapFault::Trailing, .. })));
}
