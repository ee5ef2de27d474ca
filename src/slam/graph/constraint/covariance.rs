//! Covariance of an alignment: the sandwich of the alignment of frames (`alignment/scatter.rs`) over the similarity,
//! the effect of the common depth errors of both keyframes, and a displacement of the whole image.
//!
//! ```text
//! Σ = s² M⁻¹ (Σ g gᵀ) M⁻¹ + Σ_k (M⁻¹ H_k) P_k (M⁻¹ H_k)ᵀ + displacement + scale floor
//! ```
//! g are the gradients of the tiles of i's image, M the curvature, H_k the derivative of the gradient by tilt and
//! relief of keyframe k, P_k their covariance. A constant error of depth is the keyframe's unit and no error.

use nalgebra::SMatrix;

use super::ConstraintParams;
use super::align::Sums;
use super::residual::{Level, Row, SCALE, State, Terms, UNKNOWNS};
use super::view::KeyframeView;
use crate::slam::alignment::misfit::TileMisfit;
use crate::slam::alignment::tiles::{NUM_TILES, TileSum, tile_of};
use crate::slam::geometry::sim3::Matrix7;
use crate::slam::modes::NUM_MODES;
use crate::slam::tracker::covariance_floor::displacement_covariance;

/// Derivatives of the gradient by the modes of a keyframe.
type ByModes = SMatrix<f64, UNKNOWNS, NUM_MODES>;

/// Scatter of the residuals over the tiles of an image, and the effect of common errors.
pub(super) struct Scatter {
    tiles: Vec<Tile>,
    weights: f64,
    quadratic: f64,
    by_modes: [ByModes; 2],
    /// Points that meet depth of j, and those whose depths agree.
    pub(super) depths: [u32; 2],
}

#[derive(Clone, Default)]
struct Tile {
    gradient: Row,
    /// For its displacement, which only the photometric residuals reveal.
    shown: TileSum,
    compared: Comparison,
}

/// Sums for the correlation of the grey values of two images.
#[derive(Clone, Copy, Default)]
struct Comparison {
    count: f64,
    sums: [f64; 2],
    squares: [f64; 2],
    product: f64,
}

impl Comparison {
    fn add(&mut self, greys: [f64; 2]) {
        self.count += 1.0;
        for (k, grey) in greys.into_iter().enumerate() {
            self.sums[k] += grey;
            self.squares[k] += grey * grey;
        }
        self.product += greys[0] * greys[1];
    }

    /// Correlation; `None` where there are too few grey values, or those of the first image are too uniform.
    fn correlation(&self) -> Option<f64> {
        /// Fewer grey values correlate by chance.
        const MIN_POINTS: f64 = 12.0;
        /// Variance of grey values, grey levels², that camera noise alone could cause.
        const MIN_VARIANCE: f64 = 16.0;
        if self.count < MIN_POINTS {
            return None;
        }
        let mean = self.sums.map(|sum| sum / self.count);
        let variance = [0, 1].map(|k| self.squares[k] / self.count - mean[k] * mean[k]);
        let common = self.product / self.count - mean[0] * mean[1];
        // A uniform tile where texture was predicted does not agree.
        (variance[0] > MIN_VARIANCE)
            .then(|| common / (variance[0] * variance[1].max(MIN_VARIANCE)).sqrt())
    }
}

/// Agreement between the tiles of two images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileAgreement {
    /// Tiles with texture that are compared.
    pub tiles: u32,
    /// Share of them whose grey values correlate.
    pub share: f64,
}

impl Scatter {
    /// Measured at a state, at which the derivatives by the modes of both views are taken.
    pub(super) fn measure(
        views: [&KeyframeView; 2],
        level: usize,
        state: &State,
        params: &ConstraintParams,
    ) -> Self {
        let at = Level::new(views, level, state, state, params);
        let [i, j] = views.map(|view| &view.reference);
        let centres = [i, j].map(|reference| reference.level(level).centre());
        let intrinsics = i.intrinsics().at_level(level);
        let mut scatter = Self {
            tiles: vec![Tile::default(); NUM_TILES],
            weights: 0.0,
            quadratic: 0.0,
            by_modes: [ByModes::zeros(); 2],
            depths: [0; 2],
        };
        /// Standard deviations within which depths agree, as for an inlier.
        const AGREES: f64 = 2.5;
        /// Largest relative difference at which they agree at all: uncertain depth would agree with anything.
        const LARGEST_DIFFERENCE: f64 = 0.2;
        for terms in at.terms() {
            let huber = params.huber_weight(terms.squared());
            let (u, v) = (
                f64::from(terms.point.ray_x) * intrinsics.fx + intrinsics.cx,
                f64::from(terms.point.ray_y) * intrinsics.fy + intrinsics.cy,
            );
            let tile = tile_of(
                u.round() as usize,
                v.round() as usize,
                intrinsics.width,
                intrinsics.height,
            );
            scatter.add_photometric(usize::from(tile), &terms, huber, state, &centres[0]);
            let Some(depth) = terms.depth else { continue };
            let bound = (AGREES * depth.variance.sqrt()).min(LARGEST_DIFFERENCE);
            scatter.depths[0] += 1;
            scatter.depths[1] += u32::from(depth.residual.abs() < bound);
            if depth.is_hidden() {
                continue;
            }
            let weight = huber / depth.variance;
            let row = depth.row();
            scatter.tiles[usize::from(tile)].gradient += row * (weight * depth.residual);
            let d = f64::from(terms.point.inverse_depth);
            let own = shape([terms.point.ray_x, terms.point.ray_y].map(f64::from), d) - centres[0];
            scatter.by_modes[0] += row * (weight * depth.by_log_depth) * own.transpose();
            // For j: the plane of its modes at the ray of p'.
            let [u, v] = terms.photometric.projection.map(f64::from);
            let theirs =
                shape(intrinsics.ray(u, v).xy().into(), depth.other_inverse_depth) - centres[1];
            scatter.by_modes[1] -= row * weight * theirs.transpose();
        }
        scatter
    }

