//! The relative similarity of two keyframes by direct alignment of image and depth (Engel, Schöps, Cremers 2014, §3.5).
//!
//! [`ConstraintSolver::measure`] is the recipe: each keyframe is aligned to the other (`residual`, `align`, from the
//! best initial value that `start` finds), each alignment must pass on its own (`verdict`), and both must agree within
//! their covariances (`covariance`). The result becomes a constraint of the pose graph.

mod align;
mod covariance;
mod residual;
mod rivals;
mod start;
mod verdict;
mod view;

#[cfg(test)]
pub(in crate::slam) mod tests;

use crate::slam::alignment::align::AlignmentParams;
use crate::slam::alignment::reference::ReferenceParams;
use crate::slam::geometry::sim3::{Matrix7, Sim3};
use crate::slam::image::sums::MAX_LEVELS;
use crate::slam::keyframe::Keyframe;
use crate::slam::tracker::covariance_floor::CovarianceFloorParams;

pub use covariance::TileAgreement;
pub use start::Start;
pub use verdict::{GateParams, Refusal};
pub use view::KeyframeView;

/// Tuning of the measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct ConstraintParams {
    /// Points and finest level of each keyframe.
    pub reference: ReferenceParams,
    /// Noise, robust weights, priors of the brightness and maximum iterations.
    pub alignment: AlignmentParams,
    /// A level has converged when a step is shorter than this, in standard deviations by the level's own information.
    pub step_tolerance: f64,
    /// Relative standard deviation of depth that is extrapolated from the pixel it belongs to.
    pub depth_model_ratio: f64,
    /// The same on coarser levels, where a pose is still wrong by pixels: there depth constrains the scale and no more.
    pub coarse_depth_ratio: f64,
    /// Inflation of the covariance from the scatter over tiles.
    pub covariance_inflation: f64,
    /// Displacement of whole images.
    pub displacement: CovarianceFloorParams,
    /// Standard deviation of ln s that remains however much depth is compared.
    pub scale_std_dev: f64,
    /// Gates that a measurement must pass.
    pub gates: GateParams,
}

impl Default for ConstraintParams {
    fn default() -> Self {
        /// Points per level, finest first: a third of a frame's, since nine unknowns need no more and two alignments
        /// are made.
        const POINT_BUDGET: [usize; MAX_LEVELS] = [4000, 4000, 3000, 2000, 1200];
        let reference = ReferenceParams { point_budget: POINT_BUDGET, ..Default::default() };
        // The keyframes of a loop have been estimated jointly: what neighbouring points shared is gone.
        let alignment = AlignmentParams { common_depth_error: 0.0, ..Default::default() };
        Self {
            reference,
            alignment,
            step_tolerance: 0.1,
            depth_model_ratio: 0.01,
            coarse_depth_ratio: 0.2,
            covariance_inflation: 2.2,
            displacement: CovarianceFloorParams::default(),
            scale_std_dev: 0.005,
            gates: GateParams::default(),
        }
    }
}

/// One keyframe aligned to another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeAlignment {
    /// The similarity.
    pub j_from_i: Sim3,
    /// Covariance of its left increment (translation, rotation, log scale), in units of j.
    pub covariance: Matrix7,
    /// Logarithm of the gain of j's image against i's.
    pub log_gain: f64,
    /// Share of i's points in view in j and not clipped there.
    pub usage: f64,
    /// Share of those that are inliers.
    pub inlier_share: f64,
    /// Agreement between tiles of the images.
    pub agreement: TileAgreement,
    /// Share of the points in view that meet depth of j.
    pub depth_share: f64,
    /// Share of those whose depths agree.
    pub depth_inlier_share: f64,
    /// Distance of the cameras, mean depths of i.
    pub distance: f64,
}

/// An accepted measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// The similarity: both alignments, weighted by their information.
    pub j_from_i: Sim3,
    /// Covariance of its left increment (translation, rotation, log scale), in units of j. Both alignments see the same
    /// pixels, so it comes from their mean information, not the sum.
    pub covariance: Matrix7,
    /// The alignment of i to j, and of j to i.
    pub alignments: [KeyframeAlignment; 2],
    /// Squared normalised difference of the two, χ² with seven degrees of freedom if both covariances are right.
    pub reciprocal_chi2: f64,
}

/// Measures similarities between keyframes of one camera.
#[derive(Debug)]
pub struct ConstraintSolver {
    params: ConstraintParams,
}

