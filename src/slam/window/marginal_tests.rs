//! Compares the marginals with the scatter of estimates of the same room under the noise of its images.

use nalgebra::{Matrix3, Matrix4, SVector, Vector3, Vector4};

use super::Window;
use super::keyframe::WindowKeyframe;
use super::members::Chosen;
use super::params::WindowParams;
use super::place_marginals::KeyframePoseMarginal;
use super::solver::Solver;
use super::system::Members;
use super::tests::{Room, noisy_room};
use super::unit::Unit;
use super::view::ObserverView;
use crate::slam::keyframe_pose_covariance::KEYFRAME_POSE_ERRORS;
use crate::slam::mapper::modes::ModeParams;
use crate::slam::test_scene::CAMERA;

/// Modes of the error of a keyframe's depth: over its own points, or over those of the others as it sees them.
fn modes_of(room: &Room, truth: &Room, keyframe: usize) -> Vector3<f64> {
    let (mut fit, mut right) = (Matrix4::zeros(), Vector4::zeros());
    let mut add = |ray: [f64; 2], found: f64, exact: f64| {
        let error = (found / exact).ln();
        if error.abs() < 0.2 {
            let phi = Vector4::new(1.0, ray[0], ray[1], exact.ln());
            fit += phi * phi.transpose();
            right += error * phi;
        }
    };
    let seen = |room: &Room, host: usize| {
        let [to, from]: [&WindowKeyframe; 2] = [keyframe, host].map(|k| &room.keyframes[k]);
        let sight =
            ObserverView::new(&(to.camera_from_map * from.camera_from_map.inverse()), &CAMERA);
        from.points.iter().map(|point| sight.project(point)).collect::<Vec<_>>()
    };
    if room.keyframes[keyframe].is_host {
        let of = |room: &Room| room.keyframes[keyframe].points.clone();
        for (found, exact) in of(room).iter().zip(of(truth)) {
            add(exact.ray.map(f64::from), found.inverse_depth, exact.inverse_depth);
        }
    } else {
        for host in (0..room.keyframes.len()).filter(|&host| host != keyframe) {
            for (found, exact) in seen(room, host).into_iter().zip(seen(truth, host)) {
                let (Some(found), Some(exact)) = (found, exact) else { continue };
                let ray = CAMERA.ray(exact.u, exact.v).xy();
                add(ray.into(), found.inverse_depth, exact.inverse_depth);
            }
        }
    }
    (fit.try_inverse().unwrap() * right).fixed_rows::<3>(1).into_owned()
}

#[test]
fn marginals_match_the_scatter_of_the_modes_under_noise() {
    const TIMES: u64 = 16;
    // The last keyframe has no points yet, as the active one.
    let mut squares = [[Vector3::zeros(); 2]; 2];
    let mut off = [Vector3::zeros(); 2];
    for seed in 0..TIMES {
        let mut truth = noisy_room(|_, _| (1.0, 0.0), seed);
        truth.keyframes[3].points.clear();
        truth.keyframes[3].is_host = false;
        let mut room = truth.clone();
        let (_, marginals) = room.solve_with(&mut Solver::default());
        assert_eq!(marginals.len(), 3);
        for (which, keyframe) in [2, 3].into_iter().enumerate() {
            let error = modes_of(&room, &truth, keyframe);
            off[which] += error / TIMES as f64;
            squares[which][0] += error.component_mul(&error);
            let marginal = marginals.iter().find(|of| of.keyframe_id == keyframe as u64).unwrap();
            squares[which][1] += marginal.modes.diagonal();
        }
    }
    for ([errors, said], off) in squares.into_iter().zip(off) {
        let scatter = errors / TIMES as f64 - off.component_mul(&off);
        let said = said / TIMES as f64;
        for mode in 0..3 {
            let ratio = (scatter[mode] / said[mode]).sqrt();
            assert!((0.6..1.5).contains(&ratio), "{mode}: {ratio} of {}", said[mode].sqrt());
        }
        assert!(said.max().sqrt() < 0.01, "{said}");
    }
}

