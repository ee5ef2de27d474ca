//! One point per spot of a surface: of points closer than the width of their cells the most certain stays, and isolated
//! ones are removed.

use rayon::prelude::*;

use crate::slam::fusion::grid::Grid;
use crate::slam::fusion::voxels::{Gathered, side};

/// Least distance of two points, in sides of the larger one's cell: a surface along a face of the grid has points in
/// the cells on both sides of it.
const SPACING: f64 = 0.7;
/// Distance within which a point needs others, in sides of its cell.
const COMPANY_RADIUS: f64 = 4.0;

/// A point that is kept, with its position as written.
type Placed = ([f32; 3], Gathered);

/// The points, in order of their cells, that keep their distance and have `company` others around; in the same order.
pub(super) fn spaced(points: &[Gathered], company: usize) -> Vec<Placed> {
    let mut kept: Vec<Placed> = Vec::new();
    for of_octave in points.chunk_by(|a, b| a.cell.octave() == b.cell.octave()) {
        // Cells are in ascending order of size: the points kept so far are more certain.
        let largest = SPACING * side(of_octave[of_octave.len() - 1].cell.level);
        let mut grid = Grid::new(2.0 * largest, kept.len() + of_octave.len());
        kept.iter().for_each(|(position, _)| grid.push(*position));
        let mut order: Vec<&Gathered> = of_octave.iter().collect();
        order.sort_unstable_by(|a, b| {
            let level = a.cell.level.cmp(&b.cell.level);
            let known = b.keyframes.cmp(&a.keyframes).then(a.sigma.total_cmp(&b.sigma));
            level.then(known).then(a.cell.cmp(&b.cell))
        });
        for point in order {
            let position = point.position().map(|c| c as f32);
            let mut is_free = true;
            grid.near(position, SPACING * side(point.cell.level), &mut |_| {
                is_free = false;
                false
            });
            if is_free {
                grid.push(position);
                kept.push((position, *point));
            }
        }
    }
    with_company(kept, company)
}

fn with_company(points: Vec<Placed>, company: usize) -> Vec<Placed> {
    let mut stays = Vec::with_capacity(points.len());
    for of_octave in points.chunk_by(|a, b| a.1.cell.octave() == b.1.cell.octave()) {
        let largest = COMPANY_RADIUS * side(of_octave[of_octave.len() - 1].1.cell.level);
        let mut grid = Grid::new(largest, points.len());
        points.iter().for_each(|(position, _)| grid.push(*position));
        stays.par_extend(of_octave.par_iter().map(|(position, of)| {
            // The point itself is one of them.
            let mut found = 0;
            grid.near(*position, COMPANY_RADIUS * side(of.cell.level), &mut |_| {
                found += 1;
                found <= company
            });
            found > company
        }));
    }
    points.into_iter().zip(stays).filter(|&(_, stays)| stays).map(|(point, _)| point).collect()
}
