//! How the gradient of the cost scatters over the image: what the covariance is made of.
//!
//! Were residuals independent and their σ_r right, the covariance would be (Σ w J Jᵀ)⁻¹. Neither
//! holds at occlusions, reflections and where depths share an error. The sandwich M⁻¹ S M⁻¹ takes
//! both from the frame itself: the gradients Σ w J r of image tiles, zero in sum at the solution,
//! scatter as much as they are uncertain (S = Σ g gᵀ over tiles), however correlated the points of
//! one tile are. M is the curvature of the cost, which Huber's weights overstate: beyond k the
//! gradient of a residual no longer grows.

use nalgebra::SMatrix;

use crate::slam::alignment::normal_equations::{NormalEquations, UNKNOWNS};
use crate::slam::alignment::points::LevelPoints;
use crate::slam::alignment::residual::{Evaluation, point_terms};
use crate::slam::image::buffer::Image;

/// Tiles along u and v: some 170 with points in a usual keyframe, where eight unknowns need tens.
/// Between 8×6 and 40×30 the calibration depends little on it.
const TILES: (usize, usize) = (16, 12);

/// Number of tiles.
pub const NUM_TILES: usize = TILES.0 * TILES.1;

/// The tile of a pixel of an image of this size.
pub fn tile_of(u: usize, v: usize, width: usize, height: usize) -> u16 {
    let (columns, rows) = TILES;
    // Sides are at most 65 536 pixels, and 32-bit division is the faster one.
    let share = |at: usize, parts: usize, side: usize| {
        ((at as u32 * parts as u32 / (side as u32).max(1)) as usize).min(parts - 1)
    };
    (share(v, rows, height) * columns + share(u, columns, width)) as u16
}

/// Where fewer tiles than this have points, their scatter is too few numbers to trust, and
/// the information stands in for it.
const TRUSTED_TILES: f64 = UNKNOWNS as f64;

/// Scatter of the gradient, and the curvature of the cost.
#[derive(Debug, Clone, PartialEq)]
pub struct GradientScatter {
    /// Σ g gᵀ over tiles, g = Σ w J r over the points of a tile.
    pub outer: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    /// Curvature over information: the share of the Huber weights that is not beyond k.
    pub curvature_ratio: f64,
    /// Tiles with points in view.
    pub tiles: u32,
}

impl Default for GradientScatter {
    fn default() -> Self {
        Self { outer: SMatrix::zeros(), curvature_ratio: 1.0, tiles: 0 }
    }
}

/// Sums over the points of one tile.
#[derive(Debug, Clone, Copy, Default)]
pub struct TileSum {
    /// Σ w J r.
    pub gradient: [f32; UNKNOWNS],
    /// Σ w; positive where a point is in view.
    pub weight: f32,
}

/// Sums over the points of all tiles.
#[derive(Debug, Clone)]
pub struct ScatterSums {
    /// By tile.
    pub tiles: [TileSum; NUM_TILES],
    /// Σ w of the points whose Huber weight is 1.
    pub quadratic: f32,
}

impl Default for ScatterSums {
    fn default() -> Self {
        Self { tiles: [TileSum::default(); NUM_TILES], quadratic: 0.0 }
    }
}

impl GradientScatter {
    /// Measures it at one state, point by point; the explanation of `Kernel::scatter`.
    pub fn reference(points: &LevelPoints, image: &Image<u16>, at: &Evaluation) -> Self {
        let mut sums = ScatterSums::default();
        for point in points.iter() {
            let Some(terms) = point_terms(image, at, &point) else { continue };
            let normalized = terms.residual * terms.residual / terms.variance;
            let huber = (at.huber / normalized.sqrt()).min(1.0);
            let weight = huber / terms.variance;
            sums.quadratic += if huber < 1.0 { 0.0 } else { weight };
            let u = (at.focal[0] * point.ray_x + at.centre[0]).round() as usize;
            let v = (at.focal[1] * point.ray_y + at.centre[1]).round() as usize;
            let tile = &mut sums.tiles[usize::from(tile_of(u, v, image.width(), image.height()))];
            tile.weight += weight;
            for (sum, derivative) in tile.gradient.iter_mut().zip(terms.jacobian) {
                *sum += weight * derivative * terms.residual;
            }
        }
        Self::from_sums(&sums)
    }

    /// S and the curvature from the sums of the tiles.
    pub fn from_sums(sums: &ScatterSums) -> Self {
        let mut scatter = Self::default();
        let mut weights = 0.0;
        for tile in sums.tiles.iter().filter(|tile| tile.weight > 0.0) {
            weights += f64::from(tile.weight);
            scatter.tiles += 1;
            let gradient = tile.gradient.map(f64::from);
            for i in 0..UNKNOWNS {
                for j in i..UNKNOWNS {
                    scatter.outer[(i, j)] += gradient[i] * gradient[j];
                }
            }
        }
        scatter.outer.fill_lower_triangle_with_upper_triangle();
        if weights > 0.0 {
            // None where every residual is an outlier: the energy has no curvature there, and the
            // covariance no bound. Two sums of the same weights may differ by rounding.
            scatter.curvature_ratio = (f64::from(sums.quadratic) / weights).min(1.0);
        }
        scatter
    }

    /// Covariance of all unknowns before calibration, at the state whose sums are `sums`; `None`
    /// where they do not determine all unknowns.
    pub fn covariance(&self, sums: &NormalEquations) -> Option<SMatrix<f64, UNKNOWNS, UNKNOWNS>> {
        let inverse = sums.information.cholesky()?.inverse() / self.curvature_ratio;
        let stand_in = TRUSTED_TILES / f64::from(self.tiles.max(1));
        let covariance = inverse * (self.outer + sums.information * stand_in) * inverse;
        covariance.iter().all(|x| x.is_finite()).then_some(covariance)
    }
}
