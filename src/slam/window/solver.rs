//! Levenberg–Marquardt over the members of a window, at one level.

use nalgebra::Vector6;

use crate::slam::geometry::se3::SE3;
use crate::slam::window::comparison::POSE;
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::system::{Level, Members, Step, System};
use crate::slam::window::view::Views;

/// Factors of the damping after a step that lowers the cost, and after one that does not.
const DAMPING_DOWN: f64 = 0.2;
const DAMPING_UP: f64 = 10.0;
/// Damping of the first step, as a share of each diagonal element: small, so that soft modes are not frozen.
const FIRST_DAMPING: f64 = 1e-3;
/// Smallest damping: sums of f32 are exact to about a millionth, and the unit is held by nothing else.
const MIN_DAMPING: f64 = 1e-6;
/// Least damping of a step after one that failed.
const MIN_RAISED_DAMPING: f64 = 1e-3;
/// Consecutive steps that may fail.
const MAX_FAILURES: u32 = 5;
/// Largest factor by which a step may change a depth, either way: beyond it the linearisation does not hold.
const MAX_DEPTH_FACTOR: f64 = 3.0;

/// State and buffers of the iterations.
#[derive(Debug, Clone, Default)]
pub struct Solver {
    /// The comparisons that are made.
    pub views: Views,
    /// The equations at the current state.
    pub system: System,
    trial: System,
    step: Step,
    poses: Vec<SE3>,
    depths: Vec<f64>,
    /// Steps that were tried, until it is reset.
    pub iterations: u32,
}

impl Solver {
    /// Moves the free poses and depths to where the images agree best; `system` has the equations there. False where
    /// the poses are not determined.
    pub fn adjust(
        &mut self,
        keyframes: &mut [WindowKeyframe],
        members: &Members<'_>,
        at: &Level<'_>,
        max_iterations: u32,
        converged_decrement: f64,
    ) -> bool {
        self.views.fetch_depths(keyframes, members.members);
        let mut cost = self.system.linearise(keyframes, members, &self.views, at, None);
        let (mut damping, mut failures) = (FIRST_DAMPING, 0);
        for _ in 0..max_iterations {
            self.iterations += 1;
            if !self.system.solve(members, &self.views, damping, &mut self.step) {
                failures += 1;
                if failures > MAX_FAILURES {
                    return false;
                }
                damping = (damping * DAMPING_UP).max(MIN_RAISED_DAMPING);
                continue;
            }
            let converged = converged_decrement * self.system.mean_squared_residual();
            if self.step.decrement < converged {
                break;
            }
            self.remember(keyframes, members);
            self.apply(keyframes, members);
            self.views.fetch_depths(keyframes, members.members);
            let before = Some(&self.system);
            let moved = self.trial.linearise(keyframes, members, &self.views, at, before);
            if moved < cost {
                std::mem::swap(&mut self.system, &mut self.trial);
                (damping, failures) = ((damping * DAMPING_DOWN).max(MIN_DAMPING), 0);
                // The linear model may predict more than kinks between pixels allow.
                let is_flat = cost - moved < converged;
                cost = moved + self.system.entered_cost;
                if is_flat {
                    break;
                }
            } else {
                self.restore(keyframes, members);
                damping = (damping * DAMPING_UP).max(MIN_RAISED_DAMPING);
                failures += 1;
                if failures > MAX_FAILURES {
                    break;
                }
            }
        }
        true
    }

    fn remember(&mut self, keyframes: &[WindowKeyframe], members: &Members<'_>) {
        self.poses.clear();
        self.poses.extend(members.members.iter().map(|&index| keyframes[index].camera_from_map));
        self.depths.clear();
        self.depths.extend(
            self.views
                .points
                .iter()
                .map(|view| keyframes[members.members[view.host]].points[view.point].inverse_depth),
        );
    }

    fn restore(&self, keyframes: &mut [WindowKeyframe], members: &Members<'_>) {
        for (&index, pose) in members.members.iter().zip(&self.poses) {
            keyframes[index].camera_from_map = *pose;
        }
        for (view, depth) in self.views.points.iter().zip(&self.depths) {
            keyframes[members.members[view.host]].points[view.point].inverse_depth = *depth;
        }
    }

    fn apply(&self, keyframes: &mut [WindowKeyframe], members: &Members<'_>) {
        for (&index, free) in members.members.iter().zip(members.free) {
            if let Some(free) = free {
                let twist = Vector6::from_column_slice(&self.step.poses[POSE * free..][..POSE]);
                let pose = &mut keyframes[index].camera_from_map;
                *pose = SE3::exp(&twist) * *pose;
            }
        }
        if !members.depths_are_free {
            return;
        }
        for (view, change) in self.views.points.iter().zip(&self.step.depths) {
            let depth = &mut keyframes[members.members[view.host]].points[view.point].inverse_depth;
            let (least, most) = (*depth / MAX_DEPTH_FACTOR, *depth * MAX_DEPTH_FACTOR);
            *depth = (*depth + change).clamp(least, most);
        }
    }
}
