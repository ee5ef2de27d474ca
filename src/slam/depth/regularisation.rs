//! Smooths the map over consistent neighbours, drops what stands alone and fills small holes
//! (Engel, Sturm, Cremers 2013 §2.6).
//!
//! Only the published value is smoothed: the filtered one and its variance stay, so that smoothing
//! never pretends to an observation.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::slam::depth::gaussian::NEW_VALIDITY;
use crate::slam::depth::map::{BORDER_PX, DepthMap, Hypothesis};
use crate::slam::depth::smoothing_kernel::sums_kernel;
use crate::slam::image::buffer::Image;
use crate::slam::parameter::{ParameterError, check_range};

/// Half width of the 5×5 neighbourhood.
const RADIUS: usize = 2;

/// Tuning of the regularisation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RegularisationParams {
    /// Standard deviation by which neighbouring inverse depths differ, a pixel of distance, in units
    /// of the mean inverse depth (Engel, Schöps, Cremers 2014's value).
    pub distance_std_dev: f32,
    /// Neighbours belong together when they differ by less than one joint standard deviation plus this
    /// share of their inverse depth: slanted surfaces are not steps.
    pub surface_slack_ratio: f32,
    /// A hypothesis with fewer consistent neighbours is dropped.
    pub min_neighbours: u8,
    /// A hole with at least so many consistent neighbours is filled.
    pub min_fill_neighbours: u8,
}

impl Default for RegularisationParams {
    fn default() -> Self {
        Self {
            distance_std_dev: 0.075,
            surface_slack_ratio: 0.02,
            min_neighbours: 3,
            min_fill_neighbours: 6,
        }
    }
}

impl RegularisationParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("distance_std_dev", self.distance_std_dev, 1e-4..=10.0)?;
        check_range("surface_slack_ratio", self.surface_slack_ratio, 0.0..=1.0)?;
        check_range("min_neighbours", self.min_neighbours, 0..=24)?;
        check_range("min_fill_neighbours", self.min_fill_neighbours, 1..=24)
    }
}

/// Memory of the regularisation: the map as it was before, as planes.
#[derive(Debug, Clone)]
pub struct RegularisationScratch {
    inverse_depth: Image<f32>,
    /// Negative where there is no hypothesis.
    variance: Image<f32>,
}

impl RegularisationScratch {
    /// For maps of this size.
    pub fn with_size(width: usize, height: usize) -> Self {
        Self {
            inverse_depth: Image::filled(width, height, 0.0),
            variance: Image::filled(width, height, -1.0),
        }
    }
}

/// Regularises `map`. Rows are independent of each other: the result does not depend on the number
/// of threads.
pub fn regularise(
    map: &mut DepthMap,
    scratch: &mut RegularisationScratch,
    params: &RegularisationParams,
) {
    let (width, height) = (map.image.width(), map.image.height());
    let RegularisationScratch { inverse_depth, variance } = scratch;
    let (hypotheses, candidates) = (&mut map.hypotheses, &map.candidates);
    let planes = inverse_depth.pixels_mut().par_chunks_exact_mut(width);
    let planes = planes.zip(variance.pixels_mut().par_chunks_exact_mut(width));
    planes.zip(hypotheses.pixels().par_chunks_exact(width)).for_each(|((d, variance), row)| {
        for ((d, variance), hypothesis) in d.iter_mut().zip(variance).zip(row) {
            (*d, *variance) = (hypothesis.inverse_depth, hypothesis.variance);
        }
    });
    let before = Neighbourhood { inverse_depth, variance, params };
    let sum_neighbours = sums_kernel();
    hypotheses.pixels_mut().par_chunks_exact_mut(width).enumerate().for_each(|(v, row)| {
        if !(BORDER_PX..height - BORDER_PX).contains(&v) {
            return;
        }
        let present = before.variance.row(v);
        let candidates = candidates.row(v);
        for first in (BORDER_PX..width - BORDER_PX).step_by(LANES) {
            let block = first..(first + LANES).min(width - BORDER_PX);
            if present[block.clone()].iter().any(|&variance| variance >= 0.0) {
                // The last block is summed with some of the one before it, so that it is whole.
                let whole = first.min(width - BORDER_PX - LANES);
                let sums = sum_neighbours(&before, whole, v);
                for u in block.clone().filter(|&u| present[u] >= 0.0) {
                    smooth(&mut row[u], &sums, u - whole, params);
                }
            }
            for u in block.filter(|&u| candidates[u] && !(present[u] >= 0.0)) {
                before.fill(&mut row[u], u, v);
            }
        }
    });
}

