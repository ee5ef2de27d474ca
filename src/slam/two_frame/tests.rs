//! Tests of the two-frame start on an analytic room: what must start does, what must not does not.

use nalgebra::Vector6;

use super::*;
use crate::slam::test_scene::{CAMERA, Random, Scene};

/// How the camera moves a frame.
#[derive(Debug, Clone, Copy)]
enum Motion {
    Sideways,
    Forward,
    Mixed,
    Turning,
    Standing,
}

/// The twist of one frame: 6 mm and up to 0.3°, directions by the seed.
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
    frame: usize,
    direction_error_deg: f64,
    median_depth_error: f64,
    within_two_sigmas: f64,
}

/// Runs up to `frames` frames; the figures of the first proof, and all outcomes.
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
        if std::env::var("SHOW").is_ok() {
            println!("{motion:?} {seed} {frame} {:?} {:.3?}", outcome.state, outcome.evidence);
        }
        match outcome.state {
            InitState::Proven => {
                let from_first = pose(motion, seed, first.0).inverse();
                let true_pose = from_first * pose(motion, seed, frame);
                let started =
                    figures(&initializer, &outcome, &true_pose, &first.1.inverse_depth, frame);
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
    truth: &crate::slam::image::buffer::Image<f32>,
    frame: usize,
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
    let mut errors: Vec<f64> = ratios.iter().map(|r| (r / scale - 1.0).abs()).collect();
    errors.sort_by(f64::total_cmp);
    Started {
        frame,
        direction_error_deg: cosine.clamp(-1.0, 1.0).acos().to_degrees(),
        median_depth_error: errors[errors.len() / 2],
        within_two_sigmas,
    }
}

fn assert_starts(motion: Motion) {
    for seed in 1..=4 {
        let (started, outcomes) = run(motion, seed, 2.0, 40);
        let started = started.unwrap_or_else(|| panic!("{motion:?} {seed}: {:?}", outcomes.last()));
        if std::env::var("SHOW").is_ok() {
            println!(
                "{motion:?} {seed}: frame {}, direction {:.2}°, depth {:.3}, 2σ {:.2}",
                started.frame,
                started.direction_error_deg,
                started.median_depth_error,
                started.within_two_sigmas
            );
        }
        assert!(
            started.median_depth_error <= 0.1,
            "{motion:?} {seed}: {}",
            started.median_depth_error
        );
        assert!(
            started.direction_error_deg <= 5.0,
            "{motion:?} {seed}: {}",
            started.direction_error_deg
        );
    }
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
fn a_standing_camera_never_starts_whatever_the_noise() {
    for (seed, noise) in [(1, 0.0), (2, 2.0), (3, 4.0)] {
        let (started, _) = run(Motion::Standing, seed, noise, 200);
        assert!(started.is_none(), "noise {noise}");
    }
}

#[test]
fn a_turning_camera_never_starts() {
    for seed in 1..=4 {
        let (started, _) = run(Motion::Turning, seed, 2.0, 60);
        assert!(started.is_none(), "seed {seed}");
    }
}
