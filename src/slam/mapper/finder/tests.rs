//! The camera is found on known keyframes, and on no other.

use super::*;
use crate::slam::test_scene::{CAMERA, Scene};
use nalgebra::Vector6;

/// A keyframe with exact depth and little noise.
fn keyframe(scene: &Scene, keyframe_id: u64, world_from_camera: SE3) -> Keyframe {
    scene.keyframe(keyframe_id, world_from_camera, 1.0)
}

fn at(twist: [f64; 6]) -> SE3 {
    SE3::exp(&Vector6::from(twist))
}

#[test]
fn a_known_view_is_found_on_its_keyframe_and_an_unknown_one_on_none() {
    let scene = Scene::new(3);
    let home = at([0.0; 6]);
    let away = at([0.0, 0.0, 0.0, 0.0, 1.2, 0.0]);
    let elsewhere = at([0.0, 0.0, 0.0, 0.0, 2.8, 0.0]);
    let keyframes =
        [keyframe(&scene, 0, home), keyframe(&scene, 1, away), keyframe(&scene, 2, elsewhere)];
    let params = RecoveryParams { keyframes_per_frame: 3, ..Default::default() };
    let mut searched = 0;
    let mut find = |finder: &mut Finder, view: SE3| {
        let pixels = scene.render(&CAMERA, &view).noisy(2.0, 9);
        let (index, found) =
            finder.find(&mut keyframes.to_vec(), Some(2), &mut searched, &pixels, &params)?;
        let placed = keyframes[index].map_from_keyframe.transform_pose(&found);
        let error = (view.inverse() * placed).log().norm();
        assert!(error < 0.02, "found {error} away from where it is");
        Some(index)
    };
    let mut recovery = Finder::new(&CAMERA);
    let near_home = at([0.1, -0.05, 0.1, 0.05, 0.1, -0.05]);
    assert_eq!(find(&mut recovery, near_home), Some(0));
    assert_eq!(find(&mut recovery, away * near_home), Some(1));
    assert_eq!(find(&mut recovery, at([0.0, 0.0, 0.0, 0.0, -1.5, 0.0])), None);
    assert_eq!(find(&mut recovery, elsewhere), None, "the active one is the tracker's");
}

#[test]
fn a_keyframe_that_was_not_confirmed_is_skipped_in_the_next_frame() {
    let scene = Scene::new(3);
    let [one, other] = [0.0, 0.05].map(|x| at([x, 0.0, 0.0, 0.0, 0.0, 0.0]));
    let active = keyframe(&scene, 2, at([0.0, 0.0, 0.0, 0.0, 2.8, 0.0]));
    let keyframes = [keyframe(&scene, 0, one), keyframe(&scene, 1, other), active];
    let pixels = scene.render(&CAMERA, &at([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])).noisy(2.0, 9);
    let mut finder = Finder::new(&CAMERA);
    let params = RecoveryParams::default();
    let mut find = |doubted: Option<usize>| {
        finder.doubted = doubted.or(finder.doubted);
        finder.find(&mut keyframes.to_vec(), Some(2), &mut 0, &pixels, &params).unwrap().0
    };
    let first = find(None);
    assert_eq!(find(Some(first)), 1 - first);
    assert_eq!(find(None), first);
}

#[test]
fn a_camera_with_a_large_roll_is_found_by_features_and_by_small_images() {
    let scene = Scene::new(3);
    let home = keyframe(&scene, 0, at([0.0; 6]));
    let away = keyframe(&scene, 1, at([0.0, 0.0, 0.0, 0.0, 1.2, 0.0]));
    let active = keyframe(&scene, 2, at([0.0, 0.0, 0.0, 0.0, 2.8, 0.0]));
    let keyframes = [home, away, active];
    let params = RecoveryParams::default();
    let view = at([0.05, -0.05, 0.05, 0.0, 0.0, 0.0]) * at([0.0, 0.0, 0.0, 0.1, -0.1, 1.9]);
    let pixels = scene.render(&CAMERA, &view).noisy(2.0, 9);
    let mut finder = Finder::new(&CAMERA);
    let (index, found) =
        finder.find(&mut keyframes.to_vec(), Some(2), &mut 0, &pixels, &params).unwrap();
    let error = (view.inverse() * found).log().norm();
    assert!(index == 0 && error < 0.02, "found {error} away from where it is, on {index}");
    let mut compared = 0;
    let found =
        finder.find_turned(&mut keyframes.to_vec(), Some(2), &mut compared, &pixels, &params);
    let (index, found) = found.unwrap();
    assert_eq!((index, compared), (0, 2));
    let error = (view.inverse() * found).log().norm();
    assert!(error < 0.02, "found {error} away from where it is");
    let nowhere = scene.render(&CAMERA, &at([0.0, 0.0, 0.0, 0.0, -1.5, 0.0])).noisy(2.0, 9);
    assert!(
        finder.find_turned(&mut keyframes.to_vec(), Some(2), &mut 0, &nowhere, &params).is_none()
    );
}

