//! The depth pyramid: a parent's inverse depth is the inverse-variance weighted mean of its valid children, its
//! variance their harmonic mean n/Σ(1/V): neighbours are correlated, and down-sampling must not gain information.
//!
//! Where depth jumps, an edge in the image belongs to the foreground: children behind the nearest one are omitted, and
//! so are pixels next to a nearer one.
//!
//! The noise that remains in the mean can only be estimated from the data: the scatter of children about their parent
//! gives the share κ of their variance that is independent. It averages out, the rest remains:
//! N_parent = N (κ/n + 1 − κ).

use crate::slam::image::sums::MAX_LEVELS;
use crate::slam::keyframe::{DepthPoint, MAX_KEYFRAME_POINTS};

/// One pixel with depth on some level.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LevelPoint {
    /// Column on its level.
    pub u: u16,
    /// Row on its level.
    pub v: u16,
    /// Inverse depth, 1/keyframe units.
    pub inverse_depth: f32,
    /// Variance of the inverse depth.
    pub variance: f32,
    /// Variance of the noise remaining in the inverse depth, at most `variance`.
    pub noise: f32,
}

impl LevelPoint {
    /// A point of a keyframe of this size; `None` if it is not usable.
    fn of(point: &DepthPoint, width: usize, height: usize) -> Option<Self> {
        let DepthPoint { u, v, inverse_depth, variance, .. } = *point;
        let inside = usize::from(u) < width && usize::from(v) < height;
        let usable = inside && is_positive(inverse_depth) && is_positive(variance);
        usable.then_some(Self { u, v, inverse_depth, variance, noise: variance })
    }
}

/// Depth jumps where neighbours differ by this share of the nearer one's inverse depth (a wall seen at 80° changes by
/// about a hundredth per pixel at level 0) …
const JUMP_RATIO: f32 = 0.04;

/// The same between means of neighbouring cells, two pixels apart: larger, because it removes all pixels of a cell, and
/// slanted surfaces are worth keeping.
const CELL_JUMP_RATIO: f32 = 0.15;

/// … plus this many standard deviations of the noise.
const JUMP_SIGMAS: f32 = 3.0;

/// The nearest child of one parent: the bits of its inverse depth, whose order is that of their values because they are
/// positive, above those of its noise. In one word, because consecutive children often share a parent, and storing
/// halves would delay the load of the whole.
#[derive(Debug, Clone, Copy, Default)]
struct Front(u64);

impl Front {
    fn of(child: &LevelPoint) -> Self {
        let bits = |value: f32| u64::from(value.to_bits());
        Self(bits(child.inverse_depth) << 32 | bits(child.noise))
    }

    fn inverse_depth(self) -> f32 {
        f32::from_bits((self.0 >> 32) as u32)
    }

    fn noise(self) -> f32 {
        f32::from_bits(self.0 as u32)
    }

    /// The nearer one; the first on a tie.
    fn nearer(self, other: Self) -> Self {
        if other.0 >> 32 > self.0 >> 32 { other } else { self }
    }

    /// Whether depth jumps from here to a farther `child`.
    fn hides(self, child: &LevelPoint) -> bool {
        let nearest = self.inverse_depth();
        let step = nearest - child.inverse_depth - JUMP_RATIO * nearest;
        step > 0.0 && step * step > JUMP_SIGMAS * JUMP_SIGMAS * (child.noise + self.noise())
    }
}

/// The children of one parent: sums, then their mean.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    information: f32,
    weighted: f32,
    weighted_square: f32,
    noise: f32,
    children: f32,
    inverse_depth: f32,
    mean_noise: f32,
    is_behind: bool,
}

impl Cell {
    fn add(&mut self, child: &LevelPoint) {
        let information = 1.0 / child.variance;
        self.information += information;
        self.weighted += information * child.inverse_depth;
        self.weighted_square += information * child.inverse_depth * child.inverse_depth;
        self.noise += child.noise;
        self.children += 1.0;
    }

    /// Whether depth jumps from the mean of this cell to a farther mean of `other`; never from a cell without children.
    fn hides(&self, other: &Cell) -> bool {
        let nearer = self.inverse_depth;
        let step = nearer - other.inverse_depth - CELL_JUMP_RATIO * nearer;
        let noise = self.mean_noise + other.mean_noise;
        step > 0.0 && step * step > JUMP_SIGMAS * JUMP_SIGMAS * noise
    }
}

