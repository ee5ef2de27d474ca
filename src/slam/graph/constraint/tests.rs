//! Keyframes of rendered rooms aligned to each other: derivatives, true loops, false loops.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector6};

use super::residual::{Level, Row, State, UNKNOWNS};
use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Twist7;
use crate::slam::graph::pose_graph::{Constraint, PoseGraph};
use crate::slam::graph::robust::RobustKernel;
use crate::slam::graph::{GraphParams, optimise};
use crate::slam::keyframe::DepthPoint;
use crate::slam::modes::ModeCovariance;
use crate::slam::pose::Brightness;
use crate::slam::test_scene::{CAMERA, Random, Scene};

/// Errors of a keyframe's depth.
#[derive(Debug, Clone, Copy)]
pub(in crate::slam) struct DepthError {
    /// Standard deviation of each point's independent error, share of its inverse depth.
    pub(in crate::slam) noise: f64,
    /// Standard deviation of tilt and relief.
    pub(in crate::slam) modes: f64,
}

pub(in crate::slam) const USUAL: DepthError = DepthError { noise: 0.03, modes: 0.01 };

/// A keyframe with a unit of `unit` metres: depth at every second pixel with gradient.
pub(in crate::slam) fn keyframe(
    scene: &Scene,
    world_from_camera: &SE3,
    unit: f64,
    error: &DepthError,
    seed: u64,
) -> Keyframe {
    const MIN_GRADIENT: f32 = 3.0;
    let view = scene.render(&CAMERA, world_from_camera);
    let image = view.noisy(2.0, seed);
    let mut random = Random::new(seed ^ 0xDE);
    let modes = [(); 3].map(|()| error.modes * random.normal());
    let pixels = (4..CAMERA.height - 4)
        .step_by(2)
        .flat_map(|v| (4..CAMERA.width - 4).step_by(2).map(move |u| (u, v)));
    let grey = |u: usize, v: usize| view.intensity.at(u, v);
    let depths = view.inverse_depth.pixels();
    let logarithms = depths.iter().map(|d| (f64::from(*d) * unit).ln());
    let usual = (logarithms.sum::<f64>() / depths.len() as f64).exp();
    let mut points = Vec::new();
    for (u, v) in pixels {
        let gradient = (grey(u + 1, v) - grey(u - 1, v)).hypot(grey(u, v + 1) - grey(u, v - 1));
        if 0.5 * gradient < MIN_GRADIENT {
            continue;
        }
        let exact = f64::from(view.inverse_depth.at(u, v)) * unit;
        let ray = CAMERA.ray(u as f64, v as f64);
        // A constant error is one of the unit: shapes are taken about their usual means.
        let common = modes[0] * ray[0] + modes[1] * ray[1] + modes[2] * (exact / usual).ln();
        let inverse_depth = exact * (common + error.noise * random.normal()).exp();
        points.push(DepthPoint {
            u: u as u16,
            v: v as u16,
            inverse_depth: inverse_depth as f32,
            variance: (error.noise * inverse_depth).powi(2).max(1e-10) as f32,
            intensity: f32::from(image[v * CAMERA.width + u]),
        });
    }
    let mode_covariance = ModeCovariance::of_std_devs([error.modes; 3]);
    let place = Sim3::new(*world_from_camera, unit);
    Keyframe { mode_covariance, ..Keyframe::at(place, CAMERA, points, image) }
}

/// The pose of a camera.
fn at(twist: [f64; 6]) -> SE3 {
    SE3::exp(&Vector6::from(twist))
}

fn solver() -> ConstraintSolver {
    ConstraintSolver::new(ConstraintParams::default())
}

fn truth(i: &Keyframe, j: &Keyframe) -> Sim3 {
    j.map_from_keyframe.inverse() * i.map_from_keyframe
}

/// The left increment of a measurement's error.
fn error(found: &Sim3, truth: &Sim3) -> Twist7 {
    (*found * truth.inverse()).log()
}

