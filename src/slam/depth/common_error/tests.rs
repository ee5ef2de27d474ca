//! Each response against independent geometry, and the covariances against samples.

use nalgebra::{SVector, Vector2};

use super::*;
use crate::slam::alignment::scene::{Noise, small_camera, small_plane};

/// Relative standard deviation of the depths: the same for all, so that all points have equal weight.
const RELATIVE_STD_DEV: f32 = 0.03;

/// Depth of a plane at every third pixel, with bumps so that relief differs from tilt.
fn depth() -> DepthMap {
    let (plane, camera) = (small_plane(), small_camera());
    let mut map = DepthMap::with_size(camera.width, camera.height);
    let pixels = plane.render(&camera, &SE3::identity(), 0.0, (1.0, 0.0), 1);
    map.restart(&pixels, 0.5, usize::MAX);
    for v in 4..camera.height - 4 {
        for u in (4..camera.width - 4).step_by(3) {
            let exact = plane.inverse_depth(&camera, &SE3::identity(), u as f64, v as f64);
            let d =
                (exact * (1.0 + 0.3 * (u as f64 / 30.0).sin() * (v as f64 / 25.0).cos())) as f32;
            map.hypotheses.pixels_mut()[v * camera.width + u] = Hypothesis {
                inverse_depth: d,
                smoothed: d,
                variance: (RELATIVE_STD_DEV * d).powi(2),
                validity: 9,
                ..Hypothesis::NONE
            };
        }
    }
    map
}

fn samples(map: &DepthMap) -> SampledDepth {
    let mut samples = SampledDepth::default();
    samples.take(map, &small_camera());
    assert!(samples.samples.len() > 500);
    samples
}

fn twist(seed: u64, size: f64) -> Vector6<f64> {
    let mut noise = Noise(seed);
    Vector6::from_fn(|_, _| size * noise.uniform())
}

/// Far enough that every gradient along the line determines a depth.
fn pose() -> SE3 {
    SE3::exp(&Vector6::new(0.25, -0.1, 0.15, 0.03, -0.06, 0.05))
}

/// The modes of relative errors at (x, y, ln d), with equal weight for every point.
fn fitted(errors: &[(Vector3<f64>, f64)]) -> Vector3<f64> {
    let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
    for (place, error) in errors {
        let phi = Vector4::new(1.0, place.x, place.y, place.z);
        normal += phi * phi.transpose();
        right += *error * phi;
    }
    normal.cholesky().unwrap().solve(&right).fixed_rows::<3>(1).into_owned()
}

fn assert_close(name: &str, found: &Vector3<f64>, expected: &Vector3<f64>) {
    let off = (found - expected).norm() / expected.norm();
    assert!(off < 0.03, "{name}: {found} for {expected}");
}

#[test]
fn modes_on_the_next_keyframe_match_its_true_errors() {
    let (map, camera, truth) = (depth(), small_camera(), pose());
    let samples = samples(&map);
    let response = samples.response_to_propagation(&truth, &camera).unwrap();
    for seed in 0..6 {
        let m = 1e-4 * twist(seed, 1.0).fixed_rows::<3>(0);
        let xi = twist(seed + 50, 1e-4);
        let estimated = SE3::exp(&xi) * truth;
        let errors = samples.samples.iter().filter_map(|sample| {
            let d = f64::from(sample.before.smoothed);
            let place = Vector3::new(sample.ray.x, sample.ray.y, d.ln());
            let with_error = d * (1.0 + place.dot(&m));
            let (true_point, found) =
                (truth * (sample.ray / d), estimated * (sample.ray / with_error));
            let (x, y) = (true_point.x / true_point.z, true_point.y / true_point.z);
            // Inverse depths: a point too near has too large a value.
            let error = true_point.z / found.z - 1.0;
            is_inside(x, y, &camera).then(|| (Vector3::new(x, y, -true_point.z.ln()), error))
        });
        let measured = fitted(&errors.collect::<Vec<_>>());
        assert_close("carried", &(response.on_modes * m + response.on_pose * xi), &measured);
    }
}

#[test]
fn depth_matched_at_a_wrong_pose_errs_by_what_cancels_the_residual() {
    let (map, truth) = (depth(), pose());
    let samples = samples(&map);
    // Every match is adopted fully.
    let mut after = map.clone();
    for hypothesis in after.hypotheses.pixels_mut().iter_mut().filter(|h| h.is_some()) {
        hypothesis.inverse_depth *= 1.001;
        hypothesis.variance = 0.0;
    }
    let response = samples.response_to_observation(&after, &truth).unwrap();
    // Points without gradient along their line keep their old error.
    assert!(response.on_modes.norm() < 0.3, "{}", response.on_modes);
    let by_pose = samples.modes_by_pose(&truth).unwrap();
    for seed in 0..6 {
        let xi = twist(seed, 1e-4);
        let estimated = SE3::exp(&xi) * truth;
        let errors = samples.samples.iter().filter_map(|sample| {
            let terms = sample.terms(&truth).filter(|terms| terms.is_observable)?;
            let gradient =
                truth.rotation * Vector3::new(sample.gradient[0], sample.gradient[1], 0.0);
            let along_gradient = |pose: &SE3, d: f64| {
                let point = pose.rotation * sample.ray + pose.translation * d;
                gradient.xy().dot(&Vector2::new(point.x / point.z, point.y / point.z))
            };
            let d = f64::from(sample.before.smoothed);
            let seen = along_gradient(&truth, d);
            // The depth at which the wrong pose shows the same brightness.
            let slope =
                (along_gradient(&estimated, d * 1.001) - along_gradient(&estimated, d)) / 0.001;
            let error = (seen - along_gradient(&estimated, d)) / slope;
            Some((terms.phi.fixed_rows::<3>(1).into_owned(), error))
        });
        let measured = fitted(&errors.collect::<Vec<_>>());
        assert_close("begun", &(by_pose * xi), &measured);
    }
}

