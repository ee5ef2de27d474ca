//! Tests of the two-frame start in an analytic room: what must start does, what must not does not.

use nalgebra::Vector6;

use super::*;
use crate::slam::image::buffer::Image;
use crate::slam::test_scene::{CAMERA, Random, Scene};

/// Motion of the camera per frame.
#[derive(Debug, Clone, Copy)]
enum Motion {
    Sideways,
    Forward,
    Mixed,
    Turning,
    Standing,
}

/// The twist of one frame: 6 mm and up to 0.3°, with directions from the seed.
fn twist(motion: Motion, seed: u64) -> Vector6<f64> {
    let mut random = Random::new(seed);
    let angle = std::f64::consts::TAU * random.uniform();
    let (c, s) = (angle.cos(), angle.sin());
    let mut turn = || 0.003 * random.normal();
    match motion {
        Motion::Sideways => Vector6::new(0.006 * c, 0.006 * s, 0.0, turn(), turn(), turn()),
        Motion::Forward => Vector6::new(0.001 * c, 0.0, 0.012, turn(), turn(), turn()),
        Motion::Mixed => Vector6::new(0.006 * c, 0.003 * s, 0.005, turn(), turn(), turn()),
        Motion::Turning => Vector6::new(0.0, 0.0, 0.0, turn(), turn(), turn()),
        Motion::Standing => Vector6::zeros(),
    }
}

fn pose(motion: Motion, seed: u64, frame: usize) -> SE3 {
    SE3::exp(&(twist(motion, seed) * frame as f64))
}

struct Started {
    /// Whether the translation was shorter than an unconfirmed start needs.
    is_early: bool,
    direction_error_deg: f64,
    median_depth_error: f64,
    within_two_sigmas: f64,
    /// Slope of ln(d / d_true) over ln d_true: −0.3 is a scene flattened by 30 %.
    relief: f64,
}

/// Runs up to `frames` frames; returns the figures of the first proof, and all outcomes.
fn run(
    motion: Motion,
    seed: u64,
    noise: f64,
    frames: usize,
) -> (Option<Started>, Vec<InitOutcome>) {
    let scene = Scene::new(seed);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    let mut first = (0, scene.render(&CAMERA, &SE3::identity()));
    let still = first.1.noisy(0.0, 0);
    let mut outcomes = Vec::new();
    assert!(initializer.begin(&first.1.noisy(noise, seed)));
    for frame in 1..=frames {
        let pixels = if matches!(motion, Motion::Standing) && noise == 0.0 {
            still.clone()
        } else if matches!(motion, Motion::Standing) {
            first.1.noisy(noise, seed * 1000 + frame as u64)
        } else {
            let rendering = scene.render(&CAMERA, &pose(motion, seed, frame));
            rendering.noisy(noise, seed * 1000 + frame as u64)
        };
        let outcome = initializer.step(&pixels);
        outcomes.push(outcome);
        match outcome.state {
            InitState::Proven => {
                let from_first = pose(motion, seed, first.0).inverse();
                let true_pose = from_first * pose(motion, seed, frame);
                let started = figures(&initializer, &outcome, &true_pose, &first.1.inverse_depth);
                return (Some(started), outcomes);
            }
            InitState::Failed(_) if !matches!(motion, Motion::Standing) => {
                first = (frame, scene.render(&CAMERA, &pose(motion, seed, frame)));
            }
            _ => {}
        }
    }
    (None, outcomes)
}

fn figures(
    initializer: &TwoFrameInitializer,
    outcome: &InitOutcome,
    true_pose: &SE3,
    truth: &Image<f32>,
) -> Started {
    let (found, exact) = (outcome.first_from_current.translation, true_pose.translation);
    let cosine = found.dot(&exact) / (found.norm() * exact.norm());
    let mut ratios: Vec<f64> = initializer
        .depths()
        .map(|d| f64::from(truth.at(usize::from(d.u), usize::from(d.v)) / d.inverse_depth))
        .collect();
    ratios.sort_by(f64::total_cmp);
    let scale = ratios[ratios.len() / 2];
    let within = initializer.depths().filter(|d| {
        let truth = f64::from(truth.at(usize::from(d.u), usize::from(d.v))) / scale;
        (f64::from(d.inverse_depth) - truth).abs() < 2.0 * f64::from(d.variance).sqrt()
    });
    let within_two_sigmas = within.count() as f64 / ratios.len() as f64;
    let relief = relief(initializer, truth, scale);
    let mut errors: Vec<f64> = ratios.iter().map(|r| (r / scale - 1.0).abs()).collect();
    errors.sort_by(f64::total_cmp);
    Started {
        is_early: outcome.evidence.translation < EvidenceParams::default().min_translation,
        direction_error_deg: cosine.clamp(-1.0, 1.0).acos().to_degrees(),
        median_depth_error: errors[errors.len() / 2],
        within_two_sigmas,
        relief,
    }
}