#[test]
fn derivatives_of_depth_match_finite_differences() {
    /// Step of the unknowns; images are not involved.
    const STEP: f64 = 1e-4;
    let scene = Scene::new(3);
    let exact = DepthError { noise: 0.0, modes: 0.0 };
    let keyframes = [
        keyframe(&scene, &at([0.0; 6]), 1.0, &exact, 1),
        keyframe(&scene, &at([0.3, 0.1, 0.2, 0.02, -0.1, 0.05]), 1.7, &exact, 2),
    ];
    let solver = solver();
    let views = [0, 1].map(|k| solver.view(&keyframes[k]));
    let [i, j] = [&views[0], &views[1]];
    let state = State::of(&truth(&keyframes[0], &keyframes[1]));
    let params = ConstraintParams::default();
    let level = 1;
    let terms_at = |state: &State| {
        let at = Level::new([i, j], level, state, state, &params);
        at.terms().map(|terms| (terms.point, terms)).collect::<Vec<_>>()
    };
    let (mut compared, mut wrong) = (0, 0);
    let here = terms_at(&state);
    for k in 0..UNKNOWNS {
        let moved = [-STEP, STEP].map(|by| {
            let mut step = Row::zeros();
            step[k] = by;
            terms_at(&state.moved(&step))
        });
        for (point, terms) in here.iter().step_by(7) {
            let find = |of: &[(_, residual::Terms)]| {
                of.iter().find(|(other, _)| other == point).and_then(|(_, terms)| terms.depth)
            };
            let (Some(depth), Some(before), Some(after)) =
                (terms.depth, find(&moved[0]), find(&moved[1]))
            else {
                continue;
            };
            let numeric = (after.residual - before.residual) / (2.0 * STEP);
            let analytic = depth.row()[k];
            compared += 1;
            // In between, a point may project onto another pixel's plane.
            wrong += u32::from((numeric - analytic).abs() > 0.02 * analytic.abs().max(0.2));
        }
    }
    assert!(compared > 2000, "{compared}");
    assert!(f64::from(wrong) < 0.03 * f64::from(compared), "{wrong} of {compared}");
}

#[test]
fn a_similarity_survives_the_round_trip_through_the_state() {
    let j_from_i = Sim3::new(at([0.3, -0.2, 0.5, 0.1, 0.4, -0.2]), 1.8);
    let state = State::of(&j_from_i);
    assert!(error(&state.j_from_i(), &j_from_i).norm() < 1e-12);
    // The covariance's change of units: a step of T is a left increment whose translation is in units of j.
    let mut step = Row::zeros();
    step.fixed_rows_mut::<7>(0).copy_from_slice(&[1e-5, 2e-5, -1e-5, 3e-5, -2e-5, 1e-5, 2e-5]);
    let moved = error(&state.moved(&step).j_from_i(), &j_from_i);
    for k in 0..7 {
        let expected = step[k] * if k < 3 { 1.8 } else { 1.0 };
        assert!((moved[k] - expected).abs() < 1e-9, "{k}: {moved}");
    }
    assert!(state.is_finite());
    let broken = State { brightness: Brightness { a: f64::NAN, b: 0.0 }, ..state };
    assert!(!broken.is_finite());
}

/// Measures cameras that see the same place from `twist` apart, in units of `scale` to one.
fn measured(
    scenes: [&Scene; 2],
    twist: [f64; 6],
    scale: f64,
    seed: u64,
    knows_start: bool,
) -> (Result<Measurement, Refusal>, Sim3) {
    let i = keyframe(scenes[0], &at([0.0; 6]), 2.5, &USUAL, seed);
    let j = keyframe(scenes[1], &at(twist), 2.5 / scale, &USUAL, seed + 100);
    let truth = truth(&i, &j);
    let solver = solver();
    let views = [&i, &j].map(|keyframe| solver.view(keyframe));
    let start = Sim3::exp(&Twist7::from([0.05, -0.05, 0.05, 0.02, 0.03, -0.02, 0.1])) * truth;
    let start = match knows_start {
        true => Start::Similarity(start),
        false => Start::Rotation(truth.rigid.rotation),
    };
    (solver.measure(&views[0], &views[1], start), truth)
}

/// Relative poses of cameras that see the same wall, translation in metres (its depth is 4).
const WIDE: [[f64; 6]; 6] = [
    [0.1, 0.0, 0.0, 0.0, 0.0, 0.0],
    [0.5, 0.1, 0.0, 0.0, -0.1, 0.0],
    [-0.4, 0.2, 0.3, 0.05, 0.12, 0.1],
    [0.2, -0.1, 0.8, 0.0, 0.0, 0.0],
    [0.9, 0.0, 0.1, 0.0, -0.25, 0.05],
    [0.0, 0.1, 0.1, 0.1, 0.2, -0.3],
];

/// The pose with the largest sideways offset.
const WIDEST: usize = 4;

