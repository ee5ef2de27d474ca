//! Tests of starts with a brightness that changes, with the exposure or over the image.

use nalgebra::Vector6;

use super::tests::two_views;
use super::*;
use crate::slam::test_scene::{CAMERA, Scene};

#[test]
fn a_change_of_brightness_is_not_parallax_and_is_estimated() {
    let (first, second, _) = two_views(2.0);
    let brighter = |pixels: &[u8]| -> Vec<u8> {
        pixels.iter().map(|&p| (1.2 * (f32::from(p) - 128.0) + 138.0) as u8).collect()
    };
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&first));
    for frame in 0..4 {
        let standing = Scene::new(5).render(&CAMERA, &SE3::identity()).noisy(2.0, 10 + frame);
        let outcome = initializer.step(&brighter(&standing));
        assert_eq!(outcome.state, InitState::Waiting(Waiting::Significance));
        assert!((outcome.brightness.a.exp() - 1.2).abs() < 0.1, "{:?}", outcome.brightness);
    }
    assert!(initializer.begin(&first));
    let moved = initializer.step(&brighter(&second));
    assert_eq!(moved.state, InitState::Waiting(Waiting::Confirmation));
}

/// An image behind a lens that loses half of the light in the corners.
fn with_vignette(pixels: &[u8]) -> Vec<u8> {
    let (middle_u, middle_v) = (CAMERA.width as f32 / 2.0, CAMERA.height as f32 / 2.0);
    let squared_corner = middle_u.powi(2) + middle_v.powi(2);
    let light = |place: usize| {
        let (u, v) = ((place % CAMERA.width) as f32, (place / CAMERA.width) as f32);
        1.0 - 0.5 * ((u - middle_u).powi(2) + (v - middle_v).powi(2)) / squared_corner
    };
    pixels.iter().enumerate().map(|(i, &grey)| (f32::from(grey) * light(i)) as u8).collect()
}

/// The start after four frames of a camera that rotates by 9 px and moves by so many metres per frame.
fn turning(metres: f64, has_vignette: bool) -> (TwoFrameInitializer, InitOutcome) {
    let scene = Scene::new(5);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    let outcomes = (0..4).map(|frame| {
        let step = f64::from(frame);
        let moved = Vector6::new(metres * step, 0.0, 0.0, 0.02 * step, 0.03 * step, 0.0);
        let pixels = scene.render(&CAMERA, &SE3::exp(&moved)).noisy(1.0, 10 + frame as u64);
        initializer.step(&if has_vignette { with_vignette(&pixels) } else { pixels })
    });
    let last = outcomes.last().unwrap();
    (initializer, last)
}

#[test]
fn a_vignette_is_not_parallax_and_leaves_the_start_unchanged() {
    let [(_, standing), (_, bare)] = [true, false].map(|vignette| turning(0.0, vignette));
    assert_eq!(standing.state, InitState::Waiting(Waiting::Significance), "{standing:?}");
    assert!(standing.evidence.median_residual < 1.1 * bare.evidence.median_residual);
    let [(_, moving), (_, bare)] = [true, false].map(|vignette| turning(0.03, vignette));
    assert_eq!(moving.state, InitState::Proven, "{moving:?}");
    assert!(moving.evidence.median_residual < 1.1 * bare.evidence.median_residual);
    let off =
        |outcome: &InitOutcome| outcome.first_from_current.translation.normalize() - Vector3::x();
    assert!(off(&moving).norm() < 0.06, "{moving:?} {bare:?}");
}

#[test]
fn the_gain_varies_over_the_image_only_where_it_must() {
    for metres in [0.0, 0.03] {
        let [behind_a_lens, even] = [true, false].map(|vignette| {
            let (mut initializer, _) = turning(metres, vignette);
            [initializer.rotation.gain_slopes, initializer.joint.best().0.gain_slopes]
        });
        assert!(behind_a_lens.iter().all(Option::is_some), "{metres}: {behind_a_lens:?}");
        assert!(even.iter().all(Option::is_none), "{metres}: {even:?}");
    }
    // Freed here, after what the previous frames have left.
    let (mut initializer, _) = turning(0.03, false);
    initializer.free_slopes();
    assert!(initializer.joint.best().0.gain_slopes.is_some());
    // A later start is independent of it.
    let (mut initializer, _) = turning(0.0, true);
    assert!(initializer.begin(&two_views(2.0).0));
    assert!(initializer.rotation.gain_slopes.is_none());
}

#[test]
fn querying_the_effect_of_slopes_changes_nothing() {
    let (mut initializer, _) = turning(0.03, false);
    initializer.fit_jointly();
    let fitted = initializer.joint.best().1.system.clone();
    assert!(!initializer.needs_slopes());
    let (_, scratch) = initializer.joint.best();
    assert_eq!(scratch.system.hessian, fitted.hessian);
    assert_eq!(scratch.system.gradient, fitted.gradient);
}

#[test]
fn frames_before_slopes_were_freed_are_scored_with_them() {
    let scene = Scene::new(5);
    let seen = |frame: f64| {
        let pose = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.02 * frame, 0.03 * frame, 0.0));
        with_vignette(&scene.render(&CAMERA, &pose).noisy(1.0, 10))
    };
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&seen(0.0)));
    for frame in [1.0, 2.0, 3.0] {
        initializer.pyramid.fill(&seen(frame));
        initializer.fit_rotation();
    }
    initializer.earlier_frames.push(initializer.pyramid.levels(), &initializer.rotation, 8);
    let depths = initializer.rotation.inverse_depths.clone();
    let energy = |initializer: &TwoFrameInitializer| {
        let input =
            input(initializer.pyramid.levels(), &initializer.intrinsics, &initializer.points);
        let fit = &initializer.params.fit;
        initializer.earlier_frames.compare(&input, [&depths, &depths], fit)[0]
    };
    let held = energy(&initializer);
    initializer.free_slopes();
    let free = energy(&initializer);
    assert!(free < 0.9 * held, "{free} {held}");
}

#[test]
fn a_uniform_image_does_not_match() {
    let (first, _, _) = two_views(2.0);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    for grey in [0u8, 90, 200] {
        let even: Vec<u8> = first.iter().map(|&seen| grey + seen / 50).collect();
        assert!(initializer.begin(&first));
        let outcome = initializer.step(&even);
        assert_eq!(outcome.state, InitState::Waiting(Waiting::Match), "{grey}: {outcome:?}");
    }
}
