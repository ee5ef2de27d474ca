//! Finds the keyframes that see the same part of the scene, without considering every pair.

use std::collections::BTreeMap;

use crate::slam::fusion::view::View;

/// Points of a keyframe that represent its view.
const SAMPLES: usize = 64;
/// Side of a cell of space, in mean distances of the map's points from their keyframes: a keyframe's view fills a dozen
/// or so.
const CELL_RATIO: f64 = 0.5;
/// Keyframes of a cell that are compared: a camera that stands still for hours fills a cell with thousands.
const MAX_IN_CELL: usize = 64;
/// Least share of the cells of a keyframe's samples in which another has samples too.
const MIN_SHARED: f64 = 0.15;

/// For each view at most `most` others that see the same part of the scene: half of them those that share most, and
/// half spread over the run, as consecutive keyframes share the errors of their depth.
pub(super) fn neighbours(views: &[View<'_>], most: usize) -> Vec<Vec<usize>> {
    let samples: Vec<Vec<[f64; 3]>> = views.iter().map(samples_of).collect();
    let distances = views.iter().zip(&samples).flat_map(|(view, samples)| {
        let from = view.keyframe.map_from_keyframe.rigid.translation;
        samples.iter().map(move |at| (nalgebra::Vector3::from(*at) - from).norm())
    });
    let (sum, count) =
        distances.fold((0.0, 0.0), |(sum, count), distance| (sum + distance, count + 1.0));
    let cell = (CELL_RATIO * sum / f64::max(count, 1.0)).max(f64::MIN_POSITIVE);
    let cells: Vec<Vec<[i64; 3]>> = samples.iter().map(|samples| cells_of(samples, cell)).collect();
    let mut of_cell: BTreeMap<[i64; 3], Vec<usize>> = BTreeMap::new();
    for (i, cells) in cells.iter().enumerate() {
        cells.iter().for_each(|&cell| of_cell.entry(cell).or_default().push(i));
    }
    (0..views.len()).map(|i| chosen(i, &cells[i], &of_cell, most)).collect()
}

/// Positions of some points of a view, map units.
fn samples_of(view: &View<'_>) -> Vec<[f64; 3]> {
    /// Steps of this share of a list spread over it whatever the width of the image.
    const GOLDEN_RATIO: f64 = 0.618_033_988_749_895;
    let points = &view.keyframe.points;
    let place = |i: usize| (i as f64 * GOLDEN_RATIO).fract() * points.len() as f64;
    let chosen = (0..SAMPLES.min(points.len())).filter_map(|i| points.get(place(i) as usize));
    let usable = chosen.filter(|point| point.inverse_depth > 0.0);
    let placed = usable.map(|point| {
        let ray = view.ray(f64::from(point.u), f64::from(point.v));
        let at = view.keyframe.map_from_keyframe * (ray / f64::from(point.inverse_depth));
        [at.x, at.y, at.z]
    });
    placed.filter(|at| at.iter().all(|c| c.is_finite())).collect()
}

fn cells_of(samples: &[[f64; 3]], cell: f64) -> Vec<[i64; 3]> {
    let mut cells: Vec<[i64; 3]> =
        samples.iter().map(|at| at.map(|c| (c / cell).floor() as i64)).collect();
    cells.sort_unstable();
    cells.dedup();
    cells
}

fn chosen(
    of: usize,
    cells: &[[i64; 3]],
    of_cell: &BTreeMap<[i64; 3], Vec<usize>>,
    most: usize,
) -> Vec<usize> {
    let mut shared: BTreeMap<usize, usize> = BTreeMap::new();
    for cell in cells {
        let all = of_cell.get(cell).map_or(&[][..], Vec::as_slice);
        let step = all.len().div_ceil(MAX_IN_CELL).max(1);
        for &other in all.iter().step_by(step).filter(|&&other| other != of) {
            *shared.entry(other).or_default() += 1;
        }
    }
    let enough = (MIN_SHARED * cells.len() as f64).ceil() as usize;
    let mut sharing: Vec<(usize, usize)> =
        shared.into_iter().filter(|&(_, count)| count >= enough).collect();
    sharing.sort_by_key(|&(other, count)| (std::cmp::Reverse(count), other.abs_diff(of), other));
    let rest = sharing.split_off(sharing.len().min(most.div_ceil(2)));
    let mut chosen: Vec<usize> = sharing.into_iter().map(|(other, _)| other).collect();
    let mut rest: Vec<usize> = rest.into_iter().map(|(other, _)| other).collect();
    rest.sort_unstable();
    let wanted = (most - chosen.len()).min(rest.len());
    chosen.extend((0..wanted).map(|i| rest[i * rest.len() / wanted]));
    chosen.sort_unstable();
    chosen
}
