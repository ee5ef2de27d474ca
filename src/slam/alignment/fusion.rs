//! The depth pyramid: a parent's inverse depth is the inverse-variance weighted mean of its valid
//! children, its variance their harmonic mean n/Σ(1/V), because neighbours are correlated and
//! down-sampling must not gain information.
//!
//! Where depth jumps, an edge in the image moves with what is in front: children behind the
//! nearest one are left out, and so are pixels beside a nearer one.
//!
//! How much noise the mean really keeps is known only from the data: the scatter of children about
//! their parent says which share κ of their variance is independent. It averages down, the rest
//! stays: N_parent = N (κ/n + 1 − κ).

use crate::slam::image::sums::MAX_LEVELS;
use crate::slam::keyframe::{DepthPoint, MAX_KEYFRAME_POINTS};

/// One pixel with depth on some level.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Column on its level.
    pub u: u16,
    /// Row on its level.
    pub v: u16,
    /// Inverse depth, 1/keyframe units.
    pub inverse_depth: f32,
    /// Variance of the inverse depth.
    pub variance: f32,
    /// Variance of the noise that is left in the inverse depth, at most `variance`.
    pub noise: f32,
}

/// All pixels with depth of one level, row by row on the levels above 0.
#[derive(Debug, Clone, Default)]
pub struct Candidates {
    points: Vec<Candidate>,
}

impl Candidates {
    /// Number of pixels with depth.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// One of them.
    pub fn get(&self, index: usize) -> Candidate {
        self.points[index]
    }

    /// All of them.
    pub fn as_slice(&self) -> &[Candidate] {
        &self.points
    }

    /// Mean inverse depth, `None` without points.
    fn mean_inverse_depth(&self) -> Option<f64> {
        let sum: f64 = self.points.iter().map(|point| f64::from(point.inverse_depth)).sum();
        (!self.points.is_empty()).then(|| sum / self.points.len() as f64)
    }
}

/// Sums of the children of one parent.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    nearest: f32,
    nearest_noise: f32,
    information: f32,
    weighted: f32,
    weighted_square: f32,
    noise: f32,
    children: f32,
    is_behind: bool,
}

impl Cell {
    /// Whether depth jumps from the nearest child back to a pixel of this inverse depth and noise.
    fn is_in_front_of(&self, inverse_depth: f32, noise: f32) -> bool {
        let step = self.nearest - inverse_depth - JUMP_RATIO * self.nearest;
        step > 0.0 && step * step > JUMP_SIGMAS * JUMP_SIGMAS * (noise + self.nearest_noise)
    }

    /// Whether depth jumps from the mean of this cell back to that of `other`, in whose means
    /// `kept_…` of the children's noise is left.
    fn is_cell_in_front_of(&self, kept_here: f32, other: &Cell, kept_there: f32) -> bool {
        let (nearer, farther) = (self.inverse_depth(), other.inverse_depth());
        let step = nearer - farther - CELL_JUMP_RATIO * nearer;
        let noise =
            self.noise / self.children * kept_here + other.noise / other.children * kept_there;
        step > 0.0 && step * step > JUMP_SIGMAS * JUMP_SIGMAS * noise
    }

    /// Share of the children's noise that their mean keeps.
    fn kept_noise(&self, independent: f32) -> f32 {
        independent / self.children + 1.0 - independent
    }

    fn inverse_depth(&self) -> f32 {
        self.weighted / self.information
    }

    fn variance(&self) -> f32 {
        self.children / self.information
    }
}

/// Depth jumps where neighbours differ by this share of the nearer one's inverse depth (a wall seen
/// at 80° changes by about a hundredth a pixel at level 0) …
const JUMP_RATIO: f32 = 0.04;

/// The same between means of neighbouring cells, two pixels apart: more, because it costs all
/// pixels of a cell, and slanted surfaces are worth keeping.
const CELL_JUMP_RATIO: f32 = 0.15;

/// … and by this many standard deviations of the noise more.
const JUMP_SIGMAS: f32 = 3.0;

/// Builds the depth pyramid, in memory that is used again.
#[derive(Debug, Clone, Default)]
pub struct DepthFusion {
    levels: [Candidates; MAX_LEVELS],
    cells: Vec<Cell>,
    mean_inverse_depth: Option<f64>,
}