/// A cell with children, and its position.
#[derive(Debug, Clone, Copy)]
struct Filled {
    index: u32,
    u: u16,
    v: u16,
}

/// The cells of one level with a border of empty ones, so that each has four neighbours. All are zero between levels.
#[derive(Debug, Clone, Default)]
struct Cells {
    width: usize,
    height: usize,
    fronts: Vec<Front>,
    cells: Vec<Cell>,
    filled: Vec<Filled>,
}

/// Builds the depth pyramid in reusable memory.
#[derive(Debug, Clone, Default)]
pub struct DepthFusion {
    /// Row by row on the levels above 0.
    levels: [Vec<LevelPoint>; MAX_LEVELS],
    cells: Cells,
}

impl DepthFusion {
    /// Fuses `points` of a `width * height` image into `num_levels` levels. Skips points outside the image, without a
    /// positive finite inverse depth and variance, or beyond [`MAX_KEYFRAME_POINTS`]. Levels below `finest` only feed
    /// the coarser ones, and keep the points behind jumps. Returns the mean inverse depth of all points of level 0,
    /// `None` without points.
    pub fn fuse(
        &mut self,
        points: &[DepthPoint],
        width: usize,
        height: usize,
        num_levels: usize,
        finest: usize,
    ) -> Option<f64> {
        self.levels.iter_mut().for_each(Vec::clear);
        let points = points.iter().take(MAX_KEYFRAME_POINTS);
        let usable = points.filter_map(|point| LevelPoint::of(point, width, height));
        let mut sum = 0.0;
        self.levels[0].extend(usable.inspect(|point| sum += f64::from(point.inverse_depth)));
        let count = self.levels[0].len();
        for level in 1..num_levels.min(MAX_LEVELS) {
            let (fine, coarse) = self.levels.split_at_mut(level);
            self.cells.lay_out(width >> level, height >> level);
            self.cells.halve(&mut fine[level - 1], &mut coarse[0], level > finest);
        }
        (count > 0).then(|| sum / count as f64)
    }

    /// The pixels with depth of one level.
    pub fn level(&self, level: usize) -> &[LevelPoint] {
        &self.levels[level]
    }
}

/// Bounds within which squares and reciprocals of an inverse depth or a variance stay finite.
fn is_positive(value: f32) -> bool {
    const SANE: std::ops::RangeInclusive<f32> = 1.0e-15..=1.0e15;
    SANE.contains(&value)
}

impl Cells {
    /// Allocates for a level of `width * height` pixels.
    fn lay_out(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        let count = self.stride() * (height + 2);
        if self.cells.len() < count {
            self.cells.resize(count, Cell::default());
            self.fronts.resize(count, Front::default());
        }
    }

    fn stride(&self) -> usize {
        self.width + 2
    }

    /// The cell of a child; `None` in an odd last row or column.
    fn cell_of(&self, child: &LevelPoint) -> Option<usize> {
        let (u, v) = (usize::from(child.u / 2), usize::from(child.v / 2));
        (u < self.width && v < self.height).then(|| (v + 1) * self.stride() + u + 1)
    }

    /// Fuses `fine` into `coarse`; removes the points behind a jump in depth from `fine` if `drops_behind`.
    fn halve(
        &mut self,
        fine: &mut Vec<LevelPoint>,
        coarse: &mut Vec<LevelPoint>,
        drops_behind: bool,
    ) {
        for child in fine.iter() {
            let Some(index) = self.cell_of(child) else { continue };
            self.fronts[index] = self.fronts[index].nearer(Front::of(child));
        }
        self.find_filled();
        if drops_behind {
            fine.retain(|child| self.add(child));
        } else {
            fine.iter().for_each(|child| _ = self.add(child));
        }
        let independent = self.average();
        self.keep_noise(independent);
        self.emit(coarse);
        if drops_behind {
            let is_behind = |index: usize| self.cells[index].is_behind;
            fine.retain(|child| self.cell_of(child).is_none_or(|index| !is_behind(index)));
        }
        for filled in self.filled.drain(..) {
            self.cells[filled.index as usize] = Cell::default();
            self.fronts[filled.index as usize] = Front::default();
        }
    }

