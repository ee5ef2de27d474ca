//! Memory, poses and corrections of the map.

use nalgebra::Vector6;

use super::*;
use crate::slam::keyframe::MAX_KEYFRAME_POINTS;
use crate::slam::keyframe_pose_covariance::KeyframePoseMatrix;

fn keyframe(keyframe_id: u64) -> Keyframe {
    Keyframe {
        keyframe_id,
        sequence: keyframe_id,
        ..Keyframe::at(
            Sim3::identity(),
            Intrinsics::pinhole(20, 20, 20.0),
            vec![DepthPoint::default(); 25],
            vec![7; 400],
        )
    }
}

#[test]
fn the_memory_of_a_keyframe_is_as_stated() {
    const NUM_PIXELS: usize = 640 * 480;
    let mut full = keyframe(0);
    full.image = vec![0; NUM_PIXELS].into();
    full.points = vec![DepthPoint::default(); MAX_KEYFRAME_POINTS];
    // One byte per pixel, 16 per point.
    assert_eq!(depth_bytes(&full), 1_907_200);
}

#[test]
fn the_oldest_lose_their_depth_and_keep_their_pose() {
    let mut map = Map { keyframes: (0..5).map(keyframe).collect(), ..Map::default() };
    let one = depth_bytes(&map.keyframes[0]);
    map.forget_depth_beyond(2 * one);
    let kept: Vec<bool> = map.keyframes.iter().map(|k| !k.points.is_empty()).collect();
    assert_eq!(kept, [false, false, false, true, true]);
    assert_eq!(map.keyframes.iter().map(|k| k.image.len()).sum::<usize>(), 800);
    map.forget_depth_beyond(0);
    assert!(!map.keyframes[4].points.is_empty());
}

#[test]
fn the_covariance_of_a_pose_moves_with_it_unless_a_correction_gives_one() {
    let deviations = Vector6::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03).push(0.05);
    let matrix = KeyframePoseMatrix::from_diagonal(&deviations.component_mul(&deviations));
    let uncertain =
        Keyframe { place_covariance: KeyframePoseCovariance::bounded(&matrix), ..keyframe(1) };
    let by = Sim3::new(SE3::exp(&Vector6::new(1.0, -2.0, 0.5, 0.3, 0.2, -0.4)), 2.5);
    let corrected = |place, unit| {
        let mut map = Map { keyframes: vec![uncertain.clone()], ..Map::default() };
        let moved = by * uncertain.map_from_keyframe;
        let corrected = KeyframeCorrection { place, ..KeyframeCorrection::of_pose(1, moved) };
        let correction = Correction { keyframes: vec![corrected], joins: Vec::new(), unit };
        map.correct(&correction, 7).unwrap();
        map.keyframes[0].place_covariance
    };
    let mut joined = Map { keyframes: vec![uncertain.clone()], ..Map::default() };
    let join = EpochJoin::exact(0, 3, by);
    joined.correct(&Correction { joins: vec![join], ..Correction::default() }, 7).unwrap();
    // For a keyframe at the map's origin: lengths in the new unit, and about the new origin.
    let expected = uncertain.place_covariance.transported(&by).matrix();
    assert!(expected[(3, 3)] > 1e-5 && (expected - matrix).norm() > 0.1);
    for found in [corrected(None, Some(2.5)), joined.keyframes[0].place_covariance] {
        assert!((found.matrix() - expected).norm() < 1e-9, "{}", found.matrix());
    }
    // Only its own unit is longer, the map's is the same.
    let longer = corrected(None, None).matrix();
    let rigid = uncertain.place_covariance.transported(&Sim3::new(by.rigid, 1.0)).matrix();
    assert!((longer - rigid).norm() < 1e-9, "{longer}");
    let said = KeyframePoseCovariance::bounded(&(matrix * 0.5));
    assert_eq!(corrected(Some(said), None), said);
}

#[test]
fn a_keyframe_is_found_in_any_order() {
    for ids in [vec![0, 3, 4, 90], vec![90, 4, 0, 3]] {
        let map = Map { keyframes: ids.iter().copied().map(keyframe).collect(), ..Map::default() };
        for (index, id) in ids.iter().enumerate() {
            assert_eq!(map.index_of(*id), Some(index));
        }
        assert_eq!(map.index_of(5), None);
    }
}

#[test]
fn keyframes_of_a_joined_epoch_have_the_error_of_the_join_at_their_places() {
    const STEP: f64 = 1e-6;
    let by = Sim3::new(SE3::exp(&Vector6::new(1.0, -2.0, 0.5, 0.3, 0.2, -0.4)), 2.5);
    let error = Vector6::new(0.3, -0.2, 0.5, 0.7, -0.4, 0.6).push(-0.8);
    let covariance = KeyframePoseCovariance::bounded(&(error * error.transpose()));
    let mut at = keyframe(1);
    at.map_from_keyframe = Sim3::new(SE3::exp(&Vector6::new(0.5, 3.0, -1.0, 0.2, 0.0, 0.4)), 1.5);
    let mut map = Map { keyframes: vec![at.clone()], ..Map::default() };
    let join = EpochJoin { epoch: 0, into: 3, into_from_epoch: by, covariance };
    map.correct(&Correction { joins: vec![join], ..Correction::default() }, 7).unwrap();
    let [exact, found] = [by, Sim3::exp(&(error * STEP)) * by].map(|by| by * at.map_from_keyframe);
    let pose = (found.rigid * exact.rigid.inverse()).log() / STEP;
    let expected = pose.push((found.scale / exact.scale).ln() / STEP);
    let found = map.keyframes[0].place_covariance.matrix();
    assert!((found - expected * expected.transpose()).norm() < 1e-4 * found.norm(), "{found}");
}