fn relief(initializer: &TwoFrameInitializer, truth: &Image<f32>, scale: f64) -> f64 {
    let logs: Vec<(f64, f64)> = initializer
        .depths()
        .map(|d| {
            let truth = f64::from(truth.at(usize::from(d.u), usize::from(d.v)));
            (truth.ln(), (f64::from(d.inverse_depth) * scale / truth).ln())
        })
        // Points on an edge between two surfaces belong to either.
        .filter(|(_, error)| error.abs() < 0.5)
        .collect();
    let mean = |of: fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / logs.len() as f64;
    let (mean_x, mean_y) = (mean(|log| log.0), mean(|log| log.1));
    let sums = logs.iter().fold((0.0, 0.0), |(xy, xx), (x, y)| {
        (xy + (x - mean_x) * (y - mean_y), xx + (x - mean_x).powi(2))
    });
    sums.0 / sums.1
}

/// Checks the starts of a motion in four rooms: their results, and that the scene is not flattened.
fn assert_starts(motion: Motion) {
    let mut reliefs = Vec::new();
    for seed in 1..=4 {
        let (started, outcomes) = run(motion, seed, 2.0, 40);
        let started = started.unwrap_or_else(|| panic!("{motion:?} {seed}: {:?}", outcomes.last()));
        reliefs.push(started.relief);
        assert!(
            started.median_depth_error <= 0.1,
            "{motion:?} {seed}: {}",
            started.median_depth_error
        );
        // With 2 px of parallax and 0.2 px of noise the direction is accurate to a tenth of a radian.
        let direction_deg = if started.is_early { 12.0 } else { 5.0 };
        assert!(
            started.direction_error_deg <= direction_deg,
            "{motion:?} {seed}: {}",
            started.direction_error_deg
        );
        // Variances are right within a factor of two of the standard deviation.
        assert!(
            started.within_two_sigmas >= 0.65,
            "{motion:?} {seed}: {}",
            started.within_two_sigmas
        );
    }
    let mean = reliefs.iter().sum::<f64>() / reliefs.len() as f64;
    assert!(mean.abs() < 0.1, "{motion:?}: {mean} of {reliefs:?}");
}

#[test]
fn sideways_motion_starts() {
    assert_starts(Motion::Sideways);
}

#[test]
fn forward_motion_starts() {
    assert_starts(Motion::Forward);
}

#[test]
fn mixed_motion_starts() {
    assert_starts(Motion::Mixed);
}

#[test]
fn a_stationary_camera_never_starts_whatever_the_noise() {
    for (seed, noise) in [(1, 0.0), (2, 2.0), (3, 4.0)] {
        let (started, _) = run(Motion::Standing, seed, noise, 200);
        assert!(started.is_none(), "noise {noise}");
    }
}

/// Three more are in the simulator: `tests/estimation/two_frame_start.rs`.
#[test]
fn a_rotating_camera_never_starts() {
    for seed in 1..=2 {
        let (started, _) = run(Motion::Turning, seed, 2.0, 60);
        assert!(started.is_none(), "seed {seed}");
    }
}

/// The room from two positions, 6 cm apart and slightly rotated.
pub(super) fn two_views(noise: f64) -> (Vec<u8>, Vec<u8>, SE3) {
    let scene = Scene::new(5);
    let moved = SE3::exp(&Vector6::new(0.06, 0.01, 0.02, 0.004, -0.006, 0.002));
    let first = scene.render(&CAMERA, &SE3::identity()).noisy(noise, 1);
    (first, scene.render(&CAMERA, &moved).noisy(noise, 2), moved)
}

