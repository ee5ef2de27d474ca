//! Spreads the depths of a few points over the candidate pixels around them.

use rayon::prelude::*;

use crate::slam::depth::gaussian::NEW_VALIDITY;
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::two_frame::InitialDepth;

/// Side of the cells for looking up points, pixels; neighbours are found at most one cell away.
const CELL_PX: usize = 16;
/// Points from which a pixel takes its depth.
const NUM_NEAREST: usize = 4;
/// Standard deviation of the difference of a surface's inverse depths per pixel of distance, relative.
const SLOPE_STD_DEV_RATIO: f32 = 0.002;

/// Variance of a pixel over the mean squared difference of the points around it: it lies between them, and mostly on
/// the surface of the nearest. Chosen by the share of true depths within one σ on recordings with depth.
const SPREAD_RATIO: f32 = 0.15;

/// Standard deviation of a pixel with a single point near it, relative.
const LONELY_STD_DEV_RATIO: f32 = 0.2;

/// Gives every candidate of `map` near a point a hypothesis: the nearest point's inverse depth, with a variance
/// increased by the distance and the differences between the nearest points.
pub fn spread(depths: &[InitialDepth], map: &mut DepthMap) {
    let (width, height) = (map.image.width(), map.image.height());
    let (columns, rows_of_cells) = (width.div_ceil(CELL_PX), height.div_ceil(CELL_PX));
    let mut cells: Vec<Vec<usize>> = vec![Vec::new(); columns * rows_of_cells];
    for (i, depth) in depths.iter().enumerate() {
        let (u, v) = (usize::from(depth.u), usize::from(depth.v));
        if u < width && v < height {
            cells[v / CELL_PX * columns + u / CELL_PX].push(i);
        }
    }
    let candidates = &map.candidates;
    let rows = map.hypotheses.pixels_mut().par_chunks_mut(width).enumerate();
    rows.for_each(|(v, hypotheses)| {
        let candidates = candidates.row(v);
        for (u, hypothesis) in hypotheses.iter_mut().enumerate().filter(|(u, _)| candidates[*u]) {
            let (column, row) = (u / CELL_PX, v / CELL_PX);
            let mut nearest = [(f32::INFINITY, 0); NUM_NEAREST];
            for y in row.saturating_sub(1)..(row + 2).min(rows_of_cells) {
                for x in column.saturating_sub(1)..(column + 2).min(columns) {
                    for &point in &cells[y * columns + x] {
                        insert(&mut nearest, squared_distance(&depths[point], u, v), point);
                    }
                }
            }
            if nearest[0].0.is_finite() {
                *hypothesis = hypothesis_from(depths, &nearest);
            }
        }
    });
}

fn squared_distance(depth: &InitialDepth, u: usize, v: usize) -> f32 {
    let (du, dv) = (f32::from(depth.u) - u as f32, f32::from(depth.v) - v as f32);
    du * du + dv * dv
}

fn insert(nearest: &mut [(f32, usize); NUM_NEAREST], distance: f32, point: usize) {
    let place = nearest.partition_point(|n| n.0 <= distance);
    if place < NUM_NEAREST {
        nearest[place..].rotate_right(1);
        nearest[place] = (distance, point);
    }
}

fn hypothesis_from(depths: &[InitialDepth], nearest: &[(f32, usize); NUM_NEAREST]) -> Hypothesis {
    let (squared_distance, index) = nearest[0];
    let point = &depths[index];
    let on_point = squared_distance == 0.0;
    let mut spread = 0.0;
    if !on_point {
        let others = nearest.iter().skip(1).filter(|n| n.0.is_finite());
        let squared = |n: &(f32, usize)| (depths[n.1].inverse_depth - point.inverse_depth).powi(2);
        let (sum, count) = others.fold((0.0, 0u8), |(s, c), n| (s + squared(n), c + 1));
        let alone = (LONELY_STD_DEV_RATIO * point.inverse_depth).powi(2);
        spread = if count == 0 { alone } else { SPREAD_RATIO * sum / f32::from(count) };
    }
    let slope = SLOPE_STD_DEV_RATIO * point.inverse_depth;
    let variance = point.variance + spread + slope * slope * squared_distance;
    Hypothesis {
        inverse_depth: point.inverse_depth,
        variance,
        independent: variance - point.variance,
        smoothed: point.inverse_depth,
        validity: NEW_VALIDITY,
        // The pixels around a point have not been searched in the second frame.
        propagated: on_point,
        failures: 0,
    }
}