    fn add_photometric(
        &mut self,
        tile: usize,
        terms: &Terms,
        huber: f64,
        state: &State,
        centre: &nalgebra::Vector3<f64>,
    ) {
        let photometric = &terms.photometric;
        let (residual, variance) =
            (f64::from(photometric.residual), f64::from(photometric.variance));
        let weight = huber / variance;
        self.weights += weight;
        self.quadratic += if huber < 1.0 { 0.0 } else { weight };
        let row = terms.photometric_row();
        let tile = &mut self.tiles[tile];
        tile.gradient += row * (weight * residual);
        tile.shown.weight += weight as f32;
        let [about_x, about_y] = [row[3], row[4]];
        let products = [about_x * about_x, about_x * about_y, about_y * about_y];
        for (sum, product) in tile.shown.information.iter_mut().zip(products) {
            *sum += (weight * product) as f32;
        }
        for (sum, derivative) in tile.shown.gradient.iter_mut().zip(photometric.jacobian) {
            *sum += (weight * residual) as f32 * derivative;
        }
        let predicted =
            state.brightness.a.exp() * f64::from(terms.point.intensity) + state.brightness.b;
        tile.compared.add([predicted, residual + predicted]);
        let d = f64::from(terms.point.inverse_depth);
        let t = &state.rigid.translation;
        // (∂r/∂d) d, at the inverse depth that the Jacobian is taken at.
        let change = row[0] * t.x + row[1] * t.y + row[2] * t.z;
        let own = shape([terms.point.ray_x, terms.point.ray_y].map(f64::from), d) - centre;
        self.by_modes[0] += row * (weight * change) * own.transpose();
    }

    /// Agreement between the tiles.
    pub(super) fn agreement(&self) -> TileAgreement {
        /// Correlation from which the grey values of a tile agree: two different places have 0 to 0.5.
        const AGREES: f64 = 0.7;
        let (mut tiles, mut agreeing) = (0u32, 0u32);
        for correlation in self.tiles.iter().filter_map(|tile| tile.compared.correlation()) {
            tiles += 1;
            agreeing += u32::from(correlation > AGREES);
        }
        TileAgreement { tiles, share: f64::from(agreeing) / f64::from(tiles.max(1)) }
    }

    /// Covariance of the left increment of `j_from_i`; `None` where the images and depths do not determine it.
    pub(super) fn covariance(
        &self,
        views: [&KeyframeView; 2],
        sums: &Sums,
        state: &State,
        params: &ConstraintParams,
    ) -> Option<Matrix7> {
        let inverse = sums.information.cholesky()?.inverse();
        let curvature_ratio = self.quadratic / self.weights;
        let mut outer = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        let mut count = 0u32;
        for tile in self.tiles.iter().filter(|tile| tile.shown.weight > 0.0) {
            outer += tile.gradient * tile.gradient.transpose();
            count += 1;
        }
        // With fewer tiles than unknowns the scatter is not informative.
        outer += sums.information * (UNKNOWNS as f64 / f64::from(count.max(1)));
        let sandwich = inverse * outer * inverse / (curvature_ratio * curvature_ratio);
        let of_pose =
            |m: &SMatrix<f64, UNKNOWNS, UNKNOWNS>| m.fixed_view::<7, 7>(0, 0).into_owned();
        let mut covariance = of_pose(&sandwich) * params.covariance_inflation;
        for (view, by_modes) in views.iter().zip(&self.by_modes) {
            let moved = (inverse * by_modes).fixed_rows::<7>(0).into_owned();
            covariance += moved * view.reference.mode_covariance().matrix() * moved.transpose();
        }
        let reference = &views[0].reference;
        let tiles: [TileSum; NUM_TILES] = std::array::from_fn(|k| self.tiles[k].shown);
        let displacement_px = params.displacement.displacement_px(
            &TileMisfit::of(&tiles),
            sums.mean_energy(),
            reference.intrinsics(),
        );
        let displaced = displacement_covariance(
            displacement_px,
            reference.intrinsics(),
            reference.mean_inverse_depth(),
        );
        let mut of_rigid = covariance.fixed_view_mut::<6, 6>(0, 0);
        of_rigid += displaced;
        covariance[(SCALE, SCALE)] += params.scale_std_dev.powi(2);
        // From T, in units of i, to j_from_i, in those of j.
        let mut unit = Matrix7::identity();
        unit.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(state.log_scale.exp());
        let covariance = unit * covariance * unit;
        let symmetric = (covariance + covariance.transpose()) * 0.5;
        (symmetric.iter().all(|x| x.is_finite()) && symmetric.cholesky().is_some())
            .then_some(symmetric)
    }
}

/// φ of a ray and an inverse depth: the coordinates over which the modes are planes.
fn shape([x, y]: [f64; 2], inverse_depth: f64) -> nalgebra::Vector3<f64> {
    nalgebra::Vector3::new(x, y, inverse_depth.ln())
}
