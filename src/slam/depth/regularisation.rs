//! Smooths the map over consistent neighbours, drops isolated hypotheses and fills small holes (Engel, Sturm, Cremers
//! 2013 §2.6).
//!
//! Only the published value is smoothed: the filtered one and its variance stay, so that smoothing never counts as an
//! observation.

use std::ops::Range;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::slam::depth::gaussian::NEW_VALIDITY;
use crate::slam::depth::gradient_image::{BAND_ROWS, BORDER_PX};
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::depth::neighbour_sums::{
    FillingSums, LANES, RADIUS, RowPlanes, SmoothingSums, WINDOW_ROWS, filling_sums, smoothing_sums,
};
use crate::slam::image::buffer::Image;
use crate::slam::kernel::{Body, Instructions, Kernel};
use crate::slam::parameter::{ParameterError, check_range};

/// Tuning of the regularisation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RegularisationParams {
    /// Standard deviation of the difference of neighbouring inverse depths per pixel of distance, in units of the mean
    /// inverse depth (the value of Engel, Schöps, Cremers 2014).
    pub distance_std_dev: f32,
    /// Neighbours are consistent if they differ by at most one joint standard deviation, with this share of their
    /// inverse depth added in quadrature: slanted surfaces are not steps.
    pub surface_slack_ratio: f32,
    /// A hypothesis with fewer consistent neighbours is dropped.
    pub min_neighbours: u8,
    /// A hole with at least this many neighbours is filled.
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

/// Memory of the regularisation.
#[derive(Debug, Clone)]
pub struct RegularisationScratch {
    bands: Vec<BandScratch>,
}

/// Memory for one band of rows.
#[derive(Debug, Clone)]
struct BandScratch {
    /// The rows around the current one, at their number modulo the window size.
    window: [RowPlanes; WINDOW_ROWS],
    /// The rows above and below the band before smoothing: other threads change them.
    above: Vec<Hypothesis>,
    below: Vec<Hypothesis>,
}

impl RegularisationScratch {
    /// Allocates for maps of this size.
    pub fn with_size(width: usize, height: usize) -> Self {
        let window = std::array::from_fn(|_| RowPlanes::with_width(width));
        let band = BandScratch { window, above: Vec::new(), below: Vec::new() };
        Self { bands: vec![band; height.div_ceil(BAND_ROWS)] }
    }
}

/// Regularises `map`. Rows are independent of each other: the result does not depend on the number of threads.
pub fn regularise(
    map: &mut DepthMap,
    scratch: &mut RegularisationScratch,
    params: &RegularisationParams,
) {
    regularise_with(Kernel::fastest(), map, scratch, params);
}

fn regularise_with(
    kernel: Kernel,
    map: &mut DepthMap,
    scratch: &mut RegularisationScratch,
    params: &RegularisationParams,
) {
    let (width, height) = (map.image.width(), map.image.height());
    let (hypotheses, candidates) = (&mut map.hypotheses, &map.candidates);
    for (band, scratch) in scratch.bands.iter_mut().enumerate() {
        let (first, end) = (band * BAND_ROWS, ((band + 1) * BAND_ROWS).min(height));
        let rows = |rows: Range<usize>| &hypotheses.pixels()[rows.start * width..rows.end * width];
        scratch.above.clear();
        scratch.above.extend_from_slice(rows(first.saturating_sub(RADIUS)..first));
        scratch.below.clear();
        scratch.below.extend_from_slice(rows(end..(end + RADIUS).min(height)));
    }
    let bands = hypotheses.pixels_mut().par_chunks_mut(BAND_ROWS * width).enumerate();
    bands.zip(&mut scratch.bands).for_each(|((band, rows), scratch)| {
        let BandScratch { window, above, below } = scratch;
        let first = band * BAND_ROWS;
        let rows = Band { candidates, width, height, first, rows, above, below, window, params };
        kernel.run(rows);
    });
}

/// A band of rows of the map, regularised in place.
struct Band<'a> {
    candidates: &'a Image<bool>,
    width: usize,
    height: usize,
    /// Number of its first row.
    first: usize,
    rows: &'a mut [Hypothesis],
    above: &'a [Hypothesis],
    below: &'a [Hypothesis],
    window: &'a mut [RowPlanes; WINDOW_ROWS],
    params: &'a RegularisationParams,
}

