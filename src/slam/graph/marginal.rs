//! Covariances of the vertices of a pose graph.

use nalgebra::SMatrix;

use crate::slam::geometry::sim3::{Matrix7, Sim3};
use crate::slam::graph::factorisation::Factorisation;
use crate::slam::graph::pose_graph::{PoseGraph, VertexId};
use crate::slam::graph::system::System;
use crate::slam::graph::{GraphParams, MAX_FACTOR_BYTES, SolveError, check_gauge};

/// The equations at the current estimate of a graph, factorised; each query solves for one or two keyframes. Robust
/// kernels have their weights at the optimum; with known scale its variance is 0.
#[derive(Debug, Clone)]
pub struct Marginals {
    factor: Factor,
    places: Vec<Sim3>,
}

#[derive(Debug, Clone)]
enum Factor {
    Similarity(Queries<7>),
    Rigid(Queries<6>),
}

#[derive(Debug, Clone)]
struct Queries<const D: usize> {
    node_of: Vec<Option<usize>>,
    factorisation: Factorisation<D>,
    right: Vec<f64>,
}

impl Marginals {
    /// Factorises the equations of a graph at its current estimate, which should be the optimum.
    pub fn new(graph: &PoseGraph, params: &GraphParams) -> Result<Self, SolveError> {
        check_gauge(graph)?;
        let places: Vec<Sim3> = graph.vertices().iter().map(|v| v.map_from_keyframe).collect();
        let factor = if params.is_scale_known {
            Factor::Rigid(Queries::new(graph, &places, params)?)
        } else {
            Factor::Similarity(Queries::new(graph, &places, params)?)
        };
        Ok(Self { factor, places })
    }

    /// Covariance of the left increment (translation, rotation, log scale) of `a_from_b`; `None` where the graph lacks
    /// one of them.
    pub fn relative_covariance(&mut self, a: VertexId, b: VertexId) -> Option<Matrix7> {
        let (a, b) = (a.index(), b.index());
        // exp(−δ_a) a_from_b exp(δ_b) = exp(−δ_a + Ad(a_from_b) δ_b) a_from_b.
        let adjoint = (self.places.get(a)?.inverse() * *self.places.get(b)?).adjoint();
        let [aa, ba, bb] = self.joint(a, b);
        let cross = adjoint * ba;
        Some(aa - cross - cross.transpose() + adjoint * bb * adjoint.transpose())
    }

    /// Σ_aa, Σ_ba and Σ_bb of right increments.
    fn joint(&mut self, a: usize, b: usize) -> [Matrix7; 3] {
        match &mut self.factor {
            Factor::Similarity(queries) => queries.joint(a, b),
            Factor::Rigid(queries) => queries.joint(a, b),
        }
    }
}

impl<const D: usize> Queries<D> {
    fn new(graph: &PoseGraph, places: &[Sim3], params: &GraphParams) -> Result<Self, SolveError> {
        let mut system = System::<D>::new(graph)?;
        system.linearise(graph.constraints(), places);
        let (nodes, pairs) = (system.num_nodes(), &system.pairs);
        let mut factorisation = Factorisation::new(nodes, pairs, params.kernel, MAX_FACTOR_BYTES)?;
        if !factorisation.factorise(&system.blocks, 0.0) {
            return Err(SolveError::Singular);
        }
        Ok(Self { right: system.gradient, node_of: system.node_of, factorisation })
    }

    fn joint(&mut self, a: usize, b: usize) -> [Matrix7; 3] {
        let (aa, ba) = self.columns(a, b);
        let bb = if a == b { aa } else { self.columns(b, b).0 };
        [aa, ba, bb]
    }

    /// Columns of the inverse that belong to `a`: its own rows, and those of `b`. 0 for fixed vertices.
    fn columns(&mut self, a: usize, b: usize) -> (Matrix7, Matrix7) {
        let (mut own, mut other) = (Matrix7::zeros(), Matrix7::zeros());
        let Some(node) = self.node_of[a] else { return (own, other) };
        for column in 0..D {
            self.right.fill(0.0);
            self.right[D * node + column] = 1.0;
            self.factorisation.solve(&mut self.right);
            let copy = |from: Option<usize>, into: &mut Matrix7| {
                let Some(from) = from else { return };
                let values = SMatrix::<f64, D, 1>::from_column_slice(&self.right[D * from..][..D]);
                into.fixed_view_mut::<D, 1>(0, column).copy_from(&values);
            };
            copy(Some(node), &mut own);
            copy(self.node_of[b], &mut other);
        }
        (own, other)
    }
}
