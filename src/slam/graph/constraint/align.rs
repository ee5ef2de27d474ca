//! Coarse-to-fine alignment: iteratively re-weighted Gauss–Newton with Levenberg–Marquardt damping over the similarity
//! and the brightness.

use nalgebra::SMatrix;

use super::ConstraintParams;
use super::residual::{Level, Row, SCALE, State, UNKNOWNS};
use super::view::KeyframeView;

/// Information over the unknowns.
pub(super) type Information = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// The sums over the points of a level at one state.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sums {
    /// Σ w J Jᵀ, priors included.
    pub(super) information: Information,
    /// Σ w J r, priors included.
    pub(super) gradient: Row,
    /// Σ ρ.
    pub(super) energy: f64,
    /// Points compared.
    pub(super) compared: u32,
    /// How many of them are below the inlier gate.
    pub(super) inliers: u32,
}

impl Sums {
    /// Mean cost of the points compared; infinite without any.
    pub(super) fn mean_energy(&self) -> f64 {
        if self.compared == 0 { f64::INFINITY } else { self.energy / f64::from(self.compared) }
    }

    fn damped_step(&self, damping: f64) -> Option<Row> {
        let mut damped = self.information;
        for k in 0..UNKNOWNS {
            damped[(k, k)] *= 1.0 + damping;
        }
        let step = -damped.cholesky()?.solve(&self.gradient);
        step.iter().all(|x| x.is_finite()).then_some(step)
    }
}

/// Sums at a state on a level.
pub(super) fn sums(
    views: [&KeyframeView; 2],
    level: usize,
    state: &State,
    weighed_at: &State,
    params: &ConstraintParams,
) -> Sums {
    let at = Level::new(views, level, state, weighed_at, params);
    let mut sums = Sums {
        information: Information::zeros(),
        gradient: Row::zeros(),
        energy: 0.0,
        compared: 0,
        inliers: 0,
    };
    let gate = f64::from(params.alignment.inlier_gate).powi(2);
    // On coarser levels the pose is not yet accurate enough to tell.
    let is_finest = level == views[0].levels().start;
    for terms in at.terms() {
        let squared = terms.squared();
        let huber = params.huber_weight(squared);
        sums.compared += 1;
        sums.inliers += u32::from(squared < gate);
        sums.energy += huber * (2.0 - huber) * squared;
        let mut add = |row: &Row, residual: f64, variance: f64| {
            let weight = huber / variance;
            for a in 0..UNKNOWNS {
                let weighted = weight * row[a];
                sums.gradient[a] += weighted * residual;
                for b in a..UNKNOWNS {
                    sums.information[(a, b)] += weighted * row[b];
                }
            }
        };
        let photometric = &terms.photometric;
        let (residual, variance) = (photometric.residual, photometric.variance);
        add(&terms.photometric_row(), f64::from(residual), f64::from(variance));
        if let Some(depth) = terms.depth.as_ref().filter(|depth| !(is_finest && depth.is_hidden()))
        {
            add(&depth.row(), depth.residual, depth.variance);
        }
    }
    sums.information.fill_lower_triangle_with_upper_triangle();
    let brightness = state.brightness;
    let alignment = &params.alignment;
    for (k, value, std_dev) in [
        (7, brightness.a, alignment.gain_prior_std_dev),
        (8, brightness.b, alignment.offset_prior_std_dev),
    ] {
        let information = 1.0 / (std_dev * std_dev);
        sums.information[(k, k)] += information;
        sums.gradient[k] += information * value;
        sums.energy += information * value * value;
    }
    // Where no depth of j is met, only this constrains the scale.
    let of_scale = 1.0 / (SCALE_PRIOR_STD_DEV * SCALE_PRIOR_STD_DEV);
    sums.information[(SCALE, SCALE)] += of_scale;
    sums
}

/// Standard deviation of the zero prior on a step of ln s: a unit that is e times as long.
const SCALE_PRIOR_STD_DEV: f64 = 1.0;
/// Longest step of a rotation, radians, and of ln s: beyond it the linearisation is meaningless.
const LONGEST_STEP: f64 = 1.0;

/// Solves one level from `state`; `None` where nothing is in view.
pub(super) fn solve_level(
    views: [&KeyframeView; 2],
    level: usize,
    state: &State,
    params: &ConstraintParams,
) -> Option<(State, Sums)> {
    /// Damping after the first failed step; at or below this it returns to zero.
    const FIRST_DAMPING: f64 = 0.2;
    /// Consecutive failed steps before a level is given up.
    const MAX_FAILURES: u32 = 6;
    let weighed_at = *state;
    let mut best = (*state, sums(views, level, state, &weighed_at, params));
    let (mut damping, mut failures) = (0.0, 0);
    if best.1.compared == 0 {
        return None;
    }
    for _ in 0..params.alignment.max_iterations[level] {
        let Some(step) = best.1.damped_step(damping) else { break };
        let decrement = (step.transpose() * best.1.information * step)[0].sqrt();
        if step.fixed_rows::<4>(3).amax() > LONGEST_STEP {
            break;
        }
        let moved = best.0.moved(&step);
        let tried = sums(views, level, &moved, &weighed_at, params);
        let (before, after) = (best.1.mean_energy(), tried.mean_energy());
        if after < before && moved.is_finite() {
            best = (moved, tried);
            damping = if damping <= FIRST_DAMPING { 0.0 } else { 0.5 * damping };
            failures = 0;
            if decrement < params.step_tolerance {
                break;
            }
        } else {
            failures += 1;
            if failures > MAX_FAILURES || decrement < params.step_tolerance {
                break;
            }
            damping =
                if damping == 0.0 { FIRST_DAMPING } else { damping * f64::from(1u32 << failures) };
        }
    }
    Some(best)
}

/// Solves all levels from coarse to fine, each starting from the previous result.
pub(super) fn descend(
    views: [&KeyframeView; 2],
    state: &State,
    params: &ConstraintParams,
) -> Option<(State, Sums)> {
    let mut found = None;
    let mut state = *state;
    for level in views[0].levels().rev() {
        let solved = solve_level(views, level, &state, params)?;
        state = solved.0;
        found = Some(solved);
    }
    found
}

impl ConstraintParams {
    /// Huber weight of a point with this whitened squared residual.
    pub(super) fn huber_weight(&self, squared: f64) -> f64 {
        (f64::from(self.alignment.huber) / squared.sqrt()).min(1.0)
    }
}
