//! Known motions, and rows of a turning camera rendered one by one.

use nalgebra::{UnitQuaternion, Vector3};

use super::*;
use crate::slam::geometry::camera_model::Distortion;
use crate::slam::geometry::rectification::rectified_intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::{NO_DATA, raise_black};
use crate::slam::test_scene::{CAMERA, Scene};

/// Time between two images, seconds.
const PERIOD_S: f64 = 1.0 / 30.0;
/// Time in which all rows are read out.
const READOUT_S: f64 = 0.025;

/// A camera that turns with a constant rate about all axes and moves forwards.
fn pose(time_s: f64) -> SE3 {
    let turn = Vector3::new(0.5, -1.0, 0.8) * time_s;
    let place = Vector3::new(0.0, 0.0, 0.2 * time_s);
    SE3 { rotation: UnitQuaternion::from_scaled_axis(turn), translation: place }
}

/// The view at an instant.
fn global(time_s: f64) -> Vec<u8> {
    Scene::new(1).render(&CAMERA, &pose(time_s)).noisy(0.0, 1)
}

/// What a camera sees whose rows are exposed one after another, the middle one at `time_s`.
fn rolling(time_s: f64) -> Vec<u8> {
    let height = CAMERA.height as f64;
    let offset_s = |v: usize| ((v as f64 + 0.5) / height - 0.5) * READOUT_S;
    Scene::new(1).rolling(&CAMERA, |v| pose(time_s + offset_s(v)))
}

fn shutter(readout_s: f64) -> RollingShutter {
    RollingShutter::new(&CameraModel::undistorted(CAMERA), &CAMERA, readout_s)
}

fn nanos(time_s: f64) -> i64 {
    (time_s * 1e9).round() as i64
}

/// Mean absolute difference of the pixels with data.
fn difference(one: &[u8], other: &[u8]) -> f64 {
    let seen = one.iter().zip(other).filter(|(one, other)| **one.min(other) != NO_DATA);
    let sum = seen.clone().map(|(one, other)| f64::from(one.abs_diff(*other))).sum::<f64>();
    sum / seen.count() as f64
}

fn times(count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(|i| 1.0 + i as f64 * PERIOD_S)
}

#[test]
fn the_image_of_a_turning_camera_is_as_if_exposed_at_once() {
    let mut shutter = shutter(READOUT_S);
    for (index, time_s) in times(3).enumerate() {
        let seen = rolling(time_s);
        let mut undone = seen.clone();
        shutter.undo(nanos(time_s), &mut undone);
        let truth = global(time_s);
        let (before, after) = (difference(&seen, &truth), difference(&undone, &truth));
        match index {
            0 => assert_eq!(seen, undone, "the first image's motion is unknown"),
            _ => assert!(after < 0.2 * before, "image {index}: {before} -> {after}"),
        }
        let without_data = undone.iter().filter(|&&grey| grey == NO_DATA).count();
        assert!(without_data < undone.len() / 30, "{without_data}");
    }
}

#[test]
fn the_first_image_is_undone_if_the_second_is_known() {
    let mut shutter = shutter(READOUT_S);
    let [first, second] = [1.0, 1.0 + PERIOD_S].map(|time_s| (nanos(time_s), rolling(time_s)));
    shutter.look_ahead((first.0, &first.1), (second.0, &second.1));
    assert!(!shutter.has_begun());
    let mut undone = first.1.clone();
    shutter.undo(first.0, &mut undone);
    assert!(shutter.has_begun());
    let truth = global(1.0);
    let (before, after) = (difference(&first.1, &truth), difference(&undone, &truth));
    assert!(after < 0.25 * before, "{before} -> {after}");
    // Later ones are not undone by it.
    let mut blank = vec![128; first.1.len()];
    shutter.undo(second.0, &mut blank);
    assert!(blank.iter().all(|&grey| grey == 128 || grey == NO_DATA));
}