#[test]
fn derivatives_match_those_of_the_residuals() {
    use crate::slam::two_frame::lanes::{FIRST_SLOPE, NUM_UNKNOWNS};
    use crate::slam::two_frame::system::System;
    let (first, second, moved) = two_views(0.0);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&first));
    initializer.pyramid.fill(&second);
    let (images, intrinsics) = (initializer.pyramid.levels(), &initializer.intrinsics);
    let input = input(images, intrinsics, &initializer.points);
    // The finest level: central differences are the slope where the image is smooth.
    let view = input.level(0);
    let energy = |state: &State| {
        let mut system = System::default();
        system.evaluate(&view, state);
        system
    };
    let state = State {
        current_from_first: moved.inverse(),
        brightness: Brightness { a: 0.02, b: -1.0 },
        gain_slopes: Some([0.03, -0.02]),
        inverse_depths: vec![0.4; initializer.points.pixels.len()],
    };
    let at = energy(&state);
    for unknown in 0..NUM_UNKNOWNS {
        let step = if unknown == 7 { 0.05 } else { 5e-4 };
        let shifted = |sign: f64| {
            let mut twist = Vector6::zeros();
            let mut state = state.clone();
            match unknown {
                6 => state.brightness.a += sign * step,
                7 => state.brightness.b += sign * step,
                FIRST_SLOPE.. => {
                    state.gain_slopes.as_mut().unwrap()[unknown - FIRST_SLOPE] += sign * step;
                }
                _ => twist[unknown] = sign * step,
            }
            state.current_from_first = SE3::exp(&twist) * state.current_from_first;
            energy(&state).energy
        };
        let slope = (shifted(1.0) - shifted(-1.0)) / (2.0 * step);
        let expected = 2.0 * at.gradient[unknown];
        let scale = (at.hessian[(unknown, unknown)] * at.energy).sqrt();
        assert!((slope - expected).abs() < 0.05 * scale, "{unknown}: {slope} {expected} {scale}");
        // Not vacuous: the slope is far from zero for the rotation and the brightness.
        assert!(unknown != 7 || expected.abs() > 0.05 * scale);
    }
    let shifted = |change: f32| {
        let depths = state.inverse_depths.iter().map(|d| d + change).collect();
        energy(&State { inverse_depths: depths, ..state.clone() })
    };
    let points = |change: f32| shifted(change).points().collect::<Vec<_>>();
    let (less, more) = (points(-0.02), points(0.02));
    let (mut agree, mut all) = (0, 0);
    for (i, point) in at.points().enumerate().filter(|(_, p)| p.visible) {
        let slope = (more[i].energy - less[i].energy) / 0.04;
        let scale = (point.information * point.energy.max(1.0)).sqrt();
        all += 1;
        agree += usize::from((slope - 2.0 * point.gradient).abs() < 0.3 * scale);
    }
    assert!(agree * 10 >= all * 9 && all > 500, "{agree} of {all}");
}

#[test]
fn earlier_frames_distinguish_true_depths_from_those_of_another_motion() {
    let scene = Scene::new(5);
    let first = scene.render(&CAMERA, &SE3::identity());
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&first.noisy(2.0, 1)));
    // A path that bends: depths that fit only one of its steps do not fit the others.
    for (frame, twist) in
        [[0.03, 0.0, 0.0], [0.02, 0.03, 0.0], [0.0, 0.02, 0.03]].iter().enumerate()
    {
        let [x, y, z] = *twist;
        let moved = SE3::exp(&Vector6::new(x, y, z, 0.002, -0.003, 0.001));
        initializer.step(&scene.render(&CAMERA, &moved).noisy(2.0, 2 + frame as u64));
    }
    assert_eq!(initializer.earlier_frames.len(), 3);
    let input = input(initializer.pyramid.levels(), &initializer.intrinsics, &initializer.points);
    let at = |&(u, v): &(u16, u16)| first.inverse_depth.at(usize::from(u), usize::from(v));
    let truth: Vec<f32> = initializer.points.pixels.iter().map(at).collect();
    let tilted = initializer.points.pixels.iter().map(|p| {
        let across = f32::from(p.0) / CAMERA.width as f32 - 0.5;
        at(p) * (1.0 + 0.8 * across)
    });
    let depths = [&truth[..], &tilted.collect::<Vec<_>>()];
    let [right, wrong] =
        initializer.earlier_frames.compare(&input, depths, &initializer.params.fit);
    assert!(right * (1.0 + EvidenceParams::default().min_rival_excess) < wrong, "{right} {wrong}");
}