impl DepthFusion {
    /// Fuses `points` of a `width * height` image into `num_levels` levels. Points outside the
    /// image, or without a positive finite inverse depth and variance, are left out, as are those
    /// beyond [`MAX_KEYFRAME_POINTS`].
    pub fn fuse(&mut self, points: &[DepthPoint], width: usize, height: usize, num_levels: usize) {
        self.levels.iter_mut().for_each(|level| level.points.clear());
        let inside = |point: &&DepthPoint| {
            usize::from(point.u) < width
                && usize::from(point.v) < height
                && is_positive(point.inverse_depth)
                && is_positive(point.variance)
        };
        let base = points.iter().take(MAX_KEYFRAME_POINTS).filter(inside);
        self.levels[0].points.extend(base.map(|point| Candidate {
            u: point.u,
            v: point.v,
            inverse_depth: point.inverse_depth,
            variance: point.variance,
            noise: point.variance,
        }));
        self.mean_inverse_depth = self.levels[0].mean_inverse_depth();
        for level in 1..num_levels.min(MAX_LEVELS) {
            let (fine, coarse) = self.levels.split_at_mut(level);
            let (width, height) = (width >> level, height >> level);
            halve(&mut fine[level - 1], &mut coarse[0], &mut self.cells, width, height);
        }
    }

    /// Mean inverse depth of all points of level 0, `None` without points.
    pub fn mean_inverse_depth(&self) -> Option<f64> {
        self.mean_inverse_depth
    }

    /// The pixels with depth of one level.
    pub fn level(&self, level: usize) -> &Candidates {
        &self.levels[level]
    }
}

/// Bounds within which squares and reciprocals of an inverse depth or a variance stay finite.
fn is_positive(value: f32) -> bool {
    const SANE: std::ops::RangeInclusive<f32> = 1.0e-15..=1.0e15;
    SANE.contains(&value)
}

/// Fuses `fine` into `coarse`, and drops from `fine` what lies behind a jump in depth.
fn halve(
    fine: &mut Candidates,
    coarse: &mut Candidates,
    cells: &mut Vec<Cell>,
    width: usize,
    height: usize,
) {
    cells.clear();
    cells.resize(width * height, Cell::default());
    let cell_of = |child: &Candidate| {
        let (u, v) = (usize::from(child.u / 2), usize::from(child.v / 2));
        (u < width && v < height).then_some(v * width + u)
    };
    for child in &fine.points {
        if let Some(index) = cell_of(child)
            && child.inverse_depth > cells[index].nearest
        {
            cells[index].nearest = child.inverse_depth;
            cells[index].nearest_noise = child.noise;
        }
    }
    fine.points.retain(|child| {
        let Some(index) = cell_of(child) else { return true };
        !is_behind_a_jump(cells, width, index, child)
    });
    for child in &fine.points {
        let Some(index) = cell_of(child) else { continue };
        let cell = &mut cells[index];
        let information = 1.0 / child.variance;
        cell.information += information;
        cell.weighted += information * child.inverse_depth;
        cell.weighted_square += information * child.inverse_depth * child.inverse_depth;
        cell.noise += child.noise;
        cell.children += 1.0;
    }
    let independent = independent_share(cells);
    mark_cells_behind(cells, width, independent);
    fine.points.retain(|child| cell_of(child).is_none_or(|index| !cells[index].is_behind));
    let is_used = |cell: &Cell| cell.children > 0.0 && !cell.is_behind;
    let filled = cells.iter().enumerate().filter(|(_, cell)| is_used(cell));
    coarse.points.extend(filled.map(|(index, cell)| {
        let kept = cell.kept_noise(independent);
        Candidate {
            u: (index % width) as u16,
            v: (index / width) as u16,
            inverse_depth: cell.inverse_depth(),
            variance: cell.variance(),
            noise: (cell.noise / cell.children * kept).min(cell.variance()),
        }
    }));
}

/// Marks the cells beside which depth jumps to something nearer: single children are too noisy
/// to tell where their means can.
fn mark_cells_behind(cells: &mut [Cell], width: usize, independent: f32) {
    for index in 0..cells.len() {
        let cell = cells[index];
        if cell.children == 0.0 {
            continue;
        }
        let around = [index.wrapping_sub(1), index + 1, index.wrapping_sub(width), index + width];
        cells[index].is_behind = around.into_iter().any(|beside| {
            cells.get(beside).is_some_and(|beside| {
                let (there, here) = (beside.kept_noise(independent), cell.kept_noise(independent));
                beside.children > 0.0 && beside.is_cell_in_front_of(there, &cell, here)
            })
        });
    }
}

/// Whether `child`, in cell `index`, or the cell beside it shows something nearer.
fn is_behind_a_jump(cells: &[Cell], width: usize, index: usize, child: &Candidate) -> bool {
    let jumps = |cell: Option<&Cell>| {
        cell.is_some_and(|cell| cell.is_in_front_of(child.inverse_depth, child.noise))
    };
    // Only the neighbours that touch the child, not those across its parent.
    let beside = if child.u.is_multiple_of(2) { index.checked_sub(1) } else { Some(index + 1) };
    let above =
        if child.v.is_multiple_of(2) { index.checked_sub(width) } else { Some(index + width) };
    jumps(cells.get(index))
        || beside.is_some_and(|index| jumps(cells.get(index)))
        || above.is_some_and(|index| jumps(cells.get(index)))
}