    /// Lists the cells with children, row by row.
    fn find_filled(&mut self) {
        let (width, stride) = (self.width, self.stride());
        // One more than there are cells: every cell is written, and the next overwrites one without children.
        self.filled.resize(width * self.height + 1, Filled { index: 0, u: 0, v: 0 });
        let mut count = 0;
        for v in 0..self.height {
            let first = (v + 1) * stride + 1;
            for (u, front) in self.fronts[first..first + width].iter().enumerate() {
                self.filled[count] = Filled { index: (first + u) as u32, u: u as u16, v: v as u16 };
                count += usize::from(front.0 > 0);
            }
        }
        self.filled.truncate(count);
    }

    /// Adds a child to its cell; returns false, without adding it, if it lies behind a jump.
    #[inline(always)]
    fn add(&mut self, child: &LevelPoint) -> bool {
        let Some(index) = self.cell_of(child) else { return true };
        let stride = self.stride();
        // Only the neighbours that touch the child, not those on the other side of its parent; by arithmetic, because a
        // branch on the side would be mispredicted half of the time.
        let beside = index + 2 * usize::from(child.u % 2) - 1;
        let across = index + 2 * usize::from(child.v % 2) * stride - stride;
        let hides = |index: usize| self.fronts[index].hides(child);
        let is_behind = hides(index) || hides(beside) || hides(across);
        if !is_behind {
            self.cells[index].add(child);
        }
        !is_behind
    }

    /// Computes the means; returns κ, the scatter of children about their parent over the scatter predicted by their
    /// variance, 0 to 1.
    fn average(&mut self) -> f32 {
        let (mut scatter, mut predicted) = (0.0f64, 0.0f64);
        for filled in &self.filled {
            let cell = &mut self.cells[filled.index as usize];
            if cell.children == 0.0 {
                continue;
            }
            let mean = cell.weighted / cell.information;
            cell.inverse_depth = mean;
            // An only child does not scatter, except for rounding.
            let spread = cell.weighted_square - cell.information * mean * mean;
            scatter += if cell.children > 1.5 { f64::from(spread.max(0.0)) } else { 0.0 };
            predicted += f64::from(cell.children - 1.0);
        }
        if predicted == 0.0 { 0.0 } else { (scatter / predicted).min(1.0) as f32 }
    }

    /// Computes the noise remaining in each mean, given the share `independent` that averages out.
    fn keep_noise(&mut self, independent: f32) {
        for filled in &self.filled {
            let cell = &mut self.cells[filled.index as usize];
            if cell.children > 0.0 {
                let kept = independent / cell.children + 1.0 - independent;
                cell.mean_noise = cell.noise / cell.children * kept;
            }
        }
    }