#[test]
fn a_start_fills_the_depth_map_around_its_points() {
    let (first, second, moved) = two_views(2.0);
    let params = TwoFrameParams { confirming_frames: 1, ..TwoFrameParams::default() };
    let mut initializer = TwoFrameInitializer::new(CAMERA, params).unwrap();
    assert!(initializer.begin(&first));
    let outcome = initializer.step(&second);
    assert_eq!(outcome.state, InitState::Proven, "{outcome:?}");
    let scale = moved.translation.norm() / outcome.first_from_current.translation.norm();
    let truth = Scene::new(5).render(&CAMERA, &SE3::identity()).inverse_depth;
    let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
    map.restart(initializer.first_pixels(), 5.0, 100_000);
    initializer.fill(&mut map);
    let candidates = map.candidates.pixels().iter().filter(|c| **c).count();
    assert!(map.num_hypotheses() * 10 > candidates * 9, "{} of {candidates}", map.num_hypotheses());
    // The points were observed in the second frame, the pixels around them were not.
    let points: Vec<_> = initializer.depths().map(|d| (d.u, d.v)).collect();
    for (v, u) in (0..CAMERA.height).flat_map(|v| (0..CAMERA.width).map(move |u| (v, u))) {
        let hypothesis = map.hypotheses.at(u, v);
        let is_point = points.contains(&(u as u16, v as u16));
        assert_eq!(hypothesis.propagated, hypothesis.is_some() && is_point, "{u}, {v}");
    }
    let (mut within, mut good) = (0, 0);
    for (h, truth) in
        map.hypotheses.pixels().iter().zip(truth.pixels()).filter(|(h, _)| h.is_some())
    {
        let error = (h.inverse_depth - truth * scale as f32).abs();
        within += usize::from(error < 3.0 * h.variance.sqrt());
        good += usize::from(error < 0.15 * truth * scale as f32);
    }
    assert!(within * 100 >= map.num_hypotheses() * 85, "{within} of {}", map.num_hypotheses());
    assert!(good * 100 >= map.num_hypotheses() * 80, "{good} of {}", map.num_hypotheses());
}

#[test]
fn a_start_is_repeatable_and_independent_of_the_threads() {
    let (first, second, _) = two_views(2.0);
    let outcomes = [1, 2, 3].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut initializer =
                TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
            assert!(initializer.begin(&first));
            (initializer.step(&second), initializer.step(&second))
        })
    });
    assert_eq!(outcomes[0], outcomes[1]);
    assert_eq!(outcomes[0], outcomes[2]);
}

#[test]
fn a_step_that_is_too_long_is_damped_and_taken() {
    let (first, _, _) = two_views(0.0);
    let dark: Vec<u8> = first.iter().map(|&grey| (f32::from(grey) / 3.0).round() as u8).collect();
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&dark));
    initializer.pyramid.fill(&first);
    let input = input(initializer.pyramid.levels(), &initializer.intrinsics, &initializer.points);
    // Three times as bright, which the first step takes for a logarithm of 2: more than one step may change.
    for freedom in [Freedom::Rotation, Freedom::Pose, Freedom::Everything] {
        let mut state = initializer.rotation.clone();
        let mut scratch = FitScratch::default();
        fit_level(&input, 0, freedom, &mut state, &mut scratch, &initializer.params.fit);
        assert!(
            (state.brightness.a.exp() - 3.0).abs() < 0.2,
            "{freedom:?}: {:?}",
            state.brightness
        );
    }
}

#[test]
fn earlier_frames_that_were_not_aligned_do_not_score() {
    let standing = |frame| Scene::new(5).render(&CAMERA, &SE3::identity()).noisy(2.0, frame);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&standing(1)));
    for frame in 2..6 {
        assert_eq!(initializer.step(&standing(frame)).evidence.earlier_frames, 0);
    }
    assert_eq!(initializer.earlier_frames.len(), 4);
    let (_, outcomes) = run(Motion::Sideways, 1, 2.0, 40);
    let asked = outcomes.iter().map(|outcome| outcome.evidence.earlier_frames).max();
    assert!(asked > Some(3), "{asked:?}");
}