#[test]
fn a_frame_without_observations_gives_no_response() {
    let map = depth();
    assert_eq!(samples(&map).response_to_observation(&map, &pose()), None);
}

#[test]
fn a_change_of_unit_does_not_affect_the_modes() {
    let (map, camera) = (depth(), small_camera());
    let in_other_unit = {
        let mut map = map.clone();
        map.rescale(2.0);
        map
    };
    let mut shorter = pose();
    shorter.translation *= 0.5;
    let (one, other) = (samples(&map), samples(&in_other_unit));
    // An error of the unit is carried over as an error of the unit if the pose follows it.
    let whole = |samples: &SampledDepth, pose: &SE3| {
        let carried = samples.response_to_propagation(pose, &camera).unwrap();
        carried.on_modes + carried.on_pose * samples.d_pose_d_modes(pose).unwrap()
    };
    let (of_one, of_other) = (whole(&one, &pose()), whole(&other, &shorter));
    assert!((of_one - of_other).norm() < 1e-3, "{of_one} {of_other}");
    let mut grown = one.clone();
    grown.rescale(2.0);
    assert!((whole(&grown, &shorter) - of_other).norm() < 1e-6);
}

#[test]
fn covariances_match_samples() {
    let (map, camera, truth) = (depth(), small_camera(), pose());
    let samples = samples(&map);
    let mut after = map.clone();
    for hypothesis in after.hypotheses.pixels_mut().iter_mut().filter(|h| h.is_some()) {
        hypothesis.inverse_depth *= 1.001;
        hypothesis.variance *= 0.5;
    }
    let follows = samples.d_pose_d_modes(&truth).unwrap();
    let observed = samples.response_to_observation(&after, &truth).unwrap();
    let carried = samples.response_to_propagation(&truth, &camera).unwrap();
    let root = Matrix3::new(0.1, 0.0, 0.0, 0.03, 0.05, 0.0, -0.02, 0.04, 0.2);
    let std_devs: SVector<f64, 6> = Vector6::new(1e-3, 2e-3, 3e-3, 1e-3, 2e-3, 1e-3);
    let modes = root * root.transpose();
    let noise = Matrix6::from_diagonal(&std_devs.map(|s| s * s));
    let joint = JointCovariance::of_aligned(&modes, &follows, &noise).after(&observed);
    let predicted = joint.after(&carried).modes;
    let (mut random, mut sum) = (Noise(4), Matrix3::zeros());
    const DRAWS: usize = 20_000;
    for _ in 0..DRAWS {
        let m = root * Vector3::from_fn(|_, _| random.normal());
        let xi = follows * m + std_devs.map(|s| s * random.normal());
        let m = observed.on_modes * m + observed.on_pose * xi;
        let m = carried.on_modes * m + carried.on_pose * xi;
        sum += m * m.transpose();
    }
    let measured = sum / DRAWS as f64;
    let off = (predicted - measured).norm() / measured.norm();
    assert!(off < 0.03, "{predicted} {measured}");
    assert!(predicted.symmetric_eigenvalues().min() > 0.0);
}

#[test]
fn the_adopted_share_of_a_match_is_its_weight_in_the_fusion() {
    let before = Hypothesis {
        inverse_depth: 0.52,
        smoothed: 0.5,
        variance: 4e-4,
        validity: 9,
        ..Hypothesis::NONE
    };
    // A match of longer baseline takes over, while the variance falls by a quarter alone: most of it is common.
    let (found, weight) = (0.54, 0.9);
    let after = Hypothesis {
        inverse_depth: before.inverse_depth + weight * (found - before.inverse_depth),
        smoothed: before.smoothed + weight * (found - before.smoothed),
        variance: 3e-4,
        ..before
    };
    assert!((gain(&before, &after) - f64::from(weight)).abs() < 1e-4);
    // Without a difference to tell it by, the reduction in variance is the least that was adopted.
    let unsmoothed =
        |hypothesis: Hypothesis| Hypothesis { smoothed: hypothesis.inverse_depth, ..hypothesis };
    assert!((gain(&unsmoothed(before), &unsmoothed(after)) - 0.25).abs() < 1e-6);
    assert_eq!(gain(&before, &before), 0.0);
    assert_eq!(gain(&before, &Hypothesis::NONE), 0.0);
}
