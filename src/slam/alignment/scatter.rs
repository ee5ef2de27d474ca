//! The scatter of the gradient of the cost over the image: the basis of the covariance.
//!
//! If residuals were independent and their σ_r correct, the covariance would be (Σ w J Jᵀ)⁻¹. Neither holds at
//! occlusions, reflections and where depths share an error. The sandwich M⁻¹ S M⁻¹ estimates both from the frame
//! itself: the gradients Σ w J r of image tiles, which sum to zero at the solution, scatter according to their
//! uncertainty (S = Σ g gᵀ over tiles), however correlated the points within a tile are. M is the curvature of the
//! cost, which Huber's weights overstate: beyond k the gradient of a residual no longer grows.

use nalgebra::{SMatrix, Vector3};

use crate::slam::alignment::misfit::TileMisfit;
use crate::slam::alignment::normal_equations::{NormalEquations, UNKNOWNS};
use crate::slam::alignment::points::LevelPoints;
use crate::slam::alignment::residual::{Evaluation, point_terms};
use crate::slam::alignment::tiles::{NUM_TILES, TileSum, tile_of};
use crate::slam::image::buffer::Image;
use crate::slam::modes::NUM_MODES;

/// Unknowns of the pose.
const POSE: usize = 6;

/// With points in fewer tiles than this, the scatter is too small a sample to trust, and the information replaces it.
const TRUSTED_TILES: f64 = UNKNOWNS as f64;

/// Scatter of the gradient, and the curvature of the cost.
#[derive(Debug, Clone, PartialEq)]
pub struct GradientScatter {
    /// Σ g gᵀ over tiles, g = Σ w J r over the points of a tile.
    pub outer: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    /// Curvature over information: the share of the Huber weights of residuals within k.
    pub curvature_ratio: f64,
    /// Tiles with points in view.
    pub tiles: u32,
    /// H = Σ w J (∂r/∂d) d φᵀ, φ = (X, Y, ln d): change of the gradient per unit of each common error of depth.
    pub d_gradient_d_modes: SMatrix<f64, UNKNOWNS, NUM_MODES>,
    /// Displacement of image tiles.
    pub misfit: TileMisfit,
}

impl Default for GradientScatter {
    fn default() -> Self {
        Self {
            outer: SMatrix::zeros(),
            curvature_ratio: 1.0,
            tiles: 0,
            d_gradient_d_modes: SMatrix::zeros(),
            misfit: TileMisfit::default(),
        }
    }
}

/// Sums over the points of all tiles.
#[derive(Debug, Clone)]
pub struct ScatterSums {
    /// The sums by tile.
    pub tiles: [TileSum; NUM_TILES],
    /// Σ w of the points whose Huber weight is 1.
    pub quadratic: f32,
    /// Σ w J (∂r/∂d) d φᵀ.
    pub d_gradient_d_modes: SMatrix<f64, UNKNOWNS, NUM_MODES>,
}

impl Default for ScatterSums {
    fn default() -> Self {
        Self {
            tiles: [TileSum::default(); NUM_TILES],
            quadratic: 0.0,
            d_gradient_d_modes: SMatrix::zeros(),
        }
    }
}

impl GradientScatter {
    /// Measures the scatter at one state, point by point; the scalar reference of `Kernel::scatter`.
    pub fn reference(points: &LevelPoints, image: &Image<u16>, at: &Evaluation) -> Self {
        let mut sums = ScatterSums::default();
        for point in points.iter() {
            let terms = point_terms(image, at, &point).filter(|terms| !terms.is_clipped);
            let Some(terms) = terms else { continue };
            let normalized = terms.residual * terms.residual / terms.variance;
            let huber = (at.huber / normalized.sqrt()).min(1.0);
            let weight = huber / terms.variance;
            sums.quadratic += if huber < 1.0 { 0.0 } else { weight };
            let u = (at.focal[0] * point.ray_x + at.centre[0]).round() as usize;
            let v = (at.focal[1] * point.ray_y + at.centre[1]).round() as usize;
            let tile = &mut sums.tiles[usize::from(tile_of(u, v, image.width(), image.height()))];
            tile.weight += weight;
            let [about_x, about_y] = [terms.jacobian[3], terms.jacobian[4]];
            let products = [about_x * about_x, about_x * about_y, about_y * about_y];
            for (sum, product) in tile.information.iter_mut().zip(products) {
                *sum += weight * product;
            }
            for (sum, derivative) in tile.gradient.iter_mut().zip(terms.jacobian) {
                *sum += weight * derivative * terms.residual;
            }
            // (∂r/∂d) d, at the inverse depth where the Jacobian is evaluated.
            let [tx, ty, tz] = at.translation;
            let [jx, jy, jz, ..] = terms.jacobian;
            let change = f64::from(weight * (jx * tx + jy * ty + jz * tz));
            let modes = [point.ray_x, point.ray_y, point.inverse_depth.ln()];
            for (mode, shape) in modes.map(f64::from).into_iter().enumerate() {
                for (i, derivative) in terms.jacobian.map(f64::from).into_iter().enumerate() {
                    sums.d_gradient_d_modes[(i, mode)] += change * derivative * shape;
                }
            }
        }
        Self::from_sums(&sums)
    }

    /// S and the curvature from the sums of the tiles.
    pub fn from_sums(sums: &ScatterSums) -> Self {
        let mut scatter = Self {
            d_gradient_d_modes: sums.d_gradient_d_modes,
            misfit: TileMisfit::of(&sums.tiles),
            ..Self::default()
        };
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
            // 0 if every residual is an outlier: the energy then has no curvature, and the covariance no bound. Two
            // sums of the same weights may differ by rounding.
            scatter.curvature_ratio = (f64::from(sums.quadratic) / weights).min(1.0);
        }
        scatter
    }

    /// Covariance of all unknowns before calibration, at the state with these `sums`; `None` if they do not determine
    /// all unknowns.
    pub fn covariance(&self, sums: &NormalEquations) -> Option<SMatrix<f64, UNKNOWNS, UNKNOWNS>> {
        let inverse = sums.information.cholesky()?.inverse() / self.curvature_ratio;
        let stand_in = TRUSTED_TILES / f64::from(self.tiles.max(1));
        let covariance = inverse * (self.outer + sums.information * stand_in) * inverse;
        covariance.iter().all(|x| x.is_finite()).then_some(covariance)
    }

    /// Change of the solution at the state with these `sums` per unit of each common error of depth: −M⁻¹ H, with the
    /// rows of the left increment; `None` if the sums do not determine all unknowns. The mean over the points,
    /// `centre`, is subtracted from each shape φ: a constant error is one of the keyframe's unit and changes the
    /// translation along itself only, since H of a constant is M (t, 0).
    ///
    /// Huber's weights need no curvature here: M and H lose the same share of it.
    pub fn d_pose_d_modes(
        &self,
        sums: &NormalEquations,
        translation: &Vector3<f64>,
        centre: &Vector3<f64>,
    ) -> Option<SMatrix<f64, POSE, NUM_MODES>> {
        let moved = sums.information.cholesky()?.solve(&self.d_gradient_d_modes);
        let mut moved = moved.fixed_rows::<POSE>(0).into_owned();
        let mut along = moved.fixed_rows_mut::<3>(0);
        along -= translation * centre.transpose();
        moved.iter().all(|x| x.is_finite()).then_some(-moved)
    }
}
