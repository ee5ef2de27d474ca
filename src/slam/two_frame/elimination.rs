//! Elimination of the depths from the normal equations, and the priors that hold them without parallax.
//!
//! Each depth is coupled only to the pose (Schur complement): with D_i the damped information of depth i and m_i its
//! row of mixed terms,
//!
//! ```text
//! (H − Σ m_i m_iᵀ/D_i) δ = −(g − Σ m_i g_i/D_i)        δd_i = −(g_i + m_iᵀδ)/D_i
//! ```
//!
//! Two priors make D_i positive: a depth lies near the median of its neighbours and, loosely, near 1; the second also
//! fixes the scale, which the images leave free.

use nalgebra::SVector;

use crate::slam::two_frame::lanes::{
    LANES, LaneSum, Lanes, NUM_UNKNOWNS, NormalSums, lanes, lanes_of,
};
use crate::slam::two_frame::points::{NUM_NEIGHBOURS, NeighbourBlock};
use crate::slam::two_frame::system::System;

/// Smallest and largest inverse depth, the mean being 1. Negative ones are meaningless; a point that reaches them
/// indicates a wrong minimum.
const INVERSE_DEPTHS: (f32, f32) = (-2.0, 10.0);

/// Weights of the two priors, in the squared grey levels of the energy.
#[derive(Debug, Clone, Copy, Default)]
pub struct PriorWeights {
    /// Weight of the distance from the neighbours' median.
    pub neighbour: f32,
    /// Weight of the distance from 1.
    pub depth: f32,
}

/// The depths' part of one step.
#[derive(Debug, Default)]
pub struct Elimination {
    /// Weights of the priors.
    pub weights: PriorWeights,
    /// Factor on the information of the images, 1 + λ.
    pub damping_factor: f32,
    /// Σ m_i m_iᵀ/D_i and Σ m_i g_i/D_i.
    pub sums: NormalSums,
    /// 1/D_i and g_i/D_i.
    inverse_information: Vec<Lanes>,
    slopes: Vec<Lanes>,
}

impl Elimination {
    /// Eliminates the depths of `system`.
    #[inline(always)]
    pub(super) fn reduce(&mut self, system: &System, inverse_depths: &[f32], medians: &[f32]) {
        self.sums = NormalSums::default();
        self.inverse_information.clear();
        self.slopes.clear();
        let weights = self.weights;
        let num_unknowns = system.num_unknowns();
        for (i, block) in system.blocks.iter().enumerate() {
            let (d, median) = (lanes_of(inverse_depths, i, 1.0), lanes_of(medians, i, 1.0));
            let inverse = lanes(|l| {
                let prior = weights.neighbour + weights.depth;
                1.0 / (block.information[l] * self.damping_factor + prior)
            });
            let slope = lanes(|l| {
                let by_prior =
                    weights.neighbour * (d[l] - median[l]) + weights.depth * (d[l] - 1.0);
                (block.gradient[l] + by_prior) * inverse[l]
            });
            for r in 0..num_unknowns {
                let scaled = lanes(|l| block.mixed[r][l] * inverse[l]);
                self.sums.add_row(r, &lanes(|l| block.mixed[r][l] * slope[l]));
                for c in 0..=r {
                    self.sums.add_entry(r, c, &lanes(|l| scaled[l] * block.mixed[c][l]));
                }
            }
            self.inverse_information.push(inverse);
            self.slopes.push(slope);
        }
    }

