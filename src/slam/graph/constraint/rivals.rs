//! Checks whether another pose explains the images as well as the one that was found: where texture repeats, as along a
//! corridor, an alignment does not tell which repetition it has found.

use nalgebra::Vector3;

use super::ConstraintParams;
use super::align::{solve_level, sums};
use super::covariance::Scatter;
use super::residual::State;
use super::view::KeyframeView;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;

/// Step along an axis from the pose that was found, mean depths, and the number of steps either way: a repetition
/// further away shows in less than half of the view.
const STEP: f64 = 0.05;
const STEPS: i32 = 14;
/// Least number of steps to another pose: nearer it is the same one.
const MIN_STEPS: i32 = 2;
/// Most poses that are refined.
const MAX_REFINED: usize = 4;
/// Levels above the finest at which poses are scanned, and at which they are judged.
const SCANNED_ABOVE: usize = 2;
const JUDGED_ABOVE: usize = 1;

/// Whether there is such a pose.
pub(super) fn has_rival(
    views: [&KeyframeView; 2],
    j_from_i: &Sim3,
    params: &ConstraintParams,
) -> bool {
    let levels = views[0].levels();
    let Some(coarsest) = levels.clone().next_back() else { return false };
    let scanned = (levels.start + SCANNED_ABOVE).min(coarsest);
    let judged = (levels.start + JUDGED_ABOVE).min(scanned);
    let found = State::of(j_from_i);
    let mut places: Vec<(f64, State)> = Vec::new();
    for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
        places.extend(minima(views, scanned, &found, &axis, params));
    }
    places.sort_by(|one, other| one.0.total_cmp(&other.0));
    places.truncate(MAX_REFINED);
    places.iter().any(|(_, place)| {
        let solved = (judged..=scanned).rev().try_fold(*place, |state, level| {
            solve_level(views, level, &state, params).map(|(state, _)| state)
        });
        solved.is_some_and(|state| {
            is_elsewhere(views, &found, &state) && explains(views, judged, &state, params)
        })
    })
}

/// Poses along an axis with a lower cost than their neighbours, with that cost.
fn minima(
    views: [&KeyframeView; 2],
    level: usize,
    found: &State,
    axis: &Vector3<f64>,
    params: &ConstraintParams,
) -> Vec<(f64, State)> {
    let unit = 1.0 / views[0].reference.mean_inverse_depth();
    let costs: Vec<(f64, State)> = (-STEPS..=STEPS)
        .map(|step| {
            let by = SE3 { translation: axis * (STEP * unit * f64::from(step)), ..SE3::identity() };
            let state = State { rigid: by * found.rigid, ..*found };
            (sums(views, level, &state, &state, params).mean_energy(), state)
        })
        .collect();
    let is_lowest = |around: &&[(f64, State)]| {
        around[1].0 <= around[0].0 && around[1].0 <= around[2].0 && around[1].0.is_finite()
    };
    let is_apart = |(_, state): &(f64, State)| {
        let steps = (state.rigid.translation - found.rigid.translation).norm() / (STEP * unit);
        steps > f64::from(MIN_STEPS) - 0.5
    };
    costs.windows(3).filter(is_lowest).map(|around| around[1]).filter(is_apart).collect()
}

/// Whether a state differs from the one that was found.
fn is_elsewhere(views: [&KeyframeView; 2], found: &State, state: &State) -> bool {
    let difference = state.rigid.translation - found.rigid.translation;
    let distance = difference.norm() * views[0].reference.mean_inverse_depth();
    distance > STEP * f64::from(MIN_STEPS)
}

/// Whether the images agree at a state.
fn explains(
    views: [&KeyframeView; 2],
    level: usize,
    state: &State,
    params: &ConstraintParams,
) -> bool {
    let agreement = Scatter::measure(views, level, state, params).agreement();
    let gates = &params.gates;
    agreement.tiles >= gates.min_tiles
        && agreement.share >= gates.min_rival_agreement
        && state.brightness.a.abs() <= gates.max_log_gain
}
