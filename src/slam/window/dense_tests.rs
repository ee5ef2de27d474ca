//! Depth of a whole keyframe of the rendered room, refined from the keyframes around it at their true poses.

use super::tests::{Room, room};
use super::*;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::DepthPoint;
use crate::slam::keyframe::Keyframe;
use crate::slam::test_scene::{CAMERA, Random};

/// Unit of the keyframe, in that of the map.
const UNIT: f64 = 2.0;
const NOISE: f64 = 0.05;

fn window(room: &Room) -> Window {
    let mut keyframes = room.keyframes.clone();
    let points = keyframes.iter_mut().flat_map(|keyframe| &mut keyframe.points);
    points.for_each(|point| point.confirmations = 3);
    Window { keyframes, ..Window::new(CAMERA, WindowParams::default()) }
}

/// The room's keyframe 1, its depth with noise and a common factor by depth, `relief`, and the true inverse depths.
fn keyframe(room: &Room, relief: f64) -> (Keyframe, Vec<f64>) {
    let mut random = Random::new(7);
    let host = &room.keyframes[1];
    let truth: Vec<f64> = host.points.iter().map(|point| UNIT * point.inverse_depth).collect();
    let points = host.points.iter().zip(&truth).map(|(point, truth)| {
        let wrong = truth * (relief * (truth / UNIT).ln() + NOISE * random.normal()).exp();
        DepthPoint {
            u: point.u,
            v: point.v,
            inverse_depth: wrong as f32,
            variance: (NOISE * wrong).powi(2) as f32,
            intensity: 0.0,
        }
    });
    let place = Sim3::new(host.camera_from_map.inverse(), UNIT);
    let keyframe = Keyframe {
        keyframe_id: 1,
        ..Keyframe::at(place, CAMERA, points.collect(), host.images[0].pixels().to_vec())
    };
    (keyframe, truth)
}

fn errors(points: &[DepthPoint], truth: &[f64]) -> Vec<f64> {
    let pairs = points.iter().zip(truth);
    pairs.map(|(point, truth)| (f64::from(point.inverse_depth) / truth).ln()).collect()
}

fn median_size(errors: &[f64]) -> f64 {
    plane::median(errors.iter().map(|error| error.abs()).collect())
}

#[test]
fn refinement_removes_noise_and_relief_and_increases_certainty() {
    let room = room(|_, _| (1.0, 0.0));
    let (keyframe, truth) = keyframe(&room, 0.1);
    let before = median_size(&errors(&keyframe.points, &truth));
    let refined = window(&room).refine_keyframe(&keyframe).unwrap();
    assert_eq!((refined.keyframe_id, refined.points.len()), (1, keyframe.points.len()));
    let left = errors(&refined.points, &truth);
    let after = median_size(&left);
    assert!(before > 0.05 && after < 0.01, "{before} {after}");
    // The near half against the far half.
    let middle = plane::median(truth.clone());
    let relief = |errors: &[f64]| {
        let of_half = |is_near: bool| {
            let half = errors.iter().zip(&truth).filter(|(_, truth)| (**truth > middle) == is_near);
            plane::median(half.map(|(error, _)| *error).collect())
        };
        (of_half(true) - of_half(false)).abs()
    };
    let (before, after) = (relief(&errors(&keyframe.points, &truth)), relief(&left));
    assert!(before > 0.03 && after < 0.5 * before, "{before} {after}");
    let relative = |point: &DepthPoint| f64::from(point.variance.sqrt() / point.inverse_depth);
    let is_within = |(point, error): (&DepthPoint, &f64)| error.abs() < relative(point);
    let within = refined.points.iter().zip(&left).filter(|of| is_within(*of)).count();
    let share = within as f64 / left.len() as f64;
    assert!((0.55..0.98).contains(&share), "{share}");
    let std_dev = plane::median(refined.points.iter().map(relative).collect());
    assert!(std_dev < 0.8 * NOISE, "{std_dev}");
}

#[test]
fn depth_that_contradicts_the_keyframes_is_left_unchanged() {
    let room = room(|_, _| (1.0, 0.0));
    let (mut keyframe, _) = keyframe(&room, 0.0);
    let sure = keyframe.points.len() / 2;
    keyframe.points[sure].inverse_depth *= 1.2;
    keyframe.points[sure].variance = 1e-8;
    let refined = window(&room).refine_keyframe(&keyframe).unwrap();
    let plane_only = refined.points[sure].inverse_depth / keyframe.points[sure].inverse_depth;
    assert!((plane_only - 1.0).abs() < 0.02, "{plane_only}");
}

#[test]
fn a_keyframe_that_no_other_sees_is_not_refined() {
    let mut room = room(|_, _| (1.0, 0.0));
    let (keyframe, _) = keyframe(&room, 0.0);
    for (index, other) in room.keyframes.iter_mut().enumerate() {
        other.epoch = u32::from(index == 1);
    }
    assert_eq!(window(&room).refine_keyframe(&keyframe), None);
    let unknown = Keyframe { keyframe_id: 9, ..keyframe };
    assert_eq!(window(&room).refine_keyframe(&unknown), None);
}

#[test]
fn refined_depth_does_not_depend_on_the_number_of_threads() {
    let room = room(|_, _| (1.0, 0.0));
    let (keyframe, _) = keyframe(&room, 0.1);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| window(&room).refine_keyframe(&keyframe))
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn every_keyframe_is_refined_once_and_none_after_a_dropped_estimate() {
    let mut window = window(&room(|_, _| (1.0, 0.0)));
    let taken = |window: &mut Window| -> Vec<u64> {
        window.refinement.begin(&window.keyframes);
        std::iter::from_fn(|| window.next_unrefined()).collect()
    };
    window.refinement.begin(&window.keyframes);
    window.discard_refinement();
    assert_eq!(window.next_unrefined(), None);
    assert_eq!(taken(&mut window), [3, 2, 1, 0]);
    assert!(taken(&mut window).is_empty());
}