    /// Writes the depths after the pose's step; returns their part −Σ g_i δd_i of the predicted decrease.
    pub fn depths_after(
        &self,
        system: &System,
        inverse_depths: &[f32],
        step: &SVector<f64, NUM_UNKNOWNS>,
        after: &mut Vec<f32>,
    ) -> f64 {
        /// Largest change of a depth in one step: beyond it the projection is far from linear.
        const MAX_DEPTH_STEP: f32 = 0.5;
        let step: [f32; NUM_UNKNOWNS] = std::array::from_fn(|k| step[k] as f32);
        after.clear();
        let mut predicted = LaneSum::default();
        let num_unknowns = system.num_unknowns();
        for (i, block) in system.blocks.iter().enumerate() {
            let d = lanes_of(inverse_depths, i, 1.0);
            let mut by_pose = [0.0; LANES];
            for k in 0..num_unknowns {
                for l in 0..LANES {
                    by_pose[l] += block.mixed[k][l] * step[k];
                }
            }
            let changed = lanes(|l| {
                let change = -(self.slopes[i][l] + by_pose[l] * self.inverse_information[i][l]);
                (d[l] + change.clamp(-MAX_DEPTH_STEP, MAX_DEPTH_STEP))
                    .clamp(INVERSE_DEPTHS.0, INVERSE_DEPTHS.1)
            });
            after.extend_from_slice(&changed);
            predicted.add(&lanes(|l| {
                let gradient = self.slopes[i][l] / self.inverse_information[i][l];
                -gradient * (changed[l] - d[l])
            }));
        }
        after.truncate(inverse_depths.len());
        predicted.total()
    }
}

/// Energy of the priors.
pub fn prior_energy(inverse_depths: &[f32], medians: &[f32], weights: PriorWeights) -> f64 {
    let mut sum = LaneSum::default();
    for i in 0..inverse_depths.len().div_ceil(LANES) {
        let (d, median) = (lanes_of(inverse_depths, i, 1.0), lanes_of(medians, i, 1.0));
        sum.add(&lanes(|l| {
            let (by_neighbours, by_mean) = (d[l] - median[l], d[l] - 1.0);
            weights.neighbour * by_neighbours * by_neighbours + weights.depth * by_mean * by_mean
        }));
    }
    sum.total()
}

/// The comparisons that sort eight numbers (a network of 19, the minimum).
const SORTING_NETWORK: [(usize, usize); 19] = [
    (0, 2),
    (1, 3),
    (4, 6),
    (5, 7),
    (0, 4),
    (1, 5),
    (2, 6),
    (3, 7),
    (0, 1),
    (2, 3),
    (4, 5),
    (6, 7),
    (2, 4),
    (3, 5),
    (1, 4),
    (3, 6),
    (1, 2),
    (3, 4),
    (5, 6),
];

/// Median inverse depth of each point's neighbours.
#[inline(always)]
pub(super) fn neighbour_medians(
    neighbours: &[NeighbourBlock],
    inverse_depths: &[f32],
    medians: &mut Vec<f32>,
) {
    medians.clear();
    for block in neighbours {
        let mut sorted = [[0.0; LANES]; NUM_NEIGHBOURS];
        for (out, indices) in sorted.iter_mut().zip(block) {
            *out = lanes(|l| inverse_depths[indices[l] as usize]);
        }
        for (low, high) in SORTING_NETWORK {
            let (a, b) = (sorted[low], sorted[high]);
            sorted[low] = lanes(|l| if a[l] < b[l] { a[l] } else { b[l] });
            sorted[high] = lanes(|l| if a[l] < b[l] { b[l] } else { a[l] });
        }
        let (lower, upper) = (sorted[NUM_NEIGHBOURS / 2 - 1], sorted[NUM_NEIGHBOURS / 2]);
        medians.extend_from_slice(&lanes(|l| 0.5 * (lower[l] + upper[l])));
    }
    medians.truncate(inverse_depths.len());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_network_finds_the_median_of_eight() {
        let values: Vec<f32> = (0..64u32).map(|i| (i * 2_654_435_761 % 1009) as f32).collect();
        let block: NeighbourBlock =
            std::array::from_fn(|j| std::array::from_fn(|l| ((j * 37 + l * 11) % 64) as u32));
        let mut medians = Vec::new();
        neighbour_medians(&[block], &values, &mut medians);
        for (l, median) in medians.iter().take(LANES).enumerate() {
            let mut sorted: Vec<f32> = block.iter().map(|j| values[j[l] as usize]).collect();
            sorted.sort_by(f32::total_cmp);
            assert_eq!(*median, 0.5 * (sorted[3] + sorted[4]), "{l}");
        }
    }
}