#[test]
fn true_loops_are_accepted_at_wide_baselines_and_other_units() {
    /// Largest error: translation in units of j, rotation in radians, ln s.
    const LARGEST: [f64; 3] = [0.02, 0.01, 0.05];
    let scene = Scene::new(3);
    let (mut widest, mut refused) = (0, Vec::new());
    for (k, twist) in WIDE.into_iter().enumerate() {
        for (n, scale) in [0.5, 1.0, 2.0].into_iter().enumerate() {
            for knows_start in [true, false] {
                let seed = (3 * k + n) as u64;
                let (found, truth) = measured([&scene; 2], twist, scale, seed, knows_start);
                let found = match found {
                    Ok(found) => found,
                    Err(_) if k == WIDEST => {
                        widest += 1;
                        continue;
                    }
                    Err(refusal) => {
                        refused.push((k, scale, knows_start, refusal));
                        continue;
                    }
                };
                let error = error(&found.j_from_i, &truth);
                let sizes = [
                    error.fixed_rows::<3>(0).norm(),
                    error.fixed_rows::<3>(3).norm(),
                    error[6].abs(),
                ];
                for (size, largest) in sizes.into_iter().zip(LARGEST) {
                    assert!(size < largest, "{k} {scale} {knows_start}: {sizes:?}");
                }
            }
        }
    }
    assert!(refused.is_empty(), "{refused:?}");
    // Of the widest one, which loses most of the near points, two thirds at most are refused.
    assert!(widest <= 4, "{widest} of 6");
}

/// The outcome for two keyframes whose rotation is roughly known.
fn outcome(i: &Keyframe, j: &Keyframe) -> Result<Measurement, Refusal> {
    let solver = solver();
    let views = [i, j].map(|keyframe| solver.view(keyframe));
    let off = UnitQuaternion::from_euler_angles(0.03, -0.03, 0.05);
    let rotation = off * truth(i, j).rigid.rotation;
    solver.measure(&views[0], &views[1], Start::Rotation(rotation))
}

#[test]
fn other_places_are_refused() {
    let here = at([0.0; 6]);
    let near = at([0.2, 0.0, 0.1, 0.0, 0.05, 0.0]);
    for seed in 0..3 {
        let room = || Scene::new(seed);
        let i = keyframe(&room(), &here, 2.5, &USUAL, seed);
        let turned = |by| at([0.0, 0.0, 0.0, 0.0, by, 0.0]);
        for (name, scene, pose) in [
            ("furniture moved", room().refurnished(seed, 0.7), near),
            ("other furniture", room().refurnished(seed + 20, -0.7), near),
            ("larger", room().resized(1.3), near),
            ("smaller", room().resized(0.8), near),
            ("another room", Scene::new(seed + 10), near),
            ("behind", room(), turned(3.0)),
            ("aside", room(), turned(1.0)),
            ("blank", room().with_contrast(0.05), near),
        ] {
            let j = keyframe(&scene, &pose, 2.5, &USUAL, seed + 7);
            let found = outcome(&i, &j);
            assert!(found.is_err(), "{seed}, {name}: {found:?}");
        }
    }
}

#[test]
fn a_corridor_that_repeats_is_ambiguous() {
    for seed in 0..3 {
        let corridor = Scene::corridor(seed, 1.2);
        let i = keyframe(&corridor, &at([0.0; 6]), 2.5, &USUAL, seed);
        for z in [0.0, 0.4, 1.2, 2.4] {
            let pose = at([0.0, 0.0, z, 0.0, 0.03, 0.0]);
            let found = outcome(&i, &keyframe(&corridor, &pose, 2.5, &USUAL, seed + 9));
            assert!(found.is_err(), "{seed}, {z}: {found:?}");
        }
    }
}

#[test]
fn an_image_with_wrong_depth_and_a_mirrored_one_are_refused() {
    let i = keyframe(&Scene::new(3), &at([0.0; 6]), 2.5, &USUAL, 1);
    assert!(outcome(&i, &i.clone()).is_ok());
    let mut flat = i.clone();
    flat.points.iter_mut().for_each(|point| point.inverse_depth = 1.0);
    assert!(outcome(&i, &flat).is_err());
    let mut mirrored = i.clone();
    Arc::make_mut(&mut mirrored.image).chunks_exact_mut(CAMERA.width).for_each(<[u8]>::reverse);
    mirrored.points.iter_mut().for_each(|point| point.u = CAMERA.width as u16 - 1 - point.u);
    assert!(outcome(&i, &mirrored).is_err());
}

