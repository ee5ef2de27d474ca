//! What the marginals say beside how much estimates of the same room differ with the noise of its images.

use nalgebra::{Matrix4, Vector3, Vector4};

use super::keyframe::WindowKeyframe;
use super::solver::Solver;
use super::tests::{Room, noisy_room};
use super::view::Sight;
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
        let sight = Sight::new(&(to.camera_from_map * from.camera_from_map.inverse()), &CAMERA);
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
                let ray = [(exact.u - CAMERA.cx) / CAMERA.fx, (exact.v - CAMERA.cy) / CAMERA.fy];
                add(ray, found.inverse_depth, exact.inverse_depth);
            }
        }
    }
    (fit.try_inverse().unwrap() * right).fixed_rows::<3>(1).into_owned()
}

#[test]
fn they_say_how_much_noise_moves_the_modes() {
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