/// Keeps the weight of a certain pixel finite: far below any variance a match can have.
const LEAST_VARIANCE: f32 = 1e-12;

/// Pixels that are summed at a time.
pub(super) const LANES: usize = 8;

/// The map before smoothing.
pub(super) struct Neighbourhood<'a> {
    inverse_depth: &'a Image<f32>,
    variance: &'a Image<f32>,
    params: &'a RegularisationParams,
}

/// Sums over the consistent neighbours of [`LANES`] pixels, each pixel its own neighbour.
pub(super) struct NeighbourSums {
    weighted: [f32; LANES],
    weights: [f32; LANES],
    count: [f32; LANES],
}

impl Neighbourhood<'_> {
    /// The sums of the pixels from `first` on in row `v`.
    #[inline(always)]
    pub(super) fn sums(&self, first: usize, v: usize) -> NeighbourSums {
        let spread = self.params.distance_std_dev * self.params.distance_std_dev;
        let slack = self.params.surface_slack_ratio;
        let window = first - RADIUS..first + LANES + RADIUS;
        let row = |image: &'_ Image<f32>, y: usize| -> [f32; LANES + 2 * RADIUS] {
            let mut values = [0.0; LANES + 2 * RADIUS];
            values.copy_from_slice(&image.row(y)[window.clone()]);
            values
        };
        let (depths, variances) = (row(self.inverse_depth, v), row(self.variance, v));
        let (mut centre, mut allowed) = ([0.0; LANES], [0.0; LANES]);
        for k in 0..LANES {
            centre[k] = depths[k + RADIUS];
            let tolerance = slack * centre[k];
            allowed[k] = variances[k + RADIUS] + tolerance * tolerance;
        }
        let (mut weighted, mut weights, mut count) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        for y in v - RADIUS..=v + RADIUS {
            let (depths, variances) = (row(self.inverse_depth, y), row(self.variance, y));
            for x in 0..=2 * RADIUS {
                let (dx, dy) = (x as f32 - RADIUS as f32, y as f32 - v as f32);
                let distance = spread * (dx * dx + dy * dy);
                for k in 0..LANES {
                    let (d, variance) = (depths[k + x], variances[k + x]);
                    let difference = d - centre[k];
                    let squared = difference * difference;
                    // Without branches, so that the lanes go together.
                    let consistent = (variance >= 0.0) & (squared <= allowed[k] + variance);
                    let taken = if consistent { 1.0 } else { 0.0 };
                    let weight = taken / (variance.max(LEAST_VARIANCE) + distance);
                    weighted[k] += weight * d;
                    weights[k] += weight;
                    count[k] += taken;
                }
            }
        }
        NeighbourSums { weighted, weights, count }
    }
}

/// Smooths the hypothesis whose sums stand at `lane`, or drops it for want of neighbours.
fn smooth(
    hypothesis: &mut Hypothesis,
    sums: &NeighbourSums,
    lane: usize,
    params: &RegularisationParams,
) {
    // The pixel itself is among the consistent ones.
    let few = sums.count[lane] <= f32::from(params.min_neighbours);
    if few || !(sums.weights[lane] > 0.0) {
        hypothesis.reject();
    } else {
        hypothesis.smoothed = sums.weighted[lane] / sums.weights[lane];
    }
}