#[test]
fn the_most_similar_keyframe_comes_first_and_rejected_or_nearly_empty_ones_are_left_out() {
    let scene = Scene::new(3);
    let known = keyframe(&scene, 0, SE3::identity());
    let rejected = Keyframe { map_state: MapState::Rejected, ..known.clone() };
    let empty = Keyframe { points: known.points[..50].to_vec(), ..known.clone() };
    let numbered = |keyframes: Vec<Keyframe>| -> Vec<Keyframe> {
        let ids = (0..).zip(keyframes);
        ids.map(|(keyframe_id, keyframe)| Keyframe { keyframe_id, ..keyframe }).collect()
    };
    let active = keyframe(&scene, 3, at([0.0, 0.0, 0.0, 0.0, 2.0, 0.0]));
    let pixels = known.image.clone();
    let params = RecoveryParams { keyframes_per_frame: 1, ..RecoveryParams::default() };
    let find = |keyframes: &[Keyframe], active: usize| {
        let found = Finder::new(&CAMERA).find(
            &mut keyframes.to_vec(),
            Some(active),
            &mut 0,
            &pixels,
            &params,
        );
        found.map(|(index, _)| index)
    };
    let without = numbered(vec![rejected, empty, active.clone()]);
    assert_eq!(find(&without, 2), None);
    let far = |of: f64| keyframe(&scene, 1, at([0.0, 0.0, 0.0, 0.0, of, 0.0]));
    let other_epoch = Keyframe { epoch: 1, ..known };
    let with = numbered(vec![far(-2.0), other_epoch, far(1.0), far(-1.0), active]);
    assert_eq!(find(&with, 4), Some(1), "an earlier keyframe, of another epoch");
}

#[test]
fn keyframes_that_lost_their_depth_are_removed_from_the_index() {
    let scene = Scene::new(3);
    let pan = |k: u64| at([0.0, 0.0, 0.0, 0.0, 0.3 * k as f64, 0.0]);
    let mut keyframes: Vec<_> = (0..8).map(|k| keyframe(&scene, k, pan(k))).collect();
    let mut finder = Finder::new(&CAMERA);
    finder.index_new(&mut keyframes, usize::MAX);
    assert_eq!(finder.places.len(), 8);
    let bytes = finder.places.bytes();
    for given_up in &mut keyframes[1..7] {
        *given_up = given_up.without_depth();
    }
    finder.index_new(&mut keyframes, MAX_INDEXED);
    let left: Vec<u64> = (0..8).filter(|id| finder.places.contains(*id)).collect();
    assert_eq!(left, [0, 7]);
    assert!(2 * finder.places.bytes() < bytes, "{bytes} B, now {}", finder.places.bytes());
}

#[test]
fn a_keyframe_is_described_once_and_found_by_its_existing_description() {
    let scene = Scene::new(3);
    let away = at([0.0, 0.0, 0.0, 0.0, 1.2, 0.0]);
    let mut keyframes = [keyframe(&scene, 0, at([0.0; 6])), keyframe(&scene, 1, away)];
    Finder::new(&CAMERA).index_new(&mut keyframes, MAX_INDEXED);
    let made = keyframes.each_ref().map(|of| of.description.clone().unwrap());
    // Another finder uses the existing description, even where the image would give a different one.
    keyframes[0].description = Some(made[1].clone());
    let mut finder = Finder::new(&CAMERA);
    finder.index_new(&mut keyframes, usize::MAX);
    assert!(Arc::ptr_eq(keyframes[0].description.as_ref().unwrap(), &made[1]));
    let found = finder.places.candidates(&made[0], 2, |_| false);
    assert!(found.iter().all(|of| of.score < 30.0), "{found:?}");
    let found = finder.places.candidates(&made[1], 2, |_| false);
    assert_eq!(found.iter().filter(|of| of.score > 100.0).count(), 2, "{found:?}");
}

