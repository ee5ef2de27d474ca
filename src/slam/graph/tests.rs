//! Tests of whole pose graphs, on loops with exact truth.

use nalgebra::Vector6;

use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::{Matrix7, Sim3, Twist7};
use crate::slam::graph::marginal::Marginals;
use crate::slam::graph::pose_graph::Constraint;
use crate::slam::graph::robust::RobustKernel;
use crate::slam::test_scene::Random;

/// Standard deviations of translation, rotation and log scale of a measurement.
const DEVIATIONS: [f64; 7] = [0.02, 0.02, 0.02, 0.01, 0.01, 0.01, 0.02];

fn information() -> Matrix7 {
    Matrix7::from_diagonal(&Twist7::from(DEVIATIONS.map(|deviation| 1.0 / (deviation * deviation))))
}

fn noise(random: &mut Random, share: f64) -> Twist7 {
    Twist7::from(DEVIATIONS.map(|deviation| share * deviation * random.normal()))
}

/// A circle of keyframes that face outwards, each with its own unit.
fn circle(number: usize) -> Vec<Sim3> {
    (0..number)
        .map(|k| {
            let angle = std::f64::consts::TAU * k as f64 / number as f64;
            let turned = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, -angle, 0.0));
            let translation = [5.0 * angle.cos(), 0.3 * (3.0 * angle).sin(), 5.0 * angle.sin()];
            Sim3::new(SE3 { translation: translation.into(), ..turned }, 1.0 + 0.3 * angle.sin())
        })
        .collect()
}

fn measured(truth: &[Sim3], i: usize, j: usize, error: &Twist7) -> Sim3 {
    Sim3::exp(error) * (truth[j].inverse() * truth[i])
}

/// The graph of a chain, started from its own measurements, with loops (i, j, measurement); the first is fixed.
fn graph_of(
    truth: &[Sim3],
    chain: impl Fn(usize) -> Sim3,
    loops: &[(usize, usize, Sim3)],
    kernel: RobustKernel,
) -> (PoseGraph, Vec<VertexId>) {
    let mut graph = PoseGraph::new();
    let mut ids = vec![graph.add_vertex(truth[0], true).unwrap()];
    let mut place = truth[0];
    let information = information();
    for k in 1..truth.len() {
        let j_from_i = chain(k);
        place = place * j_from_i.inverse();
        ids.push(graph.add_vertex(place, false).unwrap());
        let (i, j) = (ids[k - 1], ids[k]);
        let kernel = RobustKernel::None;
        graph.add_constraint(Constraint { i, j, j_from_i, information, kernel }).unwrap();
    }
    for &(i, j, j_from_i) in loops {
        let (i, j) = (ids[i], ids[j]);
        graph.add_constraint(Constraint { i, j, j_from_i, information, kernel }).unwrap();
    }
    (graph, ids)
}

fn worst(graph: &PoseGraph, truth: &[Sim3]) -> f64 {
    let of = |(vertex, truth): (&crate::slam::graph::pose_graph::Vertex, &Sim3)| {
        (truth.inverse() * vertex.map_from_keyframe).log().norm()
    };
    graph.vertices().iter().zip(truth).map(of).fold(0.0, f64::max)
}

#[test]
fn a_loop_whose_scale_drifts_is_closed_exactly() {
    let truth = circle(60);
    // The start drifts by a factor of two in scale; every measurement is exact, so the loops undo it.
    let none = Twist7::zeros();
    let exact = |k: usize| measured(&truth, k - 1, k, &none);
    let loops = [(59, 0, measured(&truth, 59, 0, &none))];
    let (mut graph, _) = graph_of(&truth, exact, &loops, RobustKernel::None);
    for (k, place) in graph.places_mut().enumerate().skip(1) {
        let share = k as f64 / 60.0;
        let drift = Twist7::from([0.5, -0.3, 0.2, 0.1, -0.2, 0.1, std::f64::consts::LN_2]) * share;
        *place = Sim3::exp(&drift) * *place;
    }
    assert!(worst(&graph, &truth) > 0.5);
    let outcome = optimise(&mut graph, &GraphParams::default()).unwrap();
    assert!(outcome.is_converged && outcome.cost < 1e-12, "{outcome:?}");
    assert!(worst(&graph, &truth) < 1e-8, "{}", worst(&graph, &truth));
    assert_eq!(graph.vertices()[0].map_from_keyframe, truth[0]);
}

