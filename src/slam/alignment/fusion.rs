//! The depth pyramid: a parent's inverse depth is the inverse-variance weighted mean of its valid
//! children, its variance their harmonic mean n/Σ(1/V), because neighbours are correlated and
//! down-sampling must not gain information.

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
    pub fn mean_inverse_depth(&self) -> Option<f64> {
        let sum: f64 = self.points.iter().map(|point| f64::from(point.inverse_depth)).sum();
        (!self.points.is_empty()).then(|| sum / self.points.len() as f64)
    }
}

/// Sums of the children of one parent.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    information: f32,
    weighted_inverse_depth: f32,
    children: f32,
}

/// Builds the depth pyramid, in memory that is used again.
#[derive(Debug, Clone, Default)]
pub struct DepthFusion {
    levels: [Candidates; MAX_LEVELS],
    cells: Vec<Cell>,
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
        }));
        for level in 1..num_levels.min(MAX_LEVELS) {
            let (fine, coarse) = self.levels.split_at_mut(level);
            let (width, height) = (width >> level, height >> level);
            halve(&fine[level - 1], &mut coarse[0], &mut self.cells, width, height);
        }
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

fn halve(
    fine: &Candidates,
    coarse: &mut Candidates,
    cells: &mut Vec<Cell>,
    width: usize,
    height: usize,
) {
    cells.clear();
    cells.resize(width * height, Cell::default());
    for child in &fine.points {
        let (u, v) = (usize::from(child.u / 2), usize::from(child.v / 2));
        if u >= width || v >= height {
            continue;
        }
        let cell = &mut cells[v * width + u];
        let information = 1.0 / child.variance;
        cell.information += information;
        cell.weighted_inverse_depth += information * child.inverse_depth;
        cell.children += 1.0;
    }
    for (v, row) in cells.chunks_exact(width).enumerate() {
        for (u, cell) in row.iter().enumerate() {
            if cell.children > 0.0 {
                coarse.points.push(Candidate {
                    u: u as u16,
                    v: v as u16,
                    inverse_depth: cell.weighted_inverse_depth / cell.information,
                    variance: cell.children / cell.information,
                });
            }
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
