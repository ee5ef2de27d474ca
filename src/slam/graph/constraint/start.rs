//! Initial value of an alignment of two keyframes: near a given estimate, where their blurred images agree best.

use nalgebra::{UnitQuaternion, Vector3, Vector6};

use super::ConstraintParams;
use super::align::solve_level;
use super::residual::{Level, State};
use super::view::KeyframeView;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::pose::Brightness;
use crate::slam::tracker::motion::rotations_around;
use crate::slam::upper_median::upper_median;

/// Rotations tried around a given one, degrees: half a step of those at which places are compared.
const AROUND_DEG: f64 = 4.5;
/// Translations tried together with a rotation that roughly keeps the centre of the view, mean depths.
const ASIDE: f64 = 0.3;
/// The same around a given similarity.
const GIVEN_DEG: f64 = 3.0;
const GIVEN_ASIDE: f64 = 0.1;
/// Candidates that are refined on the next finer level.
const MAX_REFINED: usize = 3;

/// Initial estimate of a similarity before it is measured.
#[derive(Debug, Clone, Copy)]
pub enum Start {
    /// Approximate rotation of the cameras, `j_from_i`, such as that of places that look alike.
    Rotation(UnitQuaternion<f64>),
    /// `j_from_i`.
    Similarity(Sim3),
}

/// The best state after the two coarsest levels; `None` where the images have nothing in common.
pub(super) fn find(
    views: [&KeyframeView; 2],
    start: Start,
    params: &ConstraintParams,
) -> Option<State> {
    let coarsest = views[0].levels().next_back()?;
    let unit = 1.0 / views[0].reference.mean_inverse_depth();
    let (starts, given_scale) = match start {
        Start::Rotation(rotation) => {
            let at = SE3 { rotation, ..SE3::identity() };
            (around(&at, AROUND_DEG, unit * ASIDE), 0.0)
        }
        Start::Similarity(given) => {
            let given = State::of(&given);
            (around(&given.rigid, GIVEN_DEG, unit * GIVEN_ASIDE), given.log_scale)
        }
    };
    let mut solved: Vec<(f64, State)> = Vec::new();
    for rigid in starts {
        let state = State { rigid, log_scale: given_scale, brightness: Brightness::default() };
        let state = State { log_scale: log_scale(views, coarsest, &state, params), ..state };
        solved.extend(follow(views, coarsest, &state, params));
    }
    // An image that is not explained while blurred will not be when sharp.
    let least = params.gates.min_usage * params.gates.min_inliers;
    solved.retain(|(explained, _)| *explained >= least);
    solved.sort_by(|one, other| other.0.total_cmp(&one.0));
    solved.truncate(MAX_REFINED);
    let level = coarsest.saturating_sub(1).max(views[0].levels().start);
    let followed = solved.into_iter().filter_map(|(_, state)| follow(views, level, &state, params));
    let best = followed.reduce(|one, other| if other.0 > one.0 { other } else { one });
    best.filter(|(explained, _)| *explained >= least).map(|(_, state)| state)
}

/// Solves a level and returns the share of all its points that are inliers, with the state; `None` where only an
/// implausible gain explains it, which would hide the right pose.
fn follow(
    views: [&KeyframeView; 2],
    level: usize,
    state: &State,
    params: &ConstraintParams,
) -> Option<(f64, State)> {
    let (state, sums) = solve_level(views, level, state, params)?;
    let is_even = state.brightness.a.abs() <= params.gates.max_log_gain;
    let explained = f64::from(sums.inliers) / views[0].reference.level(level).len().max(1) as f64;
    is_even.then_some((explained, state))
}

/// Poses around one: rotated by `degrees`, and moved by `aside`, units of i, with a rotation that keeps the view.
fn around(at: &SE3, degrees: f64, aside: f64) -> Vec<SE3> {
    let turn_rad = degrees.to_radians();
    // From the left, in the axes of j: rotations of the camera about itself.
    let mut poses: Vec<SE3> =
        rotations_around(&SE3::identity(), turn_rad).map(|turn| turn * *at).collect();
    for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
        for by in [-aside, aside] {
            let turn = turn_rad * by.signum();
            let turn = Vector6::new(0.0, 0.0, 0.0, turn * axis.y, -turn * axis.x, 0.0);
            poses.push(SE3 { translation: axis * by, ..SE3::exp(&turn) } * *at);
        }
    }
    poses
}

/// ln s minus the median of the depth residuals over the points that meet depth: the scale at which depths agree.
fn log_scale(
    views: [&KeyframeView; 2],
    level: usize,
    state: &State,
    params: &ConstraintParams,
) -> f64 {
    let at = Level::new(views, level, state, state, params);
    let depths = at.terms().filter_map(|terms| terms.depth);
    let mut residuals: Vec<f64> = depths.map(|depth| depth.residual).collect();
    state.log_scale + upper_median(&mut residuals, f64::total_cmp).unwrap_or(0.0)
}
