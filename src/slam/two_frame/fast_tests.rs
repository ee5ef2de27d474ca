//! Tests of starts of a camera that moves by a whole baseline from one frame to the next.

use nalgebra::Vector6;

use super::*;
use crate::slam::test_scene::{CAMERA, Scene};
use crate::slam::two_frame::system::{System, compare};

/// The first frames of a camera that moves along the optical axis, with noise of two grey levels.
fn along_the_axis(seed: u64, metres_a_frame: f64, frames: usize) -> Vec<Vec<u8>> {
    let scene = Scene::new(seed);
    let at = |frame: usize| {
        let moved = Vector6::new(0.0, 0.0, metres_a_frame * frame as f64, 0.0, 0.0, 0.0);
        scene.render(&CAMERA, &SE3::exp(&moved)).noisy(2.0, seed * 100 + frame as u64)
    };
    (0..frames).map(at).collect()
}

fn initializer() -> TwoFrameInitializer {
    TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap()
}

#[test]
fn a_fast_camera_starts_on_its_third_frame() {
    for (seed, metres) in (1..=4).flat_map(|seed| [(seed, 0.3), (seed, -0.3), (seed, 0.2)]) {
        let mut initializer = initializer();
        let frames = along_the_axis(seed, metres, 3);
        let outcomes: Vec<_> = frames.iter().map(|frame| initializer.step(frame)).collect();
        let last = outcomes.last().unwrap();
        assert_eq!(last.state, InitState::Proven, "{seed}, {metres} m: {outcomes:?}");
        assert!(initializer.heading.z * metres.signum() > 0.99, "{seed}, {metres} m: {last:?}");
    }
}

#[test]
fn the_previous_frame_replaces_a_first_frame_that_is_out_of_view() {
    let frames = along_the_axis(1, 0.2, 3);
    let mut initializer = initializer();
    initializer.step(&frames[0]);
    let proves = initializer.step(&frames[1]);
    assert_eq!((proves.state, proves.frames), (InitState::Waiting(Waiting::Confirmation), 1));
    // The third frame now shows too little of the first.
    initializer.params.evidence.min_visible_ratio = 0.8;
    let goes_on = initializer.step(&frames[2]);
    assert_eq!((goes_on.state, goes_on.frames), (InitState::Proven, 1), "{goes_on:?}");
    assert_eq!(initializer.first_pixels(), frames[1]);
    assert!(initializer.heading.z > 0.99);
}

#[test]
fn a_previous_frame_with_too_few_points_is_not_a_first_frame() {
    let frames = along_the_axis(1, 0.2, 3);
    let mut initializer = initializer();
    initializer.step(&frames[0]);
    initializer.step(&frames[1]);
    initializer.params.evidence.min_visible_ratio = 0.8;
    initializer.params.min_points = 100_000;
    let outcome = initializer.step(&frames[2]);
    assert_eq!((outcome.state, outcome.frames), (InitState::Failed(Failure::Mismatch), 0));
}

#[test]
fn a_camera_that_returns_continues_from_its_first_frame() {
    let frames = along_the_axis(1, 0.2, 2);
    let mut initializer = initializer();
    for frame in [&frames[0], &frames[1]] {
        initializer.step(frame);
    }
    let back = initializer.step(&frames[0]);
    assert_eq!((back.frames, initializer.confirmed), (2, 0), "{back:?}");
    assert_eq!(initializer.first_pixels(), frames[0]);
}

#[test]
fn the_first_frame_of_a_slow_camera_stays() {
    let frames = along_the_axis(1, 0.03, 3);
    let mut initializer = initializer();
    for frame in &frames[..2] {
        initializer.step(frame);
    }
    initializer.params.evidence.min_visible_ratio = 1.0;
    assert_eq!(initializer.step(&frames[2]).frames, 2);
    assert_eq!(initializer.first_pixels(), frames[0]);
}