#[test]
fn a_repeated_image_is_undone_as_before() {
    let mut shutter = shutter(READOUT_S);
    let mut results = Vec::new();
    for (index, time_s) in times(3).enumerate() {
        let seen = rolling(time_s);
        for repeat in 0..2 {
            let mut undone = seen.clone();
            shutter.undo(nanos(time_s + f64::from(repeat) * 0.5 * PERIOD_S), &mut undone);
            results.push((index, undone));
        }
    }
    for pair in results.chunks_exact(2) {
        assert!(pair[0].1 == pair[1].1, "image {}", pair[0].0);
    }
    assert!(results[4].1 != rolling(1.0 + 2.0 * PERIOD_S));
}

#[test]
fn after_a_pause_a_burst_of_stamps_and_a_cut_nothing_is_undone() {
    let pauses_s = [MAX_INTERVAL_S + 0.01, -PERIOD_S, 0.5 * MIN_READOUTS * READOUT_S];
    let cases = pauses_s.map(|pause_s| (pause_s, 1)).into_iter().chain([(PERIOD_S, 9)]);
    for (pause_s, seed) in cases {
        let mut shutter = shutter(READOUT_S);
        for time_s in times(2) {
            shutter.undo(nanos(time_s), &mut rolling(time_s));
        }
        let mut next = Scene::new(seed).render(&CAMERA, &pose(1.2)).noisy(2.0, 1);
        if seed == 9 {
            next.reverse();
        }
        let before = next.clone();
        shutter.undo(nanos(1.0 + PERIOD_S + pause_s), &mut next);
        assert!(next == before, "after {pause_s} s, scene {seed}");
    }
}

#[test]
fn a_rate_that_changes_is_extrapolated_to_the_image() {
    let mut shutter = shutter(READOUT_S);
    let rate = |per_second, interval_s| Some(Rate { per_second: [per_second; 4], interval_s });
    // From the middle of 0.04 s to the middle of 0.02 s it grew by 0.3, within 0.03 s; the image is 0.01 s later.
    shutter.rates = [rate(1.3, 0.02), rate(1.0, 0.04)];
    assert!(shutter.motion_per_second().unwrap().iter().all(|value| (value - 1.4).abs() < 1e-12));
    shutter.rates = [rate(1.3, 0.02), None];
    assert_eq!(shutter.motion_per_second(), Some([1.3; 4]));
}

#[test]
fn a_pitch_is_measured_over_the_time_between_exposures() {
    // What moves along the rows' order is exposed later in the second image.
    let rate = 2.0;
    let height = CAMERA.height as f64;
    let seen = |time_s: f64| {
        Scene::new(1).rolling(&CAMERA, |v| {
            let row_s = time_s + ((v as f64 + 0.5) / height - 0.5) * READOUT_S;
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::x() * rate * row_s);
            SE3 { rotation, ..SE3::identity() }
        })
    };
    let mut shutter = shutter(READOUT_S);
    for time_s in [0.0, PERIOD_S] {
        shutter.undo(nanos(time_s), &mut seen(time_s));
    }
    let measured = shutter.rates[0].unwrap().per_second[0];
    assert!((measured + rate).abs() < 0.02 * rate, "{measured}");
}

#[test]
fn a_motion_that_no_camera_makes_is_not_undone() {
    let mut shutter = shutter(READOUT_S);
    let seen = rolling(1.0);
    shutter.undo(nanos(1.0), &mut seen.clone());
    for (per_second, is_undone) in [(0.5, true), (1.1 * MAX_MOTION / READOUT_S, false)] {
        shutter.rates =
            [Some(Rate { per_second: [0.0, per_second, 0.0, 0.0], interval_s: PERIOD_S }), None];
        let mut undone = seen.clone();
        // A repeated image does not change the rate.
        shutter.undo(nanos(1.0), &mut undone);
        assert_eq!(undone != seen, is_undone, "{per_second}");
    }
    // Places that cannot be computed are out of view.
    let rows = RowTimes::new(&CameraModel::undistorted(CAMERA), &CAMERA, READOUT_S);
    for value in [f64::NAN, f64::INFINITY, 1e30, -1e6] {
        for axis in 0..4 {
            let mut motion = ImageMotion::default();
            motion[axis] = value;
            let mut undone = seen.clone();
            rows.resample(&motion, &seen, &mut undone);
            let top = &undone[..CAMERA.width];
            assert!(top.iter().all(|&grey| grey == NO_DATA), "{axis}: {value}");
        }
    }
}