/// Errors of a keyframe's place: the left increment of its pose, and the logarithm of the unit of its own depth.
fn place_errors(room: &Room, truth: &Room, keyframe: usize) -> SVector<f64, KEYFRAME_POSE_ERRORS> {
    let [found, exact] = [room, truth].map(|room| &room.keyframes[keyframe]);
    let pose = (found.camera_from_map.inverse() * exact.camera_from_map).log();
    let (mut fit, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (found, exact) in found.points.iter().zip(&exact.points) {
        let error = (found.inverse_depth / exact.inverse_depth).ln();
        if error.abs() < 0.2 {
            let phi = Vector3::new(1.0, f64::from(exact.ray[0]), f64::from(exact.ray[1]));
            fit += phi * phi.transpose();
            right += error * phi;
        }
    }
    let mut errors = SVector::<f64, KEYFRAME_POSE_ERRORS>::zeros();
    errors.fixed_rows_mut::<6>(0).copy_from(&pose);
    errors[6] = -(fit.try_inverse().unwrap() * right)[0];
    errors
}

/// Ratios of the scatter under noise of the place of the last keyframe but one to its marginal's standard deviations,
/// where the keyframes `held` hold the window.
fn place_ratios(held: &[usize]) -> SVector<f64, KEYFRAME_POSE_ERRORS> {
    const TIMES: u64 = 24;
    let [mut sum, mut squares, mut said] = [SVector::<f64, KEYFRAME_POSE_ERRORS>::zeros(); 3];
    for seed in 0..TIMES {
        let mut truth = noisy_room(|_, _| (1.0, 0.0), seed);
        truth.held = held.to_vec();
        let mut room = truth.clone();
        let (_, mut marginals) = room.solve_with(&mut Solver::default());
        let members: Vec<usize> = (0..room.keyframes.len()).collect();
        let free: Vec<_> = members.iter().map(|k| (!held.contains(k)).then_some(0)).collect();
        let members = Members { members: &members, free: &free, depths_are_free: true };
        if let Some(unit) = Unit::of(&truth.keyframes, &members) {
            let by = unit.restore(&mut room.keyframes, members.members).unwrap();
            let places = marginals.iter_mut().filter_map(|of| of.place.as_mut());
            places.for_each(|place| place.transport(&by));
        }
        let errors = place_errors(&room, &truth, 2);
        sum += errors;
        squares += errors.component_mul(&errors);
        let marginal = marginals.iter().find(|of| of.keyframe_id == 2).unwrap();
        said += marginal.place.unwrap().noise.diagonal();
    }
    let times = TIMES as f64;
    let scatter = squares / times - (sum / times).component_mul(&(sum / times));
    let inflation = ModeParams::default().estimate_inflation;
    scatter.component_div(&(said * inflation / times)).map(f64::sqrt)
}

#[test]
fn marginals_match_the_scatter_of_places_and_units_under_noise() {
    for held in [&[0][..], &[0, 1]] {
        let ratios = place_ratios(held);
        assert!(ratios.iter().all(|ratio| (0.4..1.3).contains(ratio)), "{held:?}{ratios}");
    }
}

#[test]
fn uncertainties_of_places_are_relative_to_the_unit_that_is_kept() {
    // The depths of the keyframe that holds the window are shorter than all others imply.
    let mut room = noisy_room(|_, _| (1.0, 0.0), 1);
    room.keyframes[0].points.iter_mut().for_each(|point| point.inverse_depth *= 1.2);
    let mut window = Window::new(CAMERA, WindowParams::default());
    window.keyframes = room.keyframes;
    // Estimated again, everything stays in the unit that it starts with.
    let [(first, shorter), (second, same)] = [(); 2].map(|()| {
        let before = window.keyframes[3].camera_from_map.translation.norm();
        window.adjust(&Chosen::new(Vec::new(), &[0, 1, 2, 3], true, true)).unwrap();
        let places = [1, 2, 3].map(|id| window.marginal_of(id).unwrap().place.unwrap());
        let after = window.keyframes[3].camera_from_map.translation.norm();
        (places, after / before)
    });
    assert!(shorter < 0.9 && (same - 1.0).abs() < 0.02, "{shorter} {same}");
    for (first, second) in first.iter().zip(&second) {
        for of in [
            |place: &KeyframePoseMarginal| place.noise,
            |place: &KeyframePoseMarginal| place.of_displaced,
        ] {
            let positions = |place| of(place).fixed_view::<3, 3>(0, 0).trace();
            let ratio = positions(first) / positions(second);
            assert!((0.9..1.1).contains(&ratio), "{ratio}");
        }
    }
}

#[test]
fn keyframes_that_hold_others_share_by_their_comparisons() {
    let mut room = noisy_room(|_, _| (1.0, 0.0), 1);
    room.held = vec![0, 1];
    // Half of the points of one of them are gone.
    let half = room.keyframes[0].points.len() / 2;
    room.keyframes[0].points.truncate(half);
    let (_, marginals) = room.solve_with(&mut Solver::default());
    assert_eq!(marginals.len(), 2);
    for of in &marginals {
        let [first, second] = &of.held_by[..] else { panic!("{of:?}") };
        assert_eq!([first.keyframe_id, second.keyframe_id], [0, 1]);
        assert!((first.share + second.share - 1.0).abs() < 1e-12, "{of:?}");
        assert!((0.15..0.48).contains(&first.share), "{of:?}");
    }
}
