//! The pose graph: keyframes at similarities, measurements between them, and the similarities that fit best (Engel,
//! Schöps, Cremers 2014, §3.6).
//!
//! [`optimise`] is the recipe: [`pose_graph`] is the problem, `residual` its error, [`robust`] bounds the effect of
//! false measurements; the normal equations are solved by a sparse Cholesky factorisation over blocks (`ordering`,
//! `fronts`, `factorisation`, `dense_kernel`) within Levenberg–Marquardt (`solver`). [`marginal`] gives the covariance
//! of the result. All sums are in a fixed order and no operation is fused: results do not depend on the vector unit.

pub mod constraint;
mod dense_kernel;
mod factorisation;
mod fronts;
pub mod marginal;
mod ordering;
pub mod pose_graph;
pub(crate) mod residual;
pub mod robust;
mod solver;
mod system;
#[cfg(test)]
mod tests;

use crate::slam::graph::pose_graph::{PoseGraph, VertexId};
use crate::slam::graph::solver::solve;
use crate::slam::graph::system::error;
use crate::slam::kernel::{Kernel, SimdMode};

/// Most memory of the equations of a graph, and of their factor with the updates that wait to be added to it, bytes
/// each: 1 GiB, a quarter of a small robot's. Public graphs of 5 000 keyframes need less; ten random constraints per
/// keyframe between as many need more.
pub const MAX_FACTOR_BYTES: usize = 1 << 30;

/// Parameters of the solver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GraphParams {
    /// Maximum number of factorisations.
    pub max_iterations: u32,
    /// Whether all keyframes have one unit, as with stereo: scales stay unchanged, and the scales of constraints are
    /// ignored.
    pub is_scale_known: bool,
    /// Instruction set of the factorisation; all give the same bits.
    pub kernel: Kernel,
}

impl Default for GraphParams {
    fn default() -> Self {
        Self {
            // A loop closure needs five to ten.
            max_iterations: 100,
            is_scale_known: false,
            kernel: Kernel::choose(SimdMode::Auto),
        }
    }
}

/// Result of an optimisation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Σ ρ(rᵀΛr) before.
    pub initial_cost: f64,
    /// Σ ρ(rᵀΛr) after.
    pub cost: f64,
    /// Σ rᵀΛr after, without robust kernels.
    pub chi2: f64,
    /// Number of factorisations.
    pub iterations: u32,
    /// Whether a step without damping would lower the cost by a negligible amount.
    pub is_converged: bool,
}

/// Why a graph is not solved; it is left unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SolveError {
    /// A vertex is connected to no fixed one, so its pose is not determined.
    #[error("vertex {} is not connected to a fixed one", .0.index())]
    Disconnected(VertexId),
    /// The initial errors are not finite.
    #[error("the errors of the constraints are not finite")]
    NotFinite,
    /// The equations or their factor would take more memory than [`MAX_FACTOR_BYTES`].
    #[error(
        "solving the graph takes more than {} MiB: its constraints connect too many keyframes far apart",
        MAX_FACTOR_BYTES >> 20
    )]
    TooLarge,
    /// The constraints do not determine all poses.
    #[error("the constraints do not determine the poses of all vertices")]
    Singular,
}

/// Moves the free vertices to where the constraints fit best. Where the iterations end before convergence, the best
/// poses so far are kept.
pub fn optimise(graph: &mut PoseGraph, params: &GraphParams) -> Result<Outcome, SolveError> {
    check_gauge(graph)?;
    if params.is_scale_known { solve::<6>(graph, params) } else { solve::<7>(graph, params) }
}

/// rᵀΛr of each constraint.
pub fn normalized_errors(graph: &PoseGraph) -> impl Iterator<Item = f64> {
    let places: Vec<_> = graph.vertices().iter().map(|v| v.map_from_keyframe).collect();
    graph.constraints().iter().map(move |constraint| error::<7>(constraint, &places))
}

/// Checks that every vertex is connected to a fixed one.
fn check_gauge(graph: &PoseGraph) -> Result<(), SolveError> {
    let mut neighbours = vec![Vec::new(); graph.vertices().len()];
    for constraint in graph.constraints() {
        let (i, j) = (constraint.i.index(), constraint.j.index());
        neighbours[i].push(j);
        neighbours[j].push(i);
    }
    let mut is_reached: Vec<bool> = graph.vertices().iter().map(|v| v.is_fixed).collect();
    let mut waiting: Vec<usize> = (0..is_reached.len()).filter(|&v| is_reached[v]).collect();
    while let Some(vertex) = waiting.pop() {
        for &other in &neighbours[vertex] {
            if !std::mem::replace(&mut is_reached[other], true) {
                waiting.push(other);
            }
        }
    }
    match is_reached.iter().position(|&is_reached| !is_reached) {
        Some(vertex) => Err(SolveError::Disconnected(VertexId(vertex))),
        None => Ok(()),
    }
}