#[test]
fn a_loop_distributes_the_drift_over_all_keyframes() {
    let truth = circle(60);
    // The scale of every step is wrong by 1 %, which the one loop reveals.
    let drift = Twist7::from([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01]);
    let drifting = |k: usize| measured(&truth, k - 1, k, &drift);
    let loops = [(59, 0, measured(&truth, 59, 0, &Twist7::zeros()))];
    let (mut graph, _) = graph_of(&truth, drifting, &loops, RobustKernel::None);
    let before = worst(&graph, &truth);
    optimise(&mut graph, &GraphParams::default()).unwrap();
    let last = truth[59].inverse() * graph.vertices()[59].map_from_keyframe;
    assert!(last.log().norm() < 0.03 && before > 0.5, "{before} {}", last.log());
}

/// √e up to which a loop counts in full: of 7 degrees of freedom 99 % lie within (χ²₇ is 18.5 there).
const THRESHOLD: f64 = 4.3;

/// Worst error of a vertex, with 8 true and `num_false` false loops.
fn with_false_loops(kernel: RobustKernel, num_false: usize, seed: u64) -> f64 {
    let truth = circle(100);
    let mut random = Random::new(seed);
    let errors: Vec<Twist7> = (0..120).map(|_| noise(&mut random, 1.0)).collect();
    let mut loops: Vec<_> =
        (0..8).map(|k| (92 + k, k, measured(&truth, 92 + k, k, &errors[100 + k]))).collect();
    for _ in 0..num_false {
        let i = (random.uniform() * 45.0) as usize;
        let j = i + 20 + (random.uniform() * 30.0) as usize;
        // Two rooms that look alike: nothing in the measurement itself reveals it.
        loops.push((i, j, Sim3::exp(&noise(&mut random, 5.0))));
    }
    let chain = |k: usize| measured(&truth, k - 1, k, &errors[k]);
    let (mut graph, _) = graph_of(&truth, chain, &loops, kernel);
    optimise(&mut graph, &GraphParams::default()).unwrap();
    worst(&graph, &truth)
}

/// Median and worst over nine noise seeds.
fn over_seeds(kernel: RobustKernel, num_false: usize) -> (f64, f64) {
    let mut errors: Vec<f64> = (0..9).map(|s| with_false_loops(kernel, num_false, s)).collect();
    errors.sort_by(f64::total_cmp);
    (errors[4], errors[8])
}

#[test]
fn false_loops_among_true_ones_are_rejected() {
    let (middle, most) = over_seeds(RobustKernel::None, 0);
    // In the last case there are as many false ones as true ones.
    for num_false in [0, 2, 4, 8] {
        let kernel = RobustKernel::DynamicCovariance { threshold: THRESHOLD };
        let found = over_seeds(kernel, num_false);
        assert!(found.0 < 1.05 * middle && found.1 < 1.05 * most, "{num_false}: {found:?}");
    }
    // Without it they do harm, and a convex kernel does not reject them.
    for kernel in [RobustKernel::None, RobustKernel::Huber { threshold: THRESHOLD }] {
        assert!(over_seeds(kernel, 4).0 > 5.0 * middle, "{kernel:?}");
    }
}

/// Mean of δᵀΣ⁻¹δ over repetitions, for the last vertex and for one relative to another.
fn normalized_errors() -> (f64, f64) {
    let truth = circle(30);
    let mut random = Random::new(5);
    const REPETITIONS: usize = 300;
    let (mut absolute, mut relative) = (0.0, 0.0);
    for _ in 0..REPETITIONS {
        let errors: Vec<Twist7> = (0..34).map(|_| noise(&mut random, 1.0)).collect();
        let chain = |k: usize| measured(&truth, k - 1, k, &errors[k]);
        let loops: Vec<_> =
            (0..4).map(|k| (26 + k, k, measured(&truth, 26 + k, k, &errors[30 + k]))).collect();
        let (mut graph, ids) = graph_of(&truth, chain, &loops, RobustKernel::None);
        let params = GraphParams::default();
        optimise(&mut graph, &params).unwrap();
        let mut marginals = Marginals::new(&graph, &params).unwrap();
        let place = |k: usize| graph.vertices()[k].map_from_keyframe;
        let normalized = |covariance: Matrix7, error: Twist7| {
            error.dot(&(covariance.try_inverse().unwrap() * error))
        };
        let mut of = |a: usize, b: usize| {
            let truth = truth[a].inverse() * truth[b];
            let error = (place(a).inverse() * place(b) * truth.inverse()).log();
            normalized(marginals.relative_covariance(ids[a], ids[b]).unwrap(), error)
        };
        // The first one is fixed.
        absolute += of(0, 15);
        relative += of(20, 8);
    }
    (absolute / REPETITIONS as f64, relative / REPETITIONS as f64)
}