impl Neighbourhood<'_> {
    /// Gives a pixel without hypothesis the mean of its neighbours, where they are many and agree.
    fn fill(&self, out: &mut Hypothesis, u: usize, v: usize) {
        /// Failures after which neighbours' depth is not tried again: the pixel is something else.
        const MAX_FAILURES: u8 = 2;
        if out.failures > MAX_FAILURES {
            return;
        }
        let (rows, columns) = (v - RADIUS..=v + RADIUS, u - RADIUS..=u + RADIUS);
        let neighbours: u8 = rows
            .clone()
            .flat_map(|y| &self.variance.row(y)[columns.clone()])
            .map(|&variance| u8::from(variance >= 0.0))
            .sum();
        if neighbours < self.params.min_fill_neighbours {
            return;
        }
        let spread = self.params.distance_std_dev * self.params.distance_std_dev;
        let (mut sum, mut squares, mut weights) = (0.0f32, 0.0f32, 0.0f32);
        for y in rows {
            let variances = &self.variance.row(y)[columns.clone()];
            let depths = &self.inverse_depth.row(y)[columns.clone()];
            for (&d, &variance) in depths.iter().zip(variances).filter(|(_, v)| **v >= 0.0) {
                let weight = 1.0 / (variance + spread * d * d);
                sum += weight * d;
                squares += weight * d * d;
                weights += weight;
            }
        }
        let mean = sum / weights;
        let variance = (squares / weights - mean * mean).max(0.0) + f32::from(neighbours) / weights;
        // Neighbours on two surfaces say nothing of which one the hole is on.
        const MAX_STD_DEV_RATIO: f32 = 0.15;
        if variance > (MAX_STD_DEV_RATIO * mean).powi(2) {
            return;
        }
        *out = Hypothesis {
            inverse_depth: mean,
            variance,
            smoothed: mean,
            validity: NEW_VALIDITY / 2,
            propagated: false,
            failures: out.failures,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map() -> DepthMap {
        let mut map = DepthMap::with_size(32, 32);
        map.candidates.pixels_mut().fill(true);
        map
    }

    fn put(map: &mut DepthMap, u: usize, v: usize, d: f32, variance: f32) {
        map.hypotheses.pixels_mut()[v * 32 + u] = Hypothesis {
            inverse_depth: d,
            variance,
            smoothed: d,
            validity: 5,
            propagated: false,
            failures: 0,
        };
    }

    fn run(map: &mut DepthMap) {
        let mut scratch = RegularisationScratch::with_size(32, 32);
        regularise(map, &mut scratch, &RegularisationParams::default());
    }

    #[test]
    fn noise_is_smoothed_but_the_filtered_value_stays() {
        let mut map = map();
        for v in 8..24 {
            for u in 8..24 {
                let noise = if (u * 7 + v * 13) % 2 == 0 { 0.05 } else { -0.05 };
                put(&mut map, u, v, 1.0 + noise, 0.01);
            }
        }
        run(&mut map);
        let h = map.hypotheses.at(16, 16);
        assert!((h.smoothed - 1.0).abs() < 0.03 && (h.inverse_depth - 1.0).abs() > 0.049);
        assert_eq!(h.variance, 0.01);
    }

    #[test]
    fn a_step_in_depth_is_kept_and_a_lone_point_dropped() {
        let mut map = map();
        for v in 8..24 {
            for u in 8..24 {
                put(&mut map, u, v, if u < 16 { 1.0 } else { 2.0 }, 1e-4);
            }
        }
        put(&mut map, 12, 12, 5.0, 1e-4);
        run(&mut map);
        assert!((map.hypotheses.at(15, 16).smoothed - 1.0).abs() < 1e-3);
        assert!((map.hypotheses.at(16, 16).smoothed - 2.0).abs() < 1e-3);
        assert!(!map.hypotheses.at(12, 12).is_some());
    }

    #[test]
    fn a_small_hole_is_filled_with_no_more_certainty_than_its_rim() {
        let mut map = map();
        for v in 8..24 {
            for u in 8..24 {
                put(&mut map, u, v, 1.0, 1e-4);
            }
        }
        map.hypotheses.pixels_mut()[16 * 32 + 16] = Hypothesis::NONE;
        run(&mut map);
        let h = map.hypotheses.at(16, 16);
        assert!(h.is_some() && (h.inverse_depth - 1.0).abs() < 1e-4 && h.variance >= 1e-4);
        assert!(!map.hypotheses.at(28, 28).is_some());
    }
}
