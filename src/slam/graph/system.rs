//! The normal equations of a pose graph at its current estimate.

use std::collections::BTreeMap;

use nalgebra::SMatrix;

use crate::slam::geometry::sim3::Sim3;
use crate::slam::graph::pose_graph::{Constraint, PoseGraph};
use crate::slam::graph::residual::{linearise, part, residual, squared_error};
use crate::slam::graph::{MAX_FACTOR_BYTES, SolveError};

/// H and g of Σ ρ(rᵀΛr) over the first `D` parts of the residuals: H = Σ ρ' JᵀΛJ, g = Σ ρ' JᵀΛr.
#[derive(Debug, Clone)]
pub(super) struct System<const D: usize> {
    /// By vertex: its index among the free ones.
    pub node_of: Vec<Option<usize>>,
    /// Off-diagonal blocks of H: (row, column), the later node first.
    pub pairs: Vec<(usize, usize)>,
    /// H: the diagonal blocks, then those of `pairs`.
    pub blocks: Vec<SMatrix<f64, D, D>>,
    /// g.
    pub gradient: Vec<f64>,
    /// By constraint: its off-diagonal block.
    block_of: Vec<Option<usize>>,
}

impl<const D: usize> System<D> {
    /// Sets up the structure of the equations; their blocks may take [`MAX_FACTOR_BYTES`].
    pub fn new(graph: &PoseGraph) -> Result<Self, SolveError> {
        let mut free = 0..;
        let number = |is_fixed: bool, free: &mut std::ops::RangeFrom<usize>| {
            if is_fixed { None } else { free.next() }
        };
        let node_of: Vec<Option<usize>> =
            graph.vertices().iter().map(|vertex| number(vertex.is_fixed, &mut free)).collect();
        let num_nodes = free.start;
        let pair_of = |constraint: &Constraint| {
            let (i, j) = (node_of[constraint.i.index()]?, node_of[constraint.j.index()]?);
            Some((i.max(j), i.min(j)))
        };
        let mut pairs: BTreeMap<(usize, usize), usize> =
            graph.constraints().iter().filter_map(pair_of).map(|pair| (pair, 0)).collect();
        pairs.values_mut().zip(num_nodes..).for_each(|(block, number)| *block = number);
        let block_of =
            graph.constraints().iter().map(|c| pair_of(c).map(|pair| pairs[&pair])).collect();
        let num_blocks = num_nodes + pairs.len();
        if num_blocks > MAX_FACTOR_BYTES / size_of::<SMatrix<f64, D, D>>() {
            return Err(SolveError::TooLarge);
        }
        Ok(Self {
            blocks: vec![SMatrix::zeros(); num_blocks],
            gradient: vec![0.0; D * num_nodes],
            pairs: pairs.into_keys().collect(),
            node_of,
            block_of,
        })
    }

    /// Number of free vertices.
    pub fn num_nodes(&self) -> usize {
        self.gradient.len() / D
    }

    /// Fills in the equations at `places`.
    pub fn linearise(&mut self, constraints: &[Constraint], places: &[Sim3]) {
        self.blocks.fill(SMatrix::zeros());
        self.gradient.fill(0.0);
        for (constraint, block) in constraints.iter().zip(&self.block_of) {
            let (i, j) = (constraint.i.index(), constraint.j.index());
            let (node_i, node_j) = (self.node_of[i], self.node_of[j]);
            if node_i.is_none() && node_j.is_none() {
                continue;
            }
            let at = linearise(&constraint.j_from_i, &places[i], &places[j]);
            let error = squared_error::<D>(&at.value, &constraint.information);
            let weight = constraint.kernel.at(error).weight;
            let information = part::<D>(&constraint.information) * weight;
            let (by_i, by_j) = (part::<D>(&at.d_value_d_i), part::<D>(&at.d_value_d_j));
            let value = information * at.value.fixed_rows::<D>(0);
            let (weighted_i, weighted_j) = (information * by_i, information * by_j);
            for (node, by, weighted) in [(node_i, by_i, weighted_i), (node_j, by_j, weighted_j)] {
                let Some(node) = node else { continue };
                self.blocks[node] += by.tr_mul(&weighted);
                let into = self.gradient[D * node..][..D].iter_mut();
                into.zip(by.tr_mul(&value).iter()).for_each(|(into, value)| *into += value);
            }
            if let Some(block) = block {
                let is_i_later = node_i > node_j;
                self.blocks[*block] +=
                    if is_i_later { by_i.tr_mul(&weighted_j) } else { by_j.tr_mul(&weighted_i) };
            }
        }
    }
}

/// Σ ρ(rᵀΛr) over the first `D` parts of the residuals at `places`.
pub(super) fn cost<const D: usize>(constraints: &[Constraint], places: &[Sim3]) -> f64 {
    let of = |constraint: &Constraint| constraint.kernel.at(error::<D>(constraint, places)).cost;
    constraints.iter().map(of).sum()
}

/// rᵀΛr of one constraint.
pub(super) fn error<const D: usize>(constraint: &Constraint, places: &[Sim3]) -> f64 {
    let (i, j) = (constraint.i.index(), constraint.j.index());
    let value = residual(&constraint.j_from_i, &places[i], &places[j]);
    squared_error::<D>(&value, &constraint.information)
}