/// κ: the scatter of children about their parent over what their variance predicts, 0 to 1.
fn independent_share(cells: &[Cell]) -> f32 {
    let (mut scatter, mut predicted) = (0.0f64, 0.0f64);
    for cell in cells.iter().filter(|cell| cell.children > 1.5) {
        let mean = cell.inverse_depth();
        let spread = cell.weighted_square - cell.information * mean * mean;
        scatter += f64::from(spread.max(0.0));
        predicted += f64::from(cell.children - 1.0);
    }
    if predicted == 0.0 { 0.0 } else { (scatter / predicted).min(1.0) as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(u: u16, v: u16, inverse_depth: f32, variance: f32) -> DepthPoint {
        DepthPoint { u, v, inverse_depth, variance, intensity: 0.0 }
    }

    #[test]
    fn a_parent_is_the_weighted_mean_and_gains_no_information() {
        let mut fusion = DepthFusion::default();
        fusion.fuse(&[point(4, 6, 1.0, 0.1), point(5, 7, 2.0, 0.3)], 64, 64, 2);
        let level = fusion.level(1);
        assert_eq!(level.len(), 1);
        let parent = level.get(0);
        assert_eq!((parent.u, parent.v), (2, 3));
        // Weights 10 and 10/3: (10 + 20/3)/(40/3) = 1.25; 2/(40/3) = 0.15.
        assert!((parent.inverse_depth - 1.25).abs() < 1e-6);
        assert!((parent.variance - 0.15).abs() < 1e-6);
        fusion.fuse(&[point(0, 0, 1.0, 0.2), point(1, 1, 1.0, 0.2)], 64, 64, 2);
        assert!((fusion.level(1).get(0).variance - 0.2).abs() < 1e-6);
    }

    #[test]
    fn an_edge_belongs_to_what_is_in_front() {
        let mut fusion = DepthFusion::default();
        // One cell with a child far behind, and a pixel right beside it that is as far.
        let jump = [point(4, 4, 1.0, 1e-4), point(5, 4, 0.4, 1e-4), point(6, 4, 0.4, 1e-4)];
        fusion.fuse(&jump, 64, 64, 2);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (1, 1));
        assert_eq!(fusion.level(1).get(0).inverse_depth, 1.0);
        // Beyond the next cell it is not beside the jump any more; and a slope is no jump.
        fusion.fuse(&[point(4, 4, 1.0, 1e-4), point(9, 4, 0.4, 1e-4)], 64, 64, 2);
        assert_eq!(fusion.level(1).len(), 2);
        fusion.fuse(&[point(4, 4, 1.0, 1e-4), point(5, 4, 0.97, 1e-4)], 64, 64, 2);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (2, 1));
        // What noise explains is no jump either.
        fusion.fuse(&[point(4, 4, 1.0, 0.04), point(5, 4, 0.4, 0.04)], 64, 64, 2);
        assert_eq!(fusion.level(0).len(), 2);
    }

    #[test]
    fn independent_noise_averages_down_and_common_noise_stays() {
        let mut noise = crate::slam::alignment::scene::Noise(3);
        let mut fusion = DepthFusion::default();
        let std_dev = 0.05f32;
        for (independent, expected) in [(1.0, 0.25), (0.0, 1.0)] {
            let points: Vec<_> = (0..64u16 * 64)
                .map(|i| {
                    let error = independent * std_dev * noise.normal() as f32;
                    point(i % 64, i / 64, 1.0 + error, std_dev * std_dev)
                })
                .collect();
            fusion.fuse(&points, 64, 64, 2);
            let parent = fusion.level(1).get(77);
            let kept = parent.noise / (std_dev * std_dev);
            assert!((kept - expected).abs() < 0.05, "{kept} is not {expected}");
            assert!((parent.variance / (std_dev * std_dev) - 1.0).abs() < 1e-3);
        }
    }

    #[test]
    fn hostile_points_are_left_out() {
        let mut fusion = DepthFusion::default();
        let points = [
            point(64, 0, 1.0, 0.1),
            point(0, 65, 1.0, 0.1),
            point(1, 1, f32::NAN, 0.1),
            point(1, 1, -1.0, 0.1),
            point(1, 1, 1.0, 0.0),
            point(1, 1, 1.0, f32::INFINITY),
            point(1, 1, 1.0e-40, 1.0),
        ];
        fusion.fuse(&points, 64, 64, 3);
        assert!((0..3).all(|level| fusion.level(level).is_empty()));
        // A pixel that only exists on the finer level of an odd size has no parent.
        fusion.fuse(&[point(64, 64, 1.0, 0.1)], 65, 65, 2);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (1, 0));
    }
}