    /// Writes the means, except those next to a jump to something nearer: single children are too noisy to reveal jumps
    /// that their means reveal.
    fn emit(&mut self, coarse: &mut Vec<LevelPoint>) {
        let stride = self.stride();
        coarse.reserve(self.filled.len());
        for filled in &self.filled {
            let index = filled.index as usize;
            let cell = self.cells[index];
            if cell.children == 0.0 {
                continue;
            }
            let hides = |beside: usize| self.cells[beside].hides(&cell);
            let beside = hides(index - 1) || hides(index + 1);
            if beside || hides(index - stride) || hides(index + stride) {
                self.cells[index].is_behind = true;
                continue;
            }
            let variance = cell.children / cell.information;
            coarse.push(LevelPoint {
                u: filled.u,
                v: filled.v,
                inverse_depth: cell.inverse_depth,
                variance,
                noise: cell.mean_noise.min(variance),
            });
        }
    }
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
        fusion.fuse(&[point(4, 6, 1.0, 0.1), point(5, 7, 2.0, 0.3)], 64, 64, 2, 0);
        let level = fusion.level(1);
        assert_eq!(level.len(), 1);
        let parent = level[0];
        assert_eq!((parent.u, parent.v), (2, 3));
        // Weights 10 and 10/3: (10 + 20/3)/(40/3) = 1.25; 2/(40/3) = 0.15.
        assert!((parent.inverse_depth - 1.25).abs() < 1e-6);
        assert!((parent.variance - 0.15).abs() < 1e-6);
        fusion.fuse(&[point(0, 0, 1.0, 0.2), point(1, 1, 1.0, 0.2)], 64, 64, 2, 0);
        assert!((fusion.level(1)[0].variance - 0.2).abs() < 1e-6);
    }

    #[test]
    fn an_edge_belongs_to_the_foreground() {
        let mut fusion = DepthFusion::default();
        // One cell with a child far behind, and an adjacent pixel at the same distance.
        let jump = [point(4, 4, 1.0, 1e-4), point(5, 4, 0.4, 1e-4), point(6, 4, 0.4, 1e-4)];
        fusion.fuse(&jump, 64, 64, 2, 0);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (1, 1));
        assert_eq!(fusion.level(1)[0].inverse_depth, 1.0);
        // Beyond the next cell it is no longer next to the jump; and a slope is not a jump.
        fusion.fuse(&[point(4, 4, 1.0, 1e-4), point(9, 4, 0.4, 1e-4)], 64, 64, 2, 0);
        assert_eq!(fusion.level(1).len(), 2);
        fusion.fuse(&[point(4, 4, 1.0, 1e-4), point(5, 4, 0.97, 1e-4)], 64, 64, 2, 0);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (2, 1));
        // A difference within the noise is not a jump either.
        fusion.fuse(&[point(4, 4, 1.0, 0.04), point(5, 4, 0.4, 0.04)], 64, 64, 2, 0);
        assert_eq!(fusion.level(0).len(), 2);
    }

    #[test]
    fn opposite_sides_of_the_image_are_not_neighbours() {
        let mut fusion = DepthFusion::default();
        // Near at the left end of a row, far at the right end of the rows above and below: with single pixels, and with
        // cells whose means jump but whose pixels do not.
        let near = [point(0, 4, 1.0, 1e-4), point(0, 8, 1.0, 1e-4)];
        let far = [point(63, 2, 0.4, 1e-4), point(63, 9, 0.4, 1e-4)];
        fusion.fuse(&[near, far].concat(), 64, 64, 2, 0);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (4, 4));
        let near = [point(63, 4, 1.0, 1e-4), point(63, 8, 1.0, 1e-4)];
        let far = [point(0, 6, 0.4, 1e-4), point(1, 7, 0.4, 1e-4), point(0, 10, 0.4, 1e-4)];
        fusion.fuse(&[near.as_slice(), &far].concat(), 64, 64, 2, 0);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (5, 4));
    }

    #[test]
    fn reused_memory_is_empty() {
        let mut fusion = DepthFusion::default();
        let wall: Vec<_> = (0..64 * 64).map(|i| point(i % 64, i / 64, 1.0, 1e-4)).collect();
        fusion.fuse(&wall, 64, 64, 4, 0);
        assert_eq!(fusion.level(3).len(), 64);
        fusion.fuse(&[point(9, 9, 0.4, 1e-4)], 50, 40, 4, 0);
        assert!((0..4).all(|level| fusion.level(level).len() == 1));
        assert_eq!(fusion.level(3)[0].inverse_depth, 0.4);
    }

    #[test]
    fn independent_noise_averages_out_and_common_noise_stays() {
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
            fusion.fuse(&points, 64, 64, 2, 0);
            let parent = fusion.level(1)[77];
            let kept = parent.noise / (std_dev * std_dev);
            assert!((kept - expected).abs() < 0.05, "{kept} is not {expected}");
            assert!((parent.variance / (std_dev * std_dev) - 1.0).abs() < 1e-3);
        }
    }

    #[test]
    fn invalid_points_are_skipped() {
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
        fusion.fuse(&points, 64, 64, 3, 0);
        assert!((0..3).all(|level| fusion.level(level).is_empty()));
        // A pixel in the odd last row and column has no parent.
        fusion.fuse(&[point(64, 64, 1.0, 0.1)], 65, 65, 2, 0);
        assert_eq!((fusion.level(0).len(), fusion.level(1).len()), (1, 0));
    }
}