#[test]
fn errors_are_as_large_as_their_covariances() {
    let (absolute, relative) = normalized_errors();
    // χ²₇ has mean 7, and a mean of 300 a standard deviation of 0.22.
    for found in [absolute, relative] {
        assert!((6.2..7.8).contains(&found), "{absolute} {relative}");
    }
}

#[test]
fn fixed_vertices_stay_and_unconnected_ones_are_an_error() {
    let truth = circle(10);
    let chain = |k: usize| measured(&truth, k - 1, k, &Twist7::zeros());
    let (mut graph, ids) = graph_of(&truth, chain, &[], RobustKernel::None);
    let fixed = graph.add_vertex(Sim3::new(SE3::identity(), 2.0), true).unwrap();
    let ends = Constraint {
        i: ids[9],
        j: fixed,
        j_from_i: Sim3::identity(),
        information: information(),
        kernel: RobustKernel::None,
    };
    graph.add_constraint(ends).unwrap();
    optimise(&mut graph, &GraphParams::default()).unwrap();
    assert_eq!(graph.map_from_keyframe(ids[0]), Some(&truth[0]));
    assert_eq!(graph.map_from_keyframe(fixed), Some(&Sim3::new(SE3::identity(), 2.0)));
    let mut marginals = Marginals::new(&graph, &GraphParams::default()).unwrap();
    assert_eq!(marginals.relative_covariance(ids[0], fixed), Some(Matrix7::zeros()));

    let alone = graph.add_vertex(Sim3::identity(), false).unwrap();
    let before = graph.clone();
    let params = GraphParams::default();
    assert_eq!(optimise(&mut graph, &params), Err(SolveError::Disconnected(alone)));
    assert_eq!(graph, before);

    // A constraint without information connects, but determines nothing.
    graph.add_constraint(Constraint { j: alone, information: Matrix7::zeros(), ..ends }).unwrap();
    let before = graph.clone();
    assert_eq!(optimise(&mut graph, &params), Err(SolveError::Singular));
    assert_eq!(graph, before);
    assert!(matches!(Marginals::new(&graph, &params), Err(SolveError::Singular)));
}

#[test]
fn a_graph_whose_factor_would_be_too_large_is_refused() {
    // With random connections its factor is dense: half of 5 000² blocks are 5 GB.
    const KEYFRAMES: usize = 5000;
    let mut random = Random::new(1);
    let mut graph = PoseGraph::new();
    let ids: Vec<VertexId> =
        (0..KEYFRAMES).map(|k| graph.add_vertex(Sim3::identity(), k == 0).unwrap()).collect();
    let information = information();
    for k in 1..KEYFRAMES {
        for other in 0..10 {
            let far = (random.uniform() * k as f64) as usize;
            let (i, j) = (ids[if other == 0 { k - 1 } else { far }], ids[k]);
            let (j_from_i, kernel) = (Sim3::identity(), RobustKernel::None);
            graph.add_constraint(Constraint { i, j, j_from_i, information, kernel }).unwrap();
        }
    }
    let (before, params) = (graph.clone(), GraphParams::default());
    assert_eq!(optimise(&mut graph, &params), Err(SolveError::TooLarge));
    assert_eq!(graph, before);
    assert!(matches!(Marginals::new(&graph, &params), Err(SolveError::TooLarge)));
}

#[test]
fn a_graph_without_errors_converges_at_once() {
    let mut graph = PoseGraph::new();
    let outcome = optimise(&mut graph, &GraphParams::default()).unwrap();
    assert!(outcome.is_converged && outcome.cost == 0.0);
    graph.add_vertex(Sim3::identity(), true).unwrap();
    assert!(optimise(&mut graph, &GraphParams::default()).unwrap().is_converged);
}