impl Body for Band<'_> {
    type Output = ();

    /// Smooths, drops and fills row by row; the window keeps the rows before these changes.
    #[inline(always)]
    fn run<I: Instructions>(mut self, _: I) {
        let (first, end) = (self.first, self.first + self.rows.len() / self.width);
        let inner = first.max(BORDER_PX)..end.min(self.height - BORDER_PX);
        let mut next = inner.start - RADIUS;
        for v in inner {
            while next <= v + RADIUS {
                self.load(next);
                next += 1;
            }
            self.regularise_row(v);
        }
    }
}

impl Band<'_> {
    /// Loads the current row `v` into the window.
    #[inline(always)]
    fn load(&mut self, v: usize) {
        let (first, end) = (self.first, self.first + self.rows.len() / self.width);
        let at = |from: usize| (v - from) * self.width..(v - from + 1) * self.width;
        let row = if v < first {
            // All rows in `above` end where the band begins.
            &self.above[at(first - self.above.len() / self.width)]
        } else if v >= end {
            &self.below[at(end)]
        } else {
            &self.rows[at(first)]
        };
        self.window[v % WINDOW_ROWS].fill(row, self.params.distance_std_dev);
    }

    #[inline(always)]
    fn regularise_row(&mut self, v: usize) {
        let (width, params) = (self.width, self.params);
        let window = &*self.window;
        let around: [&RowPlanes; WINDOW_ROWS] =
            std::array::from_fn(|y| &window[(v + y - RADIUS) % WINDOW_ROWS]);
        let row = &mut self.rows[(v - self.first) * width..(v - self.first + 1) * width];
        let candidates = self.candidates.row(v);
        let present = &around[RADIUS].variance;
        for first in (BORDER_PX..width - BORDER_PX).step_by(LANES) {
            let block = first..(first + LANES).min(width - BORDER_PX);
            let (mut known, mut holes) = (0u32, 0u32);
            for (k, (&variance, &is_candidate)) in
                present[block.clone()].iter().zip(&candidates[block.clone()]).enumerate()
            {
                known |= u32::from(variance >= 0.0) << k;
                holes |= u32::from(!(variance >= 0.0) & is_candidate) << k;
            }
            let row = &mut row[block];
            if known != 0 {
                let sums = smoothing_sums(&around, first, params.surface_slack_ratio);
                let smoothed = sums.smoothed();
                for_each_bit(known, |k| smooth(&mut row[k], &sums, smoothed[k], k, params));
            }
            if holes != 0 {
                let sums = filling_sums(&around, first);
                let enough = sums.at_least(f32::from(params.min_fill_neighbours));
                for_each_bit(holes & enough, |k| fill(&mut row[k], &sums, k));
            }
        }
    }
}

/// Calls `take` with the positions of the set bits, ascending: one branch misprediction at the end instead of one
/// per bit.
#[inline(always)]
fn for_each_bit(mut bits: u32, mut take: impl FnMut(usize)) {
    while bits != 0 {
        take(bits.trailing_zeros() as usize);
        bits &= bits - 1;
    }
}

/// Gives the hypothesis whose sums are at `lane` their mean, or drops it for lack of neighbours.
#[inline(always)]
fn smooth(
    hypothesis: &mut Hypothesis,
    sums: &SmoothingSums,
    smoothed: f32,
    lane: usize,
    params: &RegularisationParams,
) {
    // The pixel itself is among the consistent ones.
    let few = sums.count[lane] <= f32::from(params.min_neighbours);
    if few || !(sums.weights[lane] > 0.0) {
        hypothesis.reject();
    } else {
        hypothesis.smoothed = smoothed;
    }
}

