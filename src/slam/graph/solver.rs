//! Levenberg–Marquardt on the similarities of a pose graph.

use crate::slam::geometry::sim3::{Sim3, Twist7};
use crate::slam::graph::factorisation::Factorisation;
use crate::slam::graph::pose_graph::PoseGraph;
use crate::slam::graph::system::{System, cost, error};
use crate::slam::graph::{GraphParams, MAX_FACTOR_BYTES, Outcome, SolveError};

/// Damping of the first step, as a share of each diagonal element: odometry is a good initial value.
const FIRST_DAMPING: f64 = 1e-5;
/// Factors after a step that lowers the cost, and after one that does not.
const DAMPING_DOWN: f64 = 0.1;
const DAMPING_UP: f64 = 10.0;
/// Least damping: no effect, but the next one can grow from it; above the most every step vanishes.
const MIN_DAMPING: f64 = 1e-12;
const MAX_DAMPING: f64 = 1e8;
/// Converged when a step would lower the cost by less than this, and by less than this share of it: a thousandth of a
/// standard deviation in one direction lowers it by a millionth.
const CONVERGED_DECREASE: f64 = 1e-6;
const CONVERGED_SHARE: f64 = 1e-9;
/// After a step that lowered the cost by no more than this share the next is undamped: by then Gauss–Newton converges,
/// and the remaining decrease is judged without another factorisation.
const NEAR_SHARE: f64 = 1e-3;

/// Moves the free vertices to the least cost; `graph` is unchanged on error.
pub(super) fn solve<const D: usize>(
    graph: &mut PoseGraph,
    params: &GraphParams,
) -> Result<Outcome, SolveError> {
    solve_from::<D>(graph, params, FIRST_DAMPING)
}

fn solve_from<const D: usize>(
    graph: &mut PoseGraph,
    params: &GraphParams,
    first_damping: f64,
) -> Result<Outcome, SolveError> {
    let mut places: Vec<Sim3> = graph.vertices().iter().map(|v| v.map_from_keyframe).collect();
    let mut system = System::<D>::new(graph)?;
    let (nodes, pairs) = (system.num_nodes(), &system.pairs);
    let mut factorisation = Factorisation::<D>::new(nodes, pairs, params.kernel, MAX_FACTOR_BYTES)?;
    let constraints = graph.constraints();
    let initial_cost = cost::<D>(constraints, &places);
    let mut current = initial_cost;
    if !initial_cost.is_finite() {
        return Err(SolveError::NotFinite);
    }
    let (mut damping, mut iterations, mut is_converged) = (first_damping, 0, false);
    let (mut step, mut moved) = (Vec::new(), places.clone());
    let (mut is_linearised, mut is_near) = (false, false);
    while iterations < params.max_iterations && damping <= MAX_DAMPING {
        if !is_linearised {
            system.linearise(constraints, &places);
            is_linearised = true;
        }
        iterations += 1;
        // Damping hides the remaining distance in weak directions: a long chain bends at next to no cost.
        let used = if is_near { 0.0 } else { damping };
        let Some(expected) = take_step(&system, &mut factorisation, used, &mut step) else {
            if is_near {
                // The best available, as not all vertices are determined.
                break;
            }
            damping *= DAMPING_UP;
            if damping > MAX_DAMPING {
                return Err(SolveError::Singular);
            }
            continue;
        };
        place_after(&places, &system, &step, &mut moved);
        let trial = cost::<D>(constraints, &moved);
        let decrease = current - trial;
        if trial < current {
            std::mem::swap(&mut places, &mut moved);
            (current, is_linearised) = (trial, false);
            damping = (damping * DAMPING_DOWN).max(MIN_DAMPING);
        } else {
            damping *= DAMPING_UP;
        }
        let flat = CONVERGED_DECREASE + CONVERGED_SHARE * current;
        let is_flat = expected <= flat && decrease <= flat;
        if is_flat && is_near {
            is_converged = true;
            break;
        }
        is_near = is_flat || (0.0..=NEAR_SHARE * current).contains(&decrease);
    }
    let chi2 = constraints.iter().map(|constraint| error::<D>(constraint, &places)).sum();
    graph.places_mut().zip(places).for_each(|(into, place)| *into = place);
    Ok(Outcome { initial_cost, cost: current, chi2, iterations, is_converged })
}

/// Solves for the step and returns the expected decrease of the cost, `None` where the equations are singular.
fn take_step<const D: usize>(
    system: &System<D>,
    factorisation: &mut Factorisation<D>,
    damping: f64,
    step: &mut Vec<f64>,
) -> Option<f64> {
    if !factorisation.factorise(&system.blocks, damping) {
        return None;
    }
    step.clear();
    step.extend(system.gradient.iter().map(|value| -value));
    factorisation.solve(step);
    Some(expected_decrease(system, step, damping))
}

/// The decrease predicted by the linear equations: −2gᵀδ − δᵀHδ with (H + μ diag H) δ = −g.
fn expected_decrease<const D: usize>(system: &System<D>, step: &[f64], damping: f64) -> f64 {
    let slope: f64 = system.gradient.iter().zip(step).map(|(g, d)| g * d).sum();
    let damped = |(node, step): (usize, &[f64])| -> f64 {
        let block = &system.blocks[node];
        step.iter().enumerate().map(|(k, d)| block[(k, k)] * d * d).sum()
    };
    damping * step.chunks_exact(D).enumerate().map(damped).sum::<f64>() - slope
}

/// Applies the step to the vertices.
fn place_after<const D: usize>(
    places: &[Sim3],
    system: &System<D>,
    step: &[f64],
    moved: &mut [Sim3],
) {
    for ((place, moved), node) in places.iter().zip(moved).zip(&system.node_of) {
        *moved = node.map_or(*place, |node| *place * increment::<D>(&step[D * node..][..D]));
    }
}

fn increment<const D: usize>(step: &[f64]) -> Sim3 {
    let mut twist = Twist7::zeros();
    twist.as_mut_slice()[..D].copy_from_slice(step);
    Sim3::exp(&twist)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::sim3::Matrix7;
    use crate::slam::graph::pose_graph::Constraint;
    use crate::slam::graph::robust::RobustKernel;

    #[test]
    fn convergence_is_judged_without_damping() {
        let mut graph = PoseGraph::new();
        let i = graph.add_vertex(Sim3::identity(), true).unwrap();
        let off = Twist7::from([0.5, 0.0, 0.0, 0.0, 0.3, 0.0, 0.1]);
        let j = graph.add_vertex(Sim3::exp(&off), false).unwrap();
        let (j_from_i, kernel) = (Sim3::identity(), RobustKernel::None);
        let information = Matrix7::identity();
        graph.add_constraint(Constraint { i, j, j_from_i, information, kernel }).unwrap();
        // So much damping that the first step promises nothing.
        let outcome = solve_from::<7>(&mut graph, &GraphParams::default(), MAX_DAMPING).unwrap();
        assert!(outcome.is_converged && outcome.cost < 1e-12, "{outcome:?}");
        // Short of the optimum it does not report convergence.
        let mut short = graph.clone();
        short.places_mut().for_each(|place| *place = Sim3::exp(&off) * *place);
        let params = GraphParams { max_iterations: 1, ..GraphParams::default() };
        assert!(!solve_from::<7>(&mut short, &params, MAX_DAMPING).unwrap().is_converged);
    }
}
