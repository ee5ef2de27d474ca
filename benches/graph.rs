//! Cost of the pose graph: `cargo bench --bench graph`, on the public graphs if they are on the machine, and on loops
//! of keyframes like those of a map.

#[path = "../tests/support/g2o.rs"]
mod g2o;
#[path = "../tests/support/recordings.rs"]
mod recordings;

use std::hint::black_box;
use std::time::Instant;

use semidense::slam::geometry::sim3::{Matrix7, Sim3, Twist7};
use semidense::slam::graph::marginal::Marginals;
use semidense::slam::graph::pose_graph::{Constraint, PoseGraph};
use semidense::slam::graph::robust::RobustKernel;
use semidense::slam::graph::{GraphParams, optimise};

/// Repetitions, of which the fastest counts.
const REPEATS: usize = 5;

fn main() {
    println!("graph, vertices, constraints: factorisations, chi2, ms, best of {REPEATS}");
    if let Some(folder) = recordings::recording("pose-graphs") {
        for name in ["parking-garage", "sphere2500", "torus3D", "cubicle"] {
            let graph = g2o::read(&folder.join(format!("{name}.g2o")));
            measure(name, &graph, &GraphParams { is_scale_known: true, ..GraphParams::default() });
        }
    }
    for keyframes in [100, 1_000, 10_000] {
        let graph = rounds(keyframes);
        measure("rounds of a flat", &graph, &GraphParams::default());
        let mut marginals = Marginals::new(&graph, &GraphParams::default()).expect("connected");
        let last = *graph.constraints().last().expect("has loops");
        let began = Instant::now();
        black_box(marginals.relative_covariance(last.i, last.j));
        println!("  relative covariance {:.2} ms", 1e3 * began.elapsed().as_secs_f64());
    }
}

fn measure(name: &str, graph: &PoseGraph, params: &GraphParams) {
    let mut best = f64::INFINITY;
    let mut outcome = None;
    for _ in 0..REPEATS {
        let mut graph = graph.clone();
        let began = Instant::now();
        outcome = optimise(&mut graph, params).ok();
        best = best.min(began.elapsed().as_secs_f64());
    }
    let outcome = outcome.expect("the graph is connected");
    println!(
        "{name}, {}, {}: {}, {:.6}, {:.1}",
        graph.vertices().len(),
        graph.constraints().len(),
        outcome.iterations,
        outcome.chi2,
        1e3 * best
    );
}

/// Rounds of 50 keyframes, each connected to the previous three and, every fifth, to the previous round; the
/// measurements are slightly inconsistent, and scale drifts.
fn rounds(keyframes: usize) -> PoseGraph {
    let step =
        Sim3::exp(&Twist7::from([0.3, 0.0, 0.0, 0.0, std::f64::consts::TAU / 50.0, 0.0, 0.0]));
    let truth: Vec<Sim3> =
        std::iter::successors(Some(Sim3::identity()), |place| Some(*place * step))
            .take(keyframes)
            .collect();
    let drift = |k: usize| {
        let k = k as f64;
        Sim3::exp(
            &(Twist7::from([
                k.sin(),
                k.cos(),
                (2.0 * k).sin(),
                (3.0 * k).sin(),
                (5.0 * k).cos(),
                0.0,
                1.0,
            ]) * 2e-3),
        )
    };
    let mut graph = PoseGraph::new();
    let mut place = Sim3::identity();
    let mut ids = Vec::new();
    for k in 0..keyframes {
        if k > 0 {
            place = place * step * drift(k);
        }
        ids.push(graph.add_vertex(place, k == 0).expect("finite"));
    }
    for k in 1..keyframes {
        let loops = (k >= 50 && k % 5 == 0).then(|| k - 50);
        for (i, kernel) in (k.saturating_sub(3)..k)
            .map(|i| (i, RobustKernel::None))
            .chain(loops.map(|i| (i, RobustKernel::DynamicCovariance { threshold: 4.3 })))
        {
            let j_from_i = drift(k + i) * (truth[k].inverse() * truth[i]);
            let information = Matrix7::identity() * 1e5;
            let constraint = Constraint { i: ids[i], j: ids[k], j_from_i, information, kernel };
            graph.add_constraint(constraint).expect("finite");
        }
    }
    graph
}
