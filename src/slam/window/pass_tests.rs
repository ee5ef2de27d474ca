//! Passes over a walk through a room that is bent in the middle.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Vector6};

use super::tests::{exact_host, in_map};
use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe_pose_covariance::{KeyframePoseCovariance, KeyframePoseMatrix};
use crate::slam::map::{Correction, KeyframeCorrection, LogPlane};
use crate::slam::modes::ModeCovariance;
use crate::slam::test_scene::{CAMERA, Scene};

const KEYFRAMES: usize = 10;

fn params() -> WindowParams {
    let (num_free, num_fixed, num_first) = (3, 4, 3);
    WindowParams {
        num_free,
        num_fixed,
        num_first,
        pass_every: 5,
        pass_piece: 4,
        ..WindowParams::default()
    }
}

/// A walk sideways, with exact poses and exact depth, all hosts.
fn walk() -> Window {
    let scene = Scene::new(3);
    let mut window = Window::new(CAMERA, params());
    for k in 0..KEYFRAMES {
        let map_from_camera =
            SE3::exp(&Vector6::from([0.1 * k as f64, 0.0, 0.0, 0.0, -0.01 * k as f64, 0.0]));
        let view = scene.render(&CAMERA, &map_from_camera);
        let pixels = view.noisy(1.0, k as u64);
        window.keyframes.push(exact_host(k as u64, &map_from_camera, pixels, &view, 300));
    }
    window.pass.added = window.params.pass_every;
    window
}

/// Displaces keyframes 4 and 5 by this many metres, a pixel per centimetre, and a quarter as many radians.
fn bend(window: &mut Window, by: f64) {
    let off = SE3::exp(&Vector6::from([0.0, by, 0.5 * by, 0.0, 0.0, 0.25 * by]));
    for keyframe in &mut window.keyframes[4..=5] {
        keyframe.camera_from_map = off * keyframe.camera_from_map;
    }
}

/// Root mean square distance of the keyframes from their true positions.
fn error(window: &Window, truth: &Window) -> f64 {
    let pairs = window.keyframes.iter().zip(&truth.keyframes);
    let squares = pairs.map(|(found, right)| {
        let at = |of: &WindowKeyframe| of.camera_from_map.inverse().translation;
        (at(found) - at(right)).norm_squared()
    });
    (squares.sum::<f64>() / window.keyframes.len() as f64).sqrt()
}

/// Estimates a piece and returns the keyframes that it freed; `None` where none is due.
fn piece(window: &mut Window) -> Option<Vec<u64>> {
    window.moved.clear();
    window.begin_piece().then(|| {
        window.optimise().unwrap();
        window.moved.clone()
    })
}

#[test]
fn a_pass_straightens_a_bend_and_leaves_the_first_keyframe() {
    let truth = walk();
    for by in [0.01, -0.01] {
        let mut window = truth.clone();
        bend(&mut window, by);
        let before = error(&window, &truth);
        let mut freed = Vec::new();
        while let Some(moved) = piece(&mut window) {
            freed.push(moved);
        }
        let after = error(&window, &truth);
        assert!(before > 0.004 && after < 0.5 * before, "{before} {after}");
        // Pieces begin with keyframes 0, 2, 4, 6.
        assert_eq!(freed, [vec![1, 2, 3], vec![2, 3, 4, 5], vec![4, 5, 6, 7], vec![6, 7, 8, 9]]);
        assert_eq!(window.keyframes[0].camera_from_map, truth.keyframes[0].camera_from_map);
        assert!(window.keyframes.iter().all(|of| of.images.len() == 1 || of.keyframe_id > 1));
        // The next pass begins after `pass_every` keyframes.
        window.pass.added = params().pass_every - 1;
        assert_eq!(piece(&mut window), None);
        window.pass.added += 1;
        assert_eq!(piece(&mut window), Some(vec![1, 2, 3]));
    }
}

#[test]
fn a_map_that_is_reconsidered_is_straightened_at_once() {
    let truth = walk();
    let mut window = truth.clone();
    window.params.pass_every = 0;
    bend(&mut window, 0.01);
    let before = error(&window, &truth);
    assert_eq!(window.clone().optimise(), None, "nothing is due otherwise");
    window.reconsiders = true;
    window.optimise().unwrap();
    let after = error(&window, &truth);
    assert!(before > 0.004 && after < 0.5 * before, "{before} {after}");
    assert_eq!(window.moved, (1..KEYFRAMES as u64).collect::<Vec<_>>());
    assert_eq!(window.optimise(), None, "once");
}

