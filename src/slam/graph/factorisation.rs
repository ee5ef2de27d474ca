//! Sparse Cholesky factorisation of a block matrix, by fronts.

use nalgebra::SMatrix;

use crate::slam::graph::SolveError;
use crate::slam::graph::dense_kernel::{NotPositive, Part};
use crate::slam::graph::fronts::{Front, Plan};
use crate::slam::kernel::Kernel;

/// The factor of a symmetric positive definite matrix with blocks of `D` × `D`, and the memory to compute it.
#[derive(Debug, Clone)]
pub(super) struct Factorisation<const D: usize> {
    plan: Plan,
    kernel: Kernel,
    /// By front: the columns eliminated in it, with all its rows.
    factors: Vec<Vec<f64>>,
    /// By front: its update of the parent, until the parent has taken it.
    rests: Vec<Vec<f64>>,
    packed: Vec<f64>,
    diagonal: Vec<f64>,
    local: Vec<f64>,
}

impl<const D: usize> Factorisation<D> {
    /// For a matrix of `num_nodes` diagonal blocks and a block for each of `pairs` (row, column), which are distinct;
    /// allocates nothing large if that would exceed `most_bytes`.
    pub fn new(
        num_nodes: usize,
        pairs: &[(usize, usize)],
        kernel: Kernel,
        most_bytes: usize,
    ) -> Result<Self, SolveError> {
        let most_blocks = most_bytes / size_of::<SMatrix<f64, D, D>>();
        let plan = Plan::new(num_nodes, pairs, most_blocks)
            .filter(|plan| plan.most_blocks() <= most_blocks)
            .ok_or(SolveError::TooLarge)?;
        let sizes = plan.fronts.iter().map(|front| D * D * front.nodes.len() * front.num_pivots);
        Ok(Self {
            kernel,
            factors: sizes.map(|size| vec![0.0; size]).collect(),
            rests: vec![Vec::new(); plan.fronts.len()],
            packed: Vec::new(),
            diagonal: Vec::new(),
            local: Vec::new(),
            plan,
        })
    }

    /// Factorises the matrix with these blocks, diagonal ones first, with each diagonal element enlarged by the share
    /// `damping`. Returns false, and there is no factor, where it is not positive definite.
    pub fn factorise(&mut self, blocks: &[SMatrix<f64, D, D>], damping: f64) -> bool {
        for number in 0..self.plan.fronts.len() {
            let front = &self.plan.fronts[number];
            let size = D * front.nodes.len();
            let others = size - D * front.num_pivots;
            let mut factor = std::mem::take(&mut self.factors[number]);
            let mut rest = vec![0.0; others * others];
            factor.fill(0.0);
            enter(front, blocks, damping, &mut factor);
            self.diagonal.clear();
            self.diagonal.extend((0..D * front.num_pivots).map(|k| factor[k * size + k]));
            for child in &front.children {
                let from = std::mem::take(&mut self.rests[child.front]);
                extend_add::<D>(front, &child.places, &from, &mut factor, &mut rest);
            }
            let (factor_of, rest_of) = (&mut factor, &mut rest);
            let (least, packed) = (&self.diagonal, &mut self.packed);
            let part = Part { size, least, factor: factor_of, rest: rest_of, packed };
            let done = self.kernel.run(part);
            self.factors[number] = factor;
            self.rests[number] = rest;
            if let Err(NotPositive(_)) = done {
                return false;
            }
        }
        true
    }

    /// Solves for a right-hand side in node order, in place.
    pub fn solve(&mut self, values: &mut [f64]) {
        for (front, factor) in self.plan.fronts.iter().zip(&self.factors) {
            let (size, pivots) = (D * front.nodes.len(), D * front.num_pivots);
            self.local.clear();
            for &node in &front.nodes[..front.num_pivots] {
                self.local.extend_from_slice(&values[D * node..][..D]);
            }
            self.local.resize(size, 0.0);
            for column in 0..pivots {
                let of = &factor[column * size + column..(column + 1) * size];
                let (value, below) = self.local[column..].split_first_mut().expect("a pivot");
                *value /= of[0];
                for (entry, factor) in below.iter_mut().zip(&of[1..]) {
                    *entry -= factor * *value;
                }
            }
            for (index, &node) in front.nodes.iter().enumerate() {
                let from = &self.local[D * index..][..D];
                let into = values[D * node..][..D].iter_mut();
                if index < front.num_pivots {
                    into.zip(from).for_each(|(into, from)| *into = *from);
                } else {
                    into.zip(from).for_each(|(into, from)| *into += from);
                }
            }
        }
        for (front, factor) in self.plan.fronts.iter().zip(&self.factors).rev() {
            let (size, pivots) = (D * front.nodes.len(), D * front.num_pivots);
            self.local.clear();
            for &node in &front.nodes {
                self.local.extend_from_slice(&values[D * node..][..D]);
            }
            for column in (0..pivots).rev() {
                let of = &factor[column * size + column..(column + 1) * size];
                let (value, below) = self.local[column..].split_first_mut().expect("a pivot");
                for (entry, factor) in below.iter().zip(&of[1..]) {
                    *value -= factor * entry;
                }
                *value /= of[0];
            }
            for (index, &node) in front.nodes[..front.num_pivots].iter().enumerate() {
                values[D * node..][..D].copy_from_slice(&self.local[D * index..][..D]);
            }
        }
    }
}