#[test]
fn further_keyframes_are_tried_where_the_first_does_not_align() {
    let scene = Scene::new(3);
    let (here, active) = (SE3::identity(), at([0.0, 0.0, 0.0, 0.0, 2.0, 0.0]));
    // Looks like the frame but has no valid depth to align to.
    let mut wrong = keyframe(&scene, 0, here);
    wrong.points.iter_mut().for_each(|point| point.inverse_depth = f32::NAN);
    let side = at([0.3, 0.0, 0.0, 0.0, 0.05, 0.0]);
    let keyframes = [wrong, keyframe(&scene, 1, side), keyframe(&scene, 2, active)];
    let pixels = scene.render(&CAMERA, &at([0.12, 0.0, 0.0, 0.0, 0.02, 0.0])).noisy(2.0, 5);
    let find = |keyframes_per_frame| {
        let params = RecoveryParams { keyframes_per_frame, ..RecoveryParams::default() };
        let found =
            Finder::new(&CAMERA).find(&mut keyframes.to_vec(), Some(2), &mut 0, &pixels, &params);
        found.map(|(index, _)| index)
    };
    assert_eq!((find(1), find(2)), (None, Some(1)));
}

#[test]
fn a_single_attempt_per_frame_reaches_every_candidate() {
    let scene = Scene::new(3);
    let turned = |angle: f64| at([0.0, 0.0, 0.0, 0.0, angle, 0.0]);
    let angles = [0.0, 0.3, -0.3, 0.6, 2.8];
    let keyframes: Vec<Keyframe> =
        (0..).zip(angles).map(|(id, angle)| keyframe(&scene, id, turned(angle))).collect();
    let mut finder = Finder::new(&CAMERA);
    let params = RecoveryParams { keyframes_per_frame: 1, num_keyframes: 4, ..Default::default() };
    let pixels = scene.render(&CAMERA, &turned(0.1)).noisy(2.0, 9);
    let mut searched = 0;
    let mut found = std::collections::BTreeSet::new();
    for _ in 0..4 {
        let tried = finder.find(&mut keyframes.clone(), Some(4), &mut searched, &pixels, &params);
        found.extend(tried.map(|(index, _)| index));
    }
    assert!(searched == 4 && found.len() >= 3, "{searched} searches, found on {found:?}");
}

#[test]
fn keyframes_of_another_camera_are_not_searched() {
    let scene = Scene::new(3);
    let mut known = keyframe(&scene, 0, SE3::identity());
    let pixels = known.image.clone();
    let active = keyframe(&scene, 1, at([0.0, 0.0, 0.0, 0.0, 2.0, 0.0]));
    let params = RecoveryParams::default();
    let find = |known: &Keyframe| {
        let mut keyframes = [known.clone(), active.clone()];
        let mut finder = Finder::new(&CAMERA);
        let by_alignment = finder.find(&mut keyframes, Some(1), &mut 0, &pixels, &params);
        let turned = finder.find_turned(&mut keyframes, Some(1), &mut 0, &pixels, &params);
        (by_alignment.is_some(), turned.is_some())
    };
    assert_eq!(find(&known), (true, true));
    known.intrinsics.fx *= 1.01;
    assert_eq!(find(&known), (false, false));
}

#[test]
fn a_rolled_or_turned_view_resembles_its_keyframe_by_its_small_image_alone() {
    let scene = Scene::new(3);
    let mut keyframes = [keyframe(&scene, 0, at([0.0; 6]))];
    let mut finder = Finder::new(&CAMERA);
    finder.index_new(&mut keyframes, MAX_INDEXED);
    // Without its features.
    finder.places.remove(0);
    let mut resembles = |found: SE3, pan: f64| {
        let view = at([0.0, 0.0, 0.0, 0.0, pan, 0.0]) * found;
        let pixels = scene.render(&CAMERA, &view).noisy(2.0, 9);
        finder.resembles(&keyframes[0], &found.rotation, &pixels)
    };
    let roll = |degrees: f64| [0.02, 0.0, 0.05, 0.0, 0.0, degrees.to_radians()];
    for twist in [roll(0.0), roll(30.0), roll(-90.0), roll(180.0), [0.0, 0.0, 0.0, 0.1, 0.3, 0.2]] {
        assert!(resembles(at(twist), 0.0), "{twist:?}");
        for pan in [1.2, -1.5, 2.8] {
            assert!(!resembles(at(twist), pan), "{twist:?} elsewhere");
        }
    }
}
