//! Smooths the map over consistent neighbours, drops what stands alone and fills small holes
//! (Engel, Sturm, Cremers 2013 §2.6).
//!
//! Only the published value is smoothed: the filtered one and its variance stay, so that smoothing
//! never pretends to an observation.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::slam::depth::gaussian::NEW_VALIDITY;
use crate::slam::depth::map::{BORDER_PX, DepthMap, Hypothesis};
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

/// Regularises `map`; `scratch` is memory of the same size. Rows are independent of each other.
pub fn regularise(
    map: &mut DepthMap,
    scratch: &mut Image<Hypothesis>,
    params: &RegularisationParams,
) {
    let (width, height) = (map.image.width(), map.image.height());
    let (before, candidates) = (&map.hypotheses, &map.candidates);
    scratch.pixels_mut().par_chunks_exact_mut(width).enumerate().for_each(|(v, row)| {
        row.copy_from_slice(before.row(v));
        if !(BORDER_PX..height - BORDER_PX).contains(&v) {
            return;
        }
        for (u, out) in row.iter_mut().enumerate().take(width - BORDER_PX).skip(BORDER_PX) {
            if out.is_some() {
                smooth(out, before, u, v, params);
            } else if candidates.at(u, v) {
                fill(out, before, u, v, params);
            }
        }
    });
    std::mem::swap(&mut map.hypotheses, scratch);
}

/// Whether two inverse depths can lie on one surface.
#[inline]
fn is_consistent(a: &Hypothesis, b: &Hypothesis, slack: f32) -> bool {
    let difference = a.inverse_depth - b.inverse_depth;
    let tolerance = slack * a.inverse_depth;
    difference * difference <= a.variance + b.variance + tolerance * tolerance
}

fn smooth(
    out: &mut Hypothesis,
    before: &Image<Hypothesis>,
    u: usize,
    v: usize,
    params: &RegularisationParams,
) {
    let centre = *out;
    let spread = params.distance_std_dev * params.distance_std_dev;
    let (mut sum, mut weights, mut neighbours) = (0.0, 0.0, 0u8);
    for y in v - RADIUS..=v + RADIUS {
        for (x, other) in before.row(y)[u - RADIUS..=u + RADIUS].iter().enumerate() {
            if !other.is_some() || !is_consistent(&centre, other, params.surface_slack_ratio) {
                continue;
            }
            let (dx, dy) = (x as f32 - RADIUS as f32, y as f32 - v as f32);
            let weight = 1.0 / (other.variance + spread * (dx * dx + dy * dy));
            sum += weight * other.inverse_depth;
            weights += weight;
            neighbours += 1;
        }
    }
    // The pixel itself is among the consistent ones.
    if neighbours <= params.min_neighbours || !(weights > 0.0) {
        out.reject();
    } else {
        out.smoothed = sum / weights;
    }
}

fn fill(
    out: &mut Hypothesis,
    before: &Image<Hypothesis>,
    u: usize,
    v: usize,
    params: &RegularisationParams,
) {
    /// Failures after which neighbours' depth is not tried again: the pixel is something else.
    const MAX_FAILURES: u8 = 2;
    if out.failures > MAX_FAILURES {
        return;
    }
    let spread = params.distance_std_dev * params.distance_std_dev;
    let (mut sum, mut squares, mut weights, mut neighbours) = (0.0f32, 0.0f32, 0.0f32, 0u8);
    for y in v - RADIUS..=v + RADIUS {
        for other in before.row(y)[u - RADIUS..=u + RADIUS].iter().filter(|h| h.is_some()) {
            let weight = 1.0 / (other.variance + spread);
            sum += weight * other.inverse_depth;
            squares += weight * other.inverse_depth * other.inverse_depth;
            weights += weight;
            neighbours += 1;
        }
    }
    if neighbours < params.min_fill_neighbours {
        return;
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
        let mut scratch = map.hypotheses.clone();
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