#[test]
fn after_a_restart_nothing_is_known() {
    let mut shutter = shutter(READOUT_S);
    for time_s in times(2) {
        shutter.undo(nanos(time_s), &mut rolling(time_s));
    }
    shutter.restart();
    assert!(!shutter.has_begun());
    // Even the last image again is a first one.
    let seen = rolling(1.0 + PERIOD_S);
    let mut undone = seen.clone();
    shutter.undo(nanos(1.0 + PERIOD_S), &mut undone);
    assert!(undone == seen && shutter.has_begun());
}

#[test]
fn images_without_content_and_of_another_size_are_left_alone() {
    let mut shutter = shutter(READOUT_S);
    for (index, grey) in [0, 1, 128, 255, 0].into_iter().enumerate() {
        let mut pixels = vec![grey; CAMERA.width * CAMERA.height];
        shutter.undo(nanos(index as f64 * PERIOD_S), &mut pixels);
        assert!(pixels.iter().all(|&found| found == grey), "{grey}");
    }
    let mut small = vec![7; 12];
    shutter.undo(0, &mut small);
    assert_eq!(small, [7; 12]);
}

#[test]
fn pixels_beside_hidden_ones_have_no_data() {
    let rows = RowTimes::new(&CameraModel::undistorted(CAMERA), &CAMERA, READOUT_S);
    let mut seen = global(1.0);
    raise_black(&mut seen);
    let hidden = 200 * CAMERA.width + 160;
    seen[hidden] = NO_DATA;
    let mut undone = seen.clone();
    rows.resample(&[0.0, 0.01, 0.0, 0.0], &seen, &mut undone);
    let row = &undone[200 * CAMERA.width + 150..][..20];
    let place = |u: usize| row[u - 150] == NO_DATA;
    assert_eq!((150..170).filter(|&u| place(u)).collect::<Vec<_>>(), [159, 160]);
    // A camera at rest changes nothing.
    seen[hidden] = 99;
    rows.resample(&ImageMotion::default(), &seen, &mut undone);
    assert!(undone == seen);
}

#[test]
fn rows_are_those_of_the_raw_image() {
    let lens = Distortion::try_equidistant(&[0.02, -0.003, 0.0, 0.0]).unwrap();
    let raw = Intrinsics { fx: 120.0, fy: 120.0, ..CAMERA };
    let camera = CameraModel::new(raw, lens).unwrap();
    let rectified = rectified_intrinsics(&camera).unwrap();
    let rows = RowTimes::new(&camera, &rectified, READOUT_S);
    // In the image's corner, where the lens bends rows most, a turn about the vertical moves the image by its rate
    // times the time since the middle of the read-out.
    let (u, v) = (10, 10);
    let ray = rectified.ray(u as f64, v as f64);
    let middle = 0.5 * (raw.height - 1) as f64;
    let raw_row = camera.project(&ray).unwrap().y - middle;
    let bend = raw_row - (v as f64 - middle);
    assert!(bend.abs() > 20.0, "{bend}");
    let rate = 0.1;
    let time_s = raw_row * READOUT_S / raw.height as f64;
    let expected = u as f64 + rectified.fx * rate * time_s * (1.0 + ray.x * ray.x);
    let ramp = |at: usize| (20 + at % CAMERA.width / 2) as u8;
    let seen = (0..CAMERA.width * CAMERA.height).map(ramp).collect::<Vec<_>>();
    let mut undone = seen.clone();
    rows.resample(&[0.0, rate, 0.0, 0.0], &seen, &mut undone);
    let found = 2.0 * (f64::from(undone[v * CAMERA.width + u]) - 20.0);
    assert!((found - expected).abs() < 2.0, "{found}, {expected}");
}
