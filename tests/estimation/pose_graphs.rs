//! The pose-graph solver on the public graphs, if these are on the machine.

use std::time::Instant;

use crate::g2o;
use crate::recording::{recording, say};
use semidense::slam::graph::{GraphParams, optimise};

/// Optimum of each graph according to GTSAM 4.3.0: `tests/fixtures/pose-graphs/optimum.py`.
const OPTIMA: [(&str, f64); 4] = [
    ("parking-garage", 1.268385),
    ("sphere2500", 1351.401926),
    ("torus3D", 24235.273759),
    ("cubicle", 2745.552078),
];

/// Relative difference by which the result may deviate from the optimum.
const TOLERANCE: f64 = 1e-3;

#[test]
fn the_optimum_equals_that_of_an_independent_solver() {
    let Some(folder) = recording("pose-graphs") else { return };
    for (name, optimum) in OPTIMA {
        let mut graph = g2o::read(&folder.join(format!("{name}.g2o")));
        let params = GraphParams { is_scale_known: true, ..GraphParams::default() };
        let began = Instant::now();
        let outcome = optimise(&mut graph, &params).expect(name);
        let seconds = began.elapsed().as_secs_f64();
        say(&format!(
            "{name}: chi2 {:.6} (optimum {optimum}) from {:.6}, {} iterations, {seconds:.2} s",
            outcome.chi2, outcome.initial_cost, outcome.iterations
        ));
        assert!(outcome.is_converged, "{name}: {outcome:?}");
        let difference = (outcome.chi2 - optimum).abs();
        assert!(difference <= TOLERANCE * optimum, "{name}: {outcome:?}, {optimum}");
        assert!(graph.vertices().iter().all(|vertex| vertex.map_from_keyframe.scale == 1.0));
    }
}