#[test]
fn directions_are_tried_in_the_first_frame() {
    let frames = along_the_axis(2, 0.2, 2);
    let mut initializer = initializer();
    initializer.step(&frames[0]);
    initializer.step(&frames[1]);
    let rival = initializer.joint.rival;
    assert!(rival.is_some(), "from rest alone there is but one motion");
}

#[test]
fn motions_are_compared_over_points_that_both_see() {
    let frames = along_the_axis(1, 0.2, 2);
    let mut initializer = initializer();
    initializer.step(&frames[0]);
    initializer.pyramid.fill(&frames[1]);
    let input = input(initializer.pyramid.levels(), &initializer.intrinsics, &initializer.points);
    let evaluate = |turn: f64| {
        let state = State {
            current_from_first: SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, turn, 0.0)),
            ..initializer.rotation.clone()
        };
        let mut system = System::default();
        system.evaluate(&input.level(0), &state);
        system
    };
    let (all, half) = (evaluate(0.0), evaluate(0.6));
    assert!(half.num_visible * 10 < all.num_visible * 8 && half.num_visible > 100);
    let both = all.points().zip(half.points()).filter(|(a, b)| a.visible && b.visible);
    let expected = both.fold([0.0, 0.0], |sum, (a, b)| {
        [sum[0] + f64::from(a.energy), sum[1] + f64::from(b.energy)]
    });
    assert_eq!(compare(&all, &half), expected);
    assert!(expected[0] < all.energy && expected[1] < half.energy);
}

#[test]
fn a_point_behind_the_camera_within_its_noise_does_not_count() {
    let frames = along_the_axis(1, 0.2, 2);
    let mut initializer = initializer();
    for frame in &frames {
        initializer.step(frame);
    }
    let (state, scratch) = initializer.joint.best();
    let negative_ratio = |inverse_depth: f32, std_dev: f32| {
        let num_points = scratch.system.num_points;
        let state = State { inverse_depths: vec![inverse_depth; num_points], ..state.clone() };
        let variances = vec![std_dev * std_dev; num_points];
        judge(&state, &scratch.system, &variances, &scratch.system, &mut Vec::new()).negative_ratio
    };
    assert_eq!(negative_ratio(-0.01, 0.02), 0.0);
    assert_eq!(negative_ratio(-0.1, 0.02), 1.0);
    assert_eq!(negative_ratio(0.1, 0.02), 0.0);
    assert_eq!(negative_ratio(0.1, 0.5), 1.0, "nothing well placed proves nothing");
}

#[test]
fn a_point_in_a_wrong_minimum_behind_the_camera_does_not_count() {
    let frames = along_the_axis(1, 0.2, 2);
    let mut initializer = initializer();
    for frame in &frames {
        initializer.step(frame);
    }
    let (state, scratch) = initializer.joint.best();
    let system = &scratch.system;
    let fit = residual_variance(system, &mut Vec::new());
    let negative_ratio = |is_behind: &dyn Fn(f32) -> bool| {
        let depths =
            system.points().map(|p| if is_behind(p.energy / p.weight) { -1.0 } else { 1.0 });
        let state = State { inverse_depths: depths.collect(), ..state.clone() };
        let variances = vec![0.01; system.num_points];
        judge(&state, system, &variances, system, &mut Vec::new()).negative_ratio
    };
    assert_eq!(negative_ratio(&|energy| energy > fit), 0.0);
    assert!(negative_ratio(&|energy| energy < 0.3 * fit) > 0.1);
}

#[test]
fn a_portrait_image_has_as_many_levels_as_a_landscape_one() {
    let levels = |width, height| num_levels(&Intrinsics::pinhole(width, height, 500.0));
    for (long, short) in [(640, 480), (1226, 370), (320, 240), (1920, 1080)] {
        assert_eq!(levels(long, short), levels(short, long), "{long}×{short}");
    }
    assert!(levels(640, 480) == 4 && levels(64, 64) == 1 && levels(64, 20) == 1);
}
