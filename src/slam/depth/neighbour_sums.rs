//! Sums over the 5×5 neighbourhoods of several pixels of a row at once, for the regularisation.
//!
//! Quantities of a single pixel, above all its weight at each distance, are computed once per row, not once per
//! neighbour: a division costs more than all the rest.

use crate::slam::depth::map::Hypothesis;

/// Half width of the 5×5 neighbourhood.
pub(super) const RADIUS: usize = 2;

/// Rows of the neighbourhood.
pub(super) const WINDOW_ROWS: usize = 2 * RADIUS + 1;

/// Pixels that are summed at once.
pub(super) const LANES: usize = 16;

/// Squared distances within the neighbourhood, pixels².
const SQUARED_DISTANCES: [f32; 6] = [0.0, 1.0, 2.0, 4.0, 5.0, 8.0];

/// Index of a neighbour's squared distance, by the absolute differences in row and column.
const INDEX_OF_DISTANCE: [[usize; RADIUS + 1]; RADIUS + 1] = [[0, 1, 3], [1, 2, 4], [3, 4, 5]];

/// Keeps the weight of an exact pixel finite: far below any variance that a match can have.
const MIN_VARIANCE: f32 = 1e-12;

/// A row of the map before smoothing, by quantity, followed by a block without hypotheses.
#[derive(Debug, Clone)]
pub(super) struct RowPlanes {
    inverse_depth: Vec<f32>,
    /// −∞ where there is no hypothesis, with which nothing is consistent.
    pub(super) variance: Vec<f32>,
    /// 1 where there is a hypothesis, else 0.
    present: Vec<f32>,
    /// 1/(σ² + s² r²) for each distance r; 0 where there is no hypothesis.
    weights: [Vec<f32>; SQUARED_DISTANCES.len()],
    /// 1/(σ² + s² d²), and the same times d and times d², to fill holes; 0 where there is no hypothesis.
    filling: [Vec<f32>; 3],
}

impl RowPlanes {
    /// A row without hypotheses.
    pub(super) fn with_width(width: usize) -> Self {
        let length = width + LANES + RADIUS;
        let zeros = vec![0.0; length];
        Self {
            inverse_depth: zeros.clone(),
            variance: vec![f32::NEG_INFINITY; length],
            present: zeros.clone(),
            weights: std::array::from_fn(|_| zeros.clone()),
            filling: std::array::from_fn(|_| zeros.clone()),
        }
    }

    /// Loads a row of the map; neighbours differ by `distance_std_dev` (s above) per pixel.
    #[inline(always)]
    pub(super) fn fill(&mut self, row: &[Hypothesis], distance_std_dev: f32) {
        let spread = distance_std_dev * distance_std_dev;
        let (blocks, rest) = row.as_chunks::<LANES>();
        for (block, hypotheses) in blocks.iter().enumerate() {
            self.fill_block(block * LANES, hypotheses, spread);
        }
        if !rest.is_empty() {
            let mut last = [Hypothesis::NONE; LANES];
            last[..rest.len()].copy_from_slice(rest);
            self.fill_block(blocks.len() * LANES, &last, spread);
        }
    }

    /// Loads the block of pixels starting at `first`; `spread` is s².
    #[inline(always)]
    fn fill_block(&mut self, first: usize, hypotheses: &[Hypothesis; LANES], spread: f32) {
        let (mut d, mut variance, mut present) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        for k in 0..LANES {
            (d[k], variance[k]) = (hypotheses[k].inverse_depth, hypotheses[k].variance);
        }
        let mut is_any = false;
        for k in 0..LANES {
            present[k] = if variance[k] >= 0.0 { 1.0 } else { 0.0 };
            is_any |= variance[k] >= 0.0;
        }
        store(&mut self.inverse_depth, first, &d);
        store(&mut self.present, first, &present);
        if !is_any {
            store(&mut self.variance, first, &[f32::NEG_INFINITY; LANES]);
            let planes = self.weights.iter_mut().chain(&mut self.filling);
            planes.for_each(|plane| store(plane, first, &[0.0; LANES]));
            return;
        }
        for (plane, squared) in self.weights.iter_mut().zip(SQUARED_DISTANCES) {
            let mut weights = [0.0; LANES];
            for k in 0..LANES {
                weights[k] = present[k] / (variance[k].max(MIN_VARIANCE) + spread * squared);
            }
            store(plane, first, &weights);
        }
        let mut moments = [[0.0; LANES]; 3];
        for k in 0..LANES {
            let weight = present[k] / (variance[k].max(0.0) + spread * d[k] * d[k]);
            // A hypothesis with zero variance at infinity gets no weight.
            let weight = if weight < f32::INFINITY { weight } else { 0.0 };
            moments[0][k] = weight;
            moments[1][k] = weight * d[k];
            moments[2][k] = weight * d[k] * d[k];
        }
        for (plane, moment) in self.filling.iter_mut().zip(&moments) {
            store(plane, first, moment);
        }
        for k in 0..LANES {
            variance[k] = if variance[k] >= 0.0 { variance[k] } else { f32::NEG_INFINITY };
        }
        store(&mut self.variance, first, &variance);
    }
}