/// Writes the blocks of the matrix that belong to a front.
fn enter<const D: usize>(
    front: &Front,
    blocks: &[SMatrix<f64, D, D>],
    damping: f64,
    factor: &mut [f64],
) {
    let size = D * front.nodes.len();
    for entry in &front.entries {
        let block = &blocks[entry.block];
        for c in 0..D {
            let column = &mut factor[(D * entry.column + c) * size + D * entry.row..][..D];
            for (r, value) in column.iter_mut().enumerate() {
                *value = if entry.is_transposed { block[(c, r)] } else { block[(r, c)] };
            }
            if entry.row == entry.column {
                column[c] *= 1.0 + damping;
            }
        }
    }
}

/// Adds the lower right part of a child.
fn extend_add<const D: usize>(
    front: &Front,
    places: &[usize],
    from: &[f64],
    factor: &mut [f64],
    rest: &mut [f64],
) {
    let size = D * front.nodes.len();
    let pivots = D * front.num_pivots;
    let (others, from_size) = (size - pivots, D * places.len());
    for (j, &place) in places.iter().enumerate() {
        for c in 0..D {
            let column = D * place + c;
            let from = &from[(D * j + c) * from_size..][..from_size];
            // The column of the front from its first stored row.
            let (into, above) = if column < pivots {
                (&mut factor[column * size..][..size], 0)
            } else {
                (&mut rest[(column - pivots) * others..][..others], pivots)
            };
            for (i, &row) in places.iter().enumerate().skip(j) {
                let into = &mut into[D * row - above..][..D];
                for (into, from) in into.iter_mut().zip(&from[D * i..][..D]) {
                    *into += from;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::slam::test_scene::Random;

    #[test]
    fn solutions_match_the_dense_matrix() {
        const D: usize = 3;
        for seed in 0..30u64 {
            let mut random = Random::new(seed);
            let nodes = 1 + seed as usize * 2;
            let mut pairs = Vec::new();
            for row in 0..nodes {
                for column in 0..row {
                    // A chain, and more blocks the higher the seed; some with the row before the column.
                    if column + 1 == row || random.uniform() < seed as f64 / 300.0 {
                        let is_swapped = random.uniform() < 0.5;
                        pairs.push(if is_swapped { (column, row) } else { (row, column) });
                    }
                }
            }
            let mut blocks = vec![SMatrix::<f64, D, D>::zeros(); nodes + pairs.len()];
            let mut dense = DMatrix::zeros(D * nodes, D * nodes);
            for (index, &(row, column)) in pairs.iter().enumerate() {
                let block = SMatrix::<f64, D, D>::from_fn(|_, _| random.normal());
                blocks[nodes + index] = block;
                dense.view_mut((D * row, D * column), (D, D)).copy_from(&block);
                dense.view_mut((D * column, D * row), (D, D)).copy_from(&block.transpose());
            }
            for node in 0..nodes {
                let block = SMatrix::<f64, D, D>::identity() * (8.0 * nodes as f64);
                blocks[node] = block;
                dense.view_mut((D * node, D * node), (D, D)).copy_from(&(block * 1.5));
            }
            let right = DVector::from_fn(D * nodes, |_, _| random.normal());
            let expected = dense.clone().cholesky().expect("diagonally dominant").solve(&right);
            let new = |most| Factorisation::<D>::new(nodes, &pairs, Kernel::Portable, most);
            let mut factorisation = new(usize::MAX).unwrap();
            // Twice: the memory is reused.
            for _ in 0..2 {
                assert!(factorisation.factorise(&blocks, 0.5));
                let mut values = right.as_slice().to_vec();
                factorisation.solve(&mut values);
                let error = (DVector::from_vec(values) - &expected).norm() / expected.norm();
                assert!(error < 1e-12, "seed {seed}: {error}");
            }
            // Exactly as much as needed, and a byte less.
            let columns: usize = factorisation.factors.iter().map(|factor| 8 * factor.len()).sum();
            let bytes = factorisation.plan.most_blocks() * size_of::<SMatrix<f64, D, D>>();
            assert!(columns <= bytes, "seed {seed}: {columns} {bytes}");
            assert!(new(bytes).is_ok());
            assert_eq!(new(bytes - 1).err(), Some(SolveError::TooLarge));
        }
    }
}