impl ConstraintSolver {
    /// A solver with this tuning.
    pub fn new(params: ConstraintParams) -> Self {
        Self { params }
    }

    /// Prepares a keyframe for measurements.
    pub fn view(&self, keyframe: &Keyframe) -> KeyframeView {
        KeyframeView::new(keyframe, &self.params.reference)
    }

    /// Measures `j_from_i` from an initial rotation or similarity.
    pub fn measure(
        &self,
        i: &KeyframeView,
        j: &KeyframeView,
        start: Start,
    ) -> Result<Measurement, Refusal> {
        let gates = &self.params.gates;
        let forward = self.align(i, j, start)?;
        gates.judge(&forward)?;
        let backward = self.align(j, i, Start::Similarity(forward.j_from_i.inverse()))?;
        gates.judge(&backward)?;
        let measurement = fuse(forward, backward).ok_or(Refusal::Undetermined)?;
        gates.judge_reciprocity(measurement.reciprocal_chi2)?;
        gates.judge_certainty(&measurement, j.reference.mean_inverse_depth())?;
        if rivals::has_rival([i, j], &forward.j_from_i, &self.params) {
            return Err(Refusal::Ambiguous);
        }
        Ok(measurement)
    }

    /// Aligns i to j without judging the result.
    fn align(
        &self,
        i: &KeyframeView,
        j: &KeyframeView,
        start: Start,
    ) -> Result<KeyframeAlignment, Refusal> {
        let (views, params) = ([i, j], &self.params);
        if i.reference.intrinsics() != j.reference.intrinsics() {
            return Err(Refusal::OtherCamera);
        }
        let finest = i.levels().start;
        if views.iter().any(|view| view.reference.level(finest).len() < params.gates.min_points) {
            return Err(Refusal::TooFewPoints);
        }
        if matches!(start, Start::Similarity(j_from_i) if !j_from_i.is_valid()) {
            return Err(Refusal::InvalidStart);
        }
        let start = start::find(views, start, params).ok_or(Refusal::NoOverlap)?;
        let (state, sums) = align::descend(views, &start, params).ok_or(Refusal::NothingInView)?;
        if (sums.compared as usize) < params.gates.min_points {
            return Err(Refusal::LittleOverlap);
        }
        let scatter = covariance::Scatter::measure(views, finest, &state, params);
        let covariance =
            scatter.covariance(views, &sums, &state, params).ok_or(Refusal::Undetermined)?;
        let [met, agreeing] = scatter.depths;
        // Noise of single depths moves single points by a pixel, and fine texture would not correlate.
        let judged = (finest + 1).min(i.levels().end - 1);
        let compared = f64::from(sums.compared);
        Ok(KeyframeAlignment {
            j_from_i: state.j_from_i(),
            covariance,
            log_gain: state.brightness.a,
            usage: compared / i.reference.level(finest).len() as f64,
            inlier_share: f64::from(sums.inliers) / compared,
            agreement: covariance::Scatter::measure(views, judged, &state, params).agreement(),
            depth_share: f64::from(met) / compared,
            depth_inlier_share: f64::from(agreeing) / f64::from(met.max(1)),
            distance: state.rigid.translation.norm() * i.reference.mean_inverse_depth(),
        })
    }
}

/// Fuses both alignments into one of `j_from_i`; `None` where a covariance has no inverse.
fn fuse(forward: KeyframeAlignment, backward: KeyframeAlignment) -> Option<Measurement> {
    // S_ji S_ij and the left increment of S_ji⁻¹: −Ad(S_ji⁻¹) times that of S_ji.
    let adjoint = forward.j_from_i.adjoint();
    let of_backward = adjoint * backward.covariance * adjoint.transpose();
    let difference = (forward.j_from_i * backward.j_from_i).log();
    let whitening = (forward.covariance + of_backward).cholesky()?;
    let reciprocal_chi2 = difference.dot(&whitening.solve(&difference));
    let informations =
        [forward.covariance.cholesky()?.inverse(), of_backward.cholesky()?.inverse()];
    let sum = (informations[0] + informations[1]).cholesky()?;
    // The backward alignment is exp(−difference) times the forward one.
    let step = sum.solve(&(informations[1] * -difference));
    Some(Measurement {
        j_from_i: Sim3::exp(&step) * forward.j_from_i,
        covariance: sum.inverse() * 2.0,
        alignments: [forward, backward],
        reciprocal_chi2,
    })
}
