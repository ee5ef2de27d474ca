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

impl GradientScatter {
    /// Measures it at one state.
    pub fn measure(points: &LevelPoints, image: &Image<u16>, at: &Evaluation) -> Self {
        let (columns, rows) = TILES;
        let mut gradients = [[0.0f32; UNKNOWNS]; TILES.0 * TILES.1];
        let mut is_seen = [false; TILES.0 * TILES.1];
        let (mut weights, mut quadratic) = (0.0f32, 0.0f32);
        let per_pixel =
            (columns as f32 / image.width() as f32, rows as f32 / image.height() as f32);
        for point in points.iter() {
            let Some(terms) = point_terms(image, at, &point) else { continue };
            let normalized = terms.residual * terms.residual / terms.variance;
            let huber = (at.huber / normalized.sqrt()).min(1.0);
            let information = 1.0 / terms.variance;
            weights += huber * information;
            quadratic += if huber < 1.0 { 0.0 } else { information };
            let column = (at.focal[0] * point.ray_x + at.centre[0]) * per_pixel.0;
            let row = (at.focal[1] * point.ray_y + at.centre[1]) * per_pixel.1;
            let tile = (row as usize).min(rows - 1) * columns + (column as usize).min(columns - 1);
            let pull = huber * information * terms.residual;
            for (sum, derivative) in gradients[tile].iter_mut().zip(terms.jacobian) {
                *sum += pull * derivative;
            }
            is_seen[tile] = true;
        }
        let mut scatter = Self::default();
        for (gradient, _) in gradients.iter().zip(is_seen).filter(|(_, is_seen)| *is_seen) {
            let gradient = SMatrix::<f64, UNKNOWNS, 1>::from(gradient.map(f64::from));
            scatter.outer += gradient * gradient.transpose();
            scatter.tiles += 1;
        }
        if quadratic > 0.0 {
            scatter.curvature_ratio = f64::from(quadratic / weights);
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