/// Gives a pixel without hypothesis the mean of its neighbours if they agree; the caller has checked their number.
#[inline(always)]
fn fill(out: &mut Hypothesis, sums: &FillingSums, lane: usize) {
    /// Failures after which the neighbours' depth is not tried again: the pixel shows something else.
    const MAX_FAILURES: u8 = 2;
    let neighbours = sums.count[lane];
    if out.failures > MAX_FAILURES {
        return;
    }
    let weights = sums.weights[lane];
    let mean = sums.weighted[lane] / weights;
    let scatter = (sums.squares[lane] / weights - mean * mean).max(0.0);
    let variance = scatter + neighbours / weights;
    // Neighbours on two surfaces do not tell which one the hole is on.
    const MAX_STD_DEV_RATIO: f32 = 0.15;
    if !(variance <= (MAX_STD_DEV_RATIO * mean).powi(2)) {
        return;
    }
    *out = Hypothesis {
        inverse_depth: mean,
        variance,
        independent: scatter,
        smoothed: mean,
        validity: NEW_VALIDITY / 2,
        propagated: false,
        failures: out.failures,
    };
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
            independent: variance,
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

    /// The scalar reference: pixel by pixel, neighbour by neighbour.
    fn regularised(map: &DepthMap, params: &RegularisationParams) -> Vec<Hypothesis> {
        let (width, height) = (map.image.width(), map.image.height());
        let before = &map.hypotheses;
        let mut after = before.pixels().to_vec();
        let inner = |v: usize| (BORDER_PX..width - BORDER_PX).map(move |u| (u, v));
        for (u, v) in (BORDER_PX..height - BORDER_PX).flat_map(inner) {
            let spread = params.distance_std_dev * params.distance_std_dev;
            let centre = before.at(u, v);
            let (mut sum, mut squares, mut weights, mut count) = (0.0, 0.0, 0.0, 0.0);
            let window = (v - 2..=v + 2).flat_map(|y| (u - 2..=u + 2).map(move |x| (x, y)));
            for (x, y) in window {
                let h = before.at(x, y);
                let d = h.inverse_depth;
                let squared = (x.abs_diff(u).pow(2) + y.abs_diff(v).pow(2)) as f32;
                let tolerance = params.surface_slack_ratio * centre.inverse_depth;
                let allowed = centre.variance + tolerance * tolerance + h.variance;
                let difference = d - centre.inverse_depth;
                let weight = match centre.is_some() {
                    true if difference * difference <= allowed => h.variance + spread * squared,
                    true => continue,
                    false => h.variance + spread * d * d,
                };
                if h.is_some() {
                    let weight = 1.0 / weight.max(1e-12);
                    sum += weight * d;
                    squares += weight * d * d;
                    weights += weight;
                    count += 1.0;
                }
            }
            let out = &mut after[v * width + u];
            if centre.is_some() {
                match count <= f32::from(params.min_neighbours) {
                    true => out.reject(),
                    false => out.smoothed = sum / weights,
                }
            } else if map.candidates.at(u, v) && count >= f32::from(params.min_fill_neighbours) {
                let sums = FillingSums {
                    weights: [weights; LANES],
                    weighted: [sum; LANES],
                    squares: [squares; LANES],
                    count: [count; LANES],
                };
                fill(out, &sums, 0);
            }
        }
        after
    }

    #[test]
    fn every_version_gives_the_bits_of_the_scalar_reference() {
        // Width not a multiple of the lanes, height more than a band.
        let (width, height) = (83, 2 * BAND_ROWS + 7);
        let mut map = DepthMap::with_size(width, height);
        let mut state = 1u32;
        let mut random = |below: u32| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) % below
        };
        for i in 0..width * height {
            map.candidates.pixels_mut()[i] = random(10) < 8;
            let failures = random(5) as u8;
            // Dense and sparse parts, two surfaces, every degree of certainty.
            let is_some = random(10) < if i % width < 40 { 7 } else { 2 };
            let surface = if (i / 7) % 13 < 10 { 1.0 } else { 1.6 };
            let inverse_depth = surface + random(100) as f32 * 1e-3;
            let variance = [0.0, 1e-6, 1e-4, 1e-2][random(4) as usize];
            let known = Hypothesis {
                inverse_depth,
                variance,
                independent: variance,
                smoothed: 0.5,
                validity: 9,
                ..Hypothesis::NONE
            };
            map.hypotheses.pixels_mut()[i] =
                Hypothesis { failures, ..if is_some { known } else { Hypothesis::NONE } };
        }
        let params = RegularisationParams::default();
        let expected = regularised(&map, &params);
        let bits = |h: &Hypothesis| {
            let floats = [h.inverse_depth, h.variance, h.smoothed].map(f32::to_bits);
            (floats, h.validity, h.failures)
        };
        let filled = |(h, before): (&Hypothesis, &Hypothesis)| h.is_some() && !before.is_some();
        let dropped = |(h, before): (&Hypothesis, &Hypothesis)| !h.is_some() && before.is_some();
        let pairs = || expected.iter().zip(map.hypotheses.pixels());
        assert!(pairs().filter(|p| filled(*p)).count() > 100);
        assert!(pairs().filter(|p| dropped(*p)).count() > 100);
        for kernel in Kernel::available() {
            let mut found = map.clone();
            let mut scratch = RegularisationScratch::with_size(width, height);
            // Twice with the same memory: nothing of the first run may remain in it.
            for _ in 0..2 {
                found.hypotheses = map.hypotheses.clone();
                regularise_with(kernel, &mut found, &mut scratch, &params);
            }
            assert!(found.hypotheses.pixels().iter().map(bits).eq(expected.iter().map(bits)));
        }
    }
}