#[test]
fn a_dropped_piece_is_estimated_again_and_a_new_keyframe_does_not_restart_the_pass() {
    let mut window = walk();
    let first = piece(&mut window);
    window.repeat_piece();
    assert_eq!(piece(&mut window), first);
    assert_eq!(piece(&mut window), Some(vec![2, 3, 4, 5]));
    // The newest keyframe takes precedence: it is estimated, not the next piece.
    window.unaligned.push(9);
    window.moved.clear();
    window.optimise().unwrap();
    assert_eq!(window.moved, [7, 8, 9]);
    assert_eq!(piece(&mut window), Some(vec![4, 5, 6, 7]));
}

#[test]
fn a_pass_ends_with_its_epoch() {
    let mut window = walk();
    piece(&mut window).unwrap();
    window.keyframes.iter_mut().for_each(|keyframe| keyframe.epoch = 1);
    assert_eq!(piece(&mut window), None);
    // Few keyframes are all estimated anyway.
    let mut short = walk();
    short.keyframes.truncate(3);
    assert_eq!(piece(&mut short), None);
    let mut off = walk();
    off.params.pass_every = 0;
    assert_eq!(piece(&mut off), None);
}

#[test]
fn a_jump_of_the_newest_plane_or_unit_beyond_its_sigma_calls_for_a_pass() {
    let map = Map {
        keyframes: (0..KEYFRAMES as u64).map(|id| in_map(id, 0, 0.1 * id as f64, 1.0)).collect(),
        ..Map::default()
    };
    let of_unit = |std_dev: f64| {
        let mut matrix = KeyframePoseMatrix::zeros();
        matrix[(6, 6)] = std_dev * std_dev;
        Some(KeyframePoseCovariance::bounded(&matrix))
    };
    let begins_with = |unit: f64, per_x: f64, std_dev: f64, relative_place| {
        let mut window = walk();
        window.pass.added = 0;
        let mut map_from_keyframe = map.keyframes[9].map_from_keyframe;
        map_from_keyframe.scale *= unit.exp();
        let newest = KeyframeCorrection {
            keyframe_id: 9,
            map_from_keyframe,
            depth: LogPlane { per_x, ..LogPlane::default() },
            modes: Some(ModeCovariance::of_std_devs([std_dev; 3])),
            // Drift of the map is no excuse for a jump.
            place: of_unit(0.5),
            relative_place,
        };
        window.request_pass_on_jump(
            &map,
            &Correction { keyframes: vec![newest], ..Correction::default() },
        );
        window.begin_piece()
    };
    let begins =
        |unit: f64, per_x: f64, std_dev: f64| begins_with(unit, per_x, std_dev, of_unit(0.01));
    assert!(begins_with(0.15, 0.0, 0.01, None));
    assert!(!begins_with(0.15, 0.0, 0.01, of_unit(0.05)), "three sigma of the unit");
    assert!(begins(0.15, 0.0, 0.01) && begins(-0.15, 0.0, 0.01));
    assert!(begins(0.0, 0.15, 0.01) && begins(0.0, -0.15, 0.01));
    assert!(!begins(0.05, 0.05, 0.001), "as recordings wander");
    assert!(!begins(0.0, 0.15, 0.05), "three sigma");
}

#[test]
fn keyframes_that_a_piece_does_not_free_stay_and_so_do_new_ones() {
    let mut window = walk();
    bend(&mut window, 0.01);
    piece(&mut window).unwrap();
    let moved = piece(&mut window).unwrap();
    let mut map = Map::default();
    map.keyframes.extend((0..=10).map(|id| in_map(id, 0, 0.1 * id as f64, 1.0)));
    // 4 was rejected: it follows 3.
    window.keyframes.remove(4);
    let none =
        |_: &Marginal| (ModeCovariance::of(&Matrix3::zeros()), None::<KeyframePoseCovariance>);
    let correction = window.correction(&map, none);
    let corrected: BTreeSet<u64> = correction.keyframes.iter().map(|of| of.keyframe_id).collect();
    assert_eq!(corrected, moved.into_iter().collect());
}