#[test]
fn unusable_frames_are_refused_and_a_start_restarts_itself() {
    let (first, second, _) = two_views(2.0);
    let blank = vec![100; first.len()];
    let params = TwoFrameParams { max_frames: 4, ..TwoFrameParams::default() };
    let mut initializer = TwoFrameInitializer::new(CAMERA, params).unwrap();
    assert_eq!(initializer.step(&first[1..]).state, InitState::Failed(Failure::WrongSize));
    assert_eq!(initializer.step(&blank).state, InitState::Waiting(Waiting::Texture));
    assert!(!initializer.begin(&blank) && !initializer.begin(&[]));
    assert!(initializer.begin(&first));
    // A different scene, three times: given up, and the last of its frames is the new first frame.
    let other =
        Scene::new(77).render(&CAMERA, &SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 1.5, 0.0)));
    let states = [1, 2, 3].map(|seed| initializer.step(&other.noisy(2.0, seed)).state);
    assert_eq!(states[0], InitState::Waiting(Waiting::Match));
    assert_eq!(states[2], InitState::Failed(Failure::Mismatch));
    assert_eq!(initializer.first_pixels(), other.noisy(2.0, 3));
    // Without parallax it is given up after max_frames.
    assert!(initializer.begin(&first));
    let standing = [1, 2, 3, 4].map(|_| initializer.step(&first).state);
    assert_eq!(standing[3], InitState::Failed(Failure::TooLong));
    // And it can still start.
    initializer.step(&second);
    assert_eq!(initializer.step(&second).state, InitState::Proven);
    let nonsense = TwoFrameParams { match_noise_px: f32::NAN, ..TwoFrameParams::default() };
    assert!(TwoFrameInitializer::new(CAMERA, nonsense).is_err());
}

#[test]
fn every_version_of_the_sums_gives_the_same_bits() {
    use crate::slam::kernel::Kernel;
    use crate::slam::two_frame::system::System;
    use crate::slam::two_frame::system_kernel::Evaluation;
    let (first, second, moved) = two_views(2.0);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&first));
    initializer.pyramid.fill(&second);
    let input = input(initializer.pyramid.levels(), &initializer.intrinsics, &initializer.points);
    let num_points = initializer.points.pixels.len();
    for (level, depth) in [(0, 0.4f32), (1, -1.5), (2, 5.0), (0, f32::NAN)] {
        let state = State {
            current_from_first: moved.inverse(),
            brightness: Brightness { a: 0.02, b: -1.0 },
            gain_slopes: Some([0.03, -0.02]),
            inverse_depths: (0..num_points).map(|i| depth + 0.01 * (i % 7) as f32).collect(),
        };
        let systems = [Kernel::fastest(), Kernel::Portable].map(|kernel| {
            let mut system = System::default();
            let level = &input.level(level);
            kernel.run(Evaluation { system: &mut system, level, state: &state });
            format!("{system:?}")
        });
        assert!(systems[0] == systems[1], "level {level}, depth {depth}");
    }
}

#[test]
fn a_point_counts_as_much_in_a_block_as_alone() {
    use crate::slam::two_frame::system::System;
    let (first, second, moved) = two_views(2.0);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&first));
    initializer.pyramid.fill(&second);
    let input = input(initializer.pyramid.levels(), &initializer.intrinsics, &initializer.points);
    let state = State {
        current_from_first: moved.inverse(),
        brightness: Brightness { a: 0.02, b: -1.0 },
        gain_slopes: Some([0.03, -0.02]),
        inverse_depths: vec![0.4; initializer.points.pixels.len()],
    };
    let (view, mut system) = (input.level(0), System::default());
    system.evaluate(&view, &state);
    let (k, image) = (&initializer.intrinsics[0], view.image);
    let mut checked = 0;
    for (i, point) in system.points().enumerate().filter(|(_, p)| p.visible) {
        let (patch, l) = (&view.patches[i / 8], i % 8);
        let centre = k.ray(patch.u[l].into(), patch.v[l].into());
        let gain = (0.02 + 0.03 * centre.x - 0.02 * centre.y).exp();
        let mut energy = 0.0;
        for (s, (du, dv)) in crate::slam::depth::pattern::PATTERN.iter().enumerate() {
            let pixel =
                [f64::from(patch.u[l]) + f64::from(*du), f64::from(patch.v[l]) + f64::from(*dv)];
            let ray = k.ray(pixel[0], pixel[1]);
            let pose = &state.current_from_first;
            let q = pose.rotation_matrix() * ray + pose.translation * 0.4f32 as f64;
            let (u, v) = (k.fx * q.x / q.z + k.cx, k.fy * q.y / q.z + k.cy);
            let seen = image.bilinear(u as f32, v as f32);
            let expected = gain as f32 * patch.intensities[s][l] - 1.0;
            let size = (seen - expected).abs();
            let cost = if size <= 9.0 { size * size } else { 9.0 * (2.0 * size - 9.0) };
            energy += patch.weights[s][l] * cost;
        }
        assert!((energy - point.energy).abs() <= 1.0 + 0.01 * energy, "{i}: {energy} {point:?}");
        checked += 1;
    }
    assert!(checked > 500);
}