#[test]
fn unusable_keyframes_and_starts_are_refused() {
    let i = keyframe(&Scene::new(3), &at([0.0; 6]), 2.5, &USUAL, 1);
    let solver = solver();
    let view = solver.view(&i);
    let from = |j: &Keyframe, start| solver.measure(&view, &solver.view(j), start).err();
    let of = |j: &Keyframe| from(j, Start::Rotation(UnitQuaternion::identity()));
    let nothing = Keyframe { points: Vec::new(), ..i.clone() };
    assert_eq!(of(&nothing), Some(Refusal::TooFewPoints));
    let cut = Keyframe { image: [0; 7].into(), ..i.clone() };
    assert_eq!(of(&cut), Some(Refusal::TooFewPoints));
    let mut hostile = i.clone();
    for point in &mut hostile.points {
        (point.inverse_depth, point.variance) = (f32::NAN, f32::NEG_INFINITY);
    }
    assert_eq!(of(&hostile), Some(Refusal::TooFewPoints));
    let mut other = i.clone();
    other.intrinsics.fx += 1.0;
    assert_eq!(of(&other), Some(Refusal::OtherCamera));
    let broken = Sim3 { scale: f64::NAN, ..Sim3::identity() };
    assert_eq!(from(&i, Start::Similarity(broken)), Some(Refusal::InvalidStart));
    let away = Sim3::new(at([0.0, 0.0, -1e9, 0.0, 0.0, 0.0]), 1.0);
    assert!(from(&i, Start::Similarity(away)).is_some());
}

#[test]
fn errors_are_as_large_as_their_covariances() {
    const TIMES: u64 = 24;
    let mut sum = 0.0;
    let mut count = 0;
    for seed in 0..TIMES {
        let mut random = Random::new(seed + 50);
        let sizes = [0.3, 0.2, 0.3, 0.05, 0.1, 0.1];
        let twist = sizes.map(|size| size * (2.0 * random.uniform() - 1.0));
        let (found, truth) = measured([&Scene::new(seed % 4); 2], twist, 1.3, seed, true);
        let Ok(found) = found else { continue };
        let error = error(&found.j_from_i, &truth);
        sum += error.dot(&found.covariance.cholesky().unwrap().solve(&error));
        count += 1;
    }
    let nees = sum / f64::from(count);
    // Seven unknowns.
    assert!(count >= 20 && (3.5..14.0).contains(&nees), "{nees} of {count}");
}

#[test]
fn one_loop_makes_a_drifted_chain_consistent() {
    /// Keyframes out and back, and the error of each measurement to the next one, always the same.
    const NUMBER: usize = 10;
    const DRIFT: [f64; 7] = [0.02, 0.01, 0.01, 0.004, 0.006, 0.002, 0.02];
    let scene = Scene::new(3);
    let places: Vec<Sim3> = (0..NUMBER)
        .map(|k| {
            let phase = std::f64::consts::TAU * k as f64 / NUMBER as f64;
            let x = 0.8 * (1.0 - phase.cos());
            Sim3::new(at([x, 0.2 * phase.sin(), 0.1 * phase.sin(), 0.0, -0.1 * x, 0.0]), 2.5)
        })
        .collect();
    let keyframes =
        [0, NUMBER - 1].map(|k| keyframe(&scene, &places[k].rigid, 2.5, &USUAL, k as u64));
    let found = outcome(&keyframes[0], &keyframes[1]).unwrap();
    let drift = Twist7::from(DRIFT);
    let information = Matrix7::from_diagonal(&drift.map(|of| 1.0 / (of * of)));
    let mut graph = PoseGraph::new();
    let mut ids = vec![graph.add_vertex(places[0], true).unwrap()];
    let mut place = places[0];
    for k in 1..NUMBER {
        let j_from_i = Sim3::exp(&drift) * (places[k].inverse() * places[k - 1]);
        place = place * j_from_i.inverse();
        ids.push(graph.add_vertex(place, false).unwrap());
        let (i, j, kernel) = (ids[k - 1], ids[k], RobustKernel::None);
        graph.add_constraint(Constraint { i, j, j_from_i, information, kernel }).unwrap();
    }
    let error_of = |graph: &PoseGraph, k: usize| {
        error(graph.map_from_keyframe(ids[k]).unwrap(), &places[k]).norm()
    };
    let before: Vec<f64> = (1..NUMBER).map(|k| error_of(&graph, k)).collect();
    // A kernel that rejects false loops would reject this one: it is much more certain than the chain has drifted.
    let (i, j, kernel) = (ids[0], ids[NUMBER - 1], RobustKernel::None);
    let information = found.covariance.cholesky().unwrap().inverse();
    let j_from_i = found.j_from_i;
    graph.add_constraint(Constraint { i, j, j_from_i, information, kernel }).unwrap();
    assert!(optimise(&mut graph, &GraphParams::default()).unwrap().is_converged);
    let last = error_of(&graph, NUMBER - 1);
    assert!(before[NUMBER - 2] > 0.3 && last < 0.05, "{before:?} {last}");
    let sum = |graph: &PoseGraph| (1..NUMBER).map(|k| error_of(graph, k)).sum::<f64>();
    assert!(sum(&graph) < 0.4 * before.iter().sum::<f64>(), "{}", sum(&graph));
}