/// Writes values into a plane, starting at `first`; the plane has room for them.
#[inline(always)]
fn store(plane: &mut [f32], first: usize, values: &[f32; LANES]) {
    plane[first..first + LANES].copy_from_slice(values);
}

/// The values of a plane, starting at `first`.
#[inline(always)]
fn lanes(plane: &[f32], first: usize) -> [f32; LANES] {
    let mut values = [0.0; LANES];
    values.copy_from_slice(&plane[first..first + LANES]);
    values
}

/// Sums over the consistent neighbours of [`LANES`] pixels; each pixel is its own neighbour.
pub(super) struct SmoothingSums {
    pub(super) weighted: [f32; LANES],
    pub(super) weights: [f32; LANES],
    pub(super) count: [f32; LANES],
}

impl SmoothingSums {
    /// The weighted means; NaN where no neighbour is consistent.
    #[inline(always)]
    pub(super) fn smoothed(&self) -> [f32; LANES] {
        let mut means = [0.0; LANES];
        for k in 0..LANES {
            means[k] = self.weighted[k] / self.weights[k];
        }
        means
    }
}

/// The sums of the pixels starting at `first` in the middle row. Neighbours are consistent if they differ by at most
/// one joint standard deviation, with `slack` times the inverse depth added in quadrature.
#[inline(always)]
pub(super) fn smoothing_sums(
    around: &[&RowPlanes; WINDOW_ROWS],
    first: usize,
    slack: f32,
) -> SmoothingSums {
    let centre = lanes(&around[RADIUS].inverse_depth, first);
    let mut allowed = lanes(&around[RADIUS].variance, first);
    for k in 0..LANES {
        let tolerance = slack * centre[k];
        allowed[k] += tolerance * tolerance;
    }
    let (mut weighted, mut weights, mut count) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
    for (y, row) in around.iter().enumerate() {
        for x in 0..WINDOW_ROWS {
            let place = INDEX_OF_DISTANCE[y.abs_diff(RADIUS)][x.abs_diff(RADIUS)];
            let from = first + x - RADIUS;
            let (depths, variances) = (lanes(&row.inverse_depth, from), lanes(&row.variance, from));
            let by_distance = lanes(&row.weights[place], from);
            for k in 0..LANES {
                let difference = depths[k] - centre[k];
                // Without branches, so that the loop vectorises.
                let consistent = difference * difference <= allowed[k] + variances[k];
                let taken = if consistent { 1.0 } else { 0.0 };
                let weight = taken * by_distance[k];
                weighted[k] += weight * depths[k];
                weights[k] += weight;
                count[k] += taken;
            }
        }
    }
    SmoothingSums { weighted, weights, count }
}

#[inline(always)]
fn add(sums: &mut [f32; LANES], values: &[f32; LANES]) {
    for k in 0..LANES {
        sums[k] += values[k];
    }
}

/// Sums over all neighbours with a hypothesis, of [`LANES`] pixels.
pub(super) struct FillingSums {
    pub(super) weights: [f32; LANES],
    pub(super) weighted: [f32; LANES],
    pub(super) squares: [f32; LANES],
    pub(super) count: [f32; LANES],
}

impl FillingSums {
    /// A bit for each pixel that has at least this many neighbours.
    #[inline(always)]
    pub(super) fn at_least(&self, neighbours: f32) -> u32 {
        (0..LANES).fold(0, |bits, k| bits | u32::from(self.count[k] >= neighbours) << k)
    }
}

/// The sums of the pixels starting at `first` in the middle row.
#[inline(always)]
pub(super) fn filling_sums(around: &[&RowPlanes; WINDOW_ROWS], first: usize) -> FillingSums {
    let zeros = [0.0; LANES];
    let [mut weights, mut weighted, mut squares, mut count] = [zeros; 4];
    for row in around {
        for x in 0..WINDOW_ROWS {
            let from = first + x - RADIUS;
            add(&mut weights, &lanes(&row.filling[0], from));
            add(&mut weighted, &lanes(&row.filling[1], from));
            add(&mut squares, &lanes(&row.filling[2], from));
            add(&mut count, &lanes(&row.present, from));
        }
    }
    FillingSums { weights, weighted, squares, count }
}
