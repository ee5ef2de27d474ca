//! Coarse to fine: iteratively re-weighted Gauss–Newton with Levenberg–Marquardt damping.

use nalgebra::{Matrix6, Matrix6x3, SVector, Vector3};

use crate::slam::alignment::damping::Damping;
use crate::slam::alignment::normal_equations::{NormalEquations, UNKNOWNS, pose_step};
pub use crate::slam::alignment::params::AlignmentParams;
use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::residual::{Evaluation, mean_squared_flow};
use crate::slam::alignment::scatter::GradientScatter;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::{MAX_LEVELS, SumPyramid};
use crate::slam::kernel::Kernel;
use crate::slam::pose::Brightness;

/// The unknowns of an alignment and how well they explain the image.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedState {
    /// Pose, translation in keyframe units.
    pub current_from_keyframe: SE3,
    /// Brightness relative to the keyframe.
    pub brightness: Brightness,
    /// Translation at which (∂r/∂d)² V weights the residuals, keyframe units.
    pub variance_translation: Vector3<f64>,
    /// The sums at this state, priors included.
    pub sums: NormalEquations,
}

impl AlignedState {
    /// Pose and brightness after an undamped step; `None` if there is no step or it is implausible for a camera.
    pub fn after_step(&self) -> Option<(SE3, Brightness)> {
        Some(self.moved_by(&self.sums.damped_step(0.0).filter(is_sane)?))
    }

    /// Pose and brightness after `step`.
    fn moved_by(&self, step: &SVector<f64, UNKNOWNS>) -> (SE3, Brightness) {
        let pose = SE3::exp(&pose_step(step)) * self.current_from_keyframe;
        let Brightness { a, b } = self.brightness;
        (pose, Brightness { a: a + step[6], b: b + step[7] })
    }

    /// Whether to accept a step from `before` to here: it keeps the points in view and the energy low.
    fn is_acceptable_after(&self, before: &Self, min_in_view: f64) -> bool {
        let compared = f64::from(self.sums.compared);
        let keeps_view = compared >= MIN_KEPT_IN_VIEW * f64::from(before.sums.compared);
        keeps_view && compared >= min_in_view && self.energy_ratio(before) < TOLERATED_RISE
    }

    /// Mean energy relative to that of `before`.
    fn energy_ratio(&self, before: &Self) -> f64 {
        self.sums.mean_energy() / before.sums.mean_energy()
    }
}

/// The next level below `level` on which a frame has pixels and `reference` has points; `None` if there is none.
pub fn next_finer_level(reference: &Reference, frame: &SumPyramid, level: usize) -> Option<usize> {
    let finest = reference.finest_level().max(frame.finest_level());
    (finest..level).rev().find(|&level| !reference.level(level).is_empty())
}

/// Why an alignment ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// Solved down to the finest level.
    Finished,
    /// The budget ran out before that.
    OutOfBudget,
    /// No level has points in view.
    NothingInView,
}

/// The result of an alignment.
#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    /// The best state found.
    pub state: AlignedState,
    /// Finest level on which the state was solved.
    pub level: usize,
    /// Points of that level, in view or not.
    pub points: usize,
    /// Iterations of each level, finest first.
    pub iterations: [u32; MAX_LEVELS],
    /// Why it ended.
    pub ending: Ending,
    /// Mean squared flow from the keyframe, pixels² of level 0.
    pub mean_squared_flow: f64,
    /// Scatter of the gradient over the image at the state.
    pub scatter: GradientScatter,
}

impl Alignment {
    /// Covariance of the left increment of `current_from_keyframe`, calibrated by the inflation of `params`; `None` if
    /// the images do not determine the pose. An alignment cut short by its budget is also uncertain by the step that it
    /// could not take.
    pub fn covariance(&self, params: &AlignmentParams) -> Option<Matrix6<f64>> {
        let all = self.scatter.covariance(&self.state.sums)?;
        let covariance = all.fixed_view::<6, 6>(0, 0) * params.covariance_inflation;
        if self.ending != Ending::OutOfBudget {
            return Some(covariance);
        }
        // The next step estimates the distance to where the alignment would have ended.
        let step = pose_step(&self.state.sums.damped_step(0.0)?);
        Some(covariance + step * step.transpose())
    }

    /// The contribution of the common errors of the depth of `reference`: (−M⁻¹H) P (−M⁻¹H)ᵀ; `None` if the images do
    /// not determine the pose.
    pub fn covariance_from_modes(&self, reference: &Reference) -> Option<Matrix6<f64>> {
        let moved = self.d_pose_d_modes(reference)?;
        Some(moved * reference.mode_covariance().matrix() * moved.transpose())
    }

    /// Derivative of the left increment of `current_from_keyframe` with respect to the common errors of the depth of
    /// `reference`; `None` if the images do not determine the pose.
    pub fn d_pose_d_modes(&self, reference: &Reference) -> Option<Matrix6x3<f64>> {
        let centre = reference.level(self.level).centre();
        let translation = &self.state.current_from_keyframe.translation;
        self.scatter.d_pose_d_modes(&self.state.sums, translation, &centre)
    }
}

/// Aligns frames to references.
#[derive(Debug, Clone)]
pub struct Aligner {
    pub(super) params: AlignmentParams,
    kernel: Kernel,
}

impl Aligner {
    /// An aligner with these parameters.
    pub fn new(params: AlignmentParams) -> Self {
        let kernel = Kernel::choose(params.simd);
        Self { params, kernel }
    }

    /// The sums at one state on one level, priors included. The depth variance weights the residuals as if the
    /// translation were `variance_translation`, which is held fixed while a level is solved: an energy of r/σ_r alone
    /// falls when σ_r grows with the translation, however bad the fit.
    pub fn evaluate(
        &self,
        reference: &Reference,
        frame: &SumPyramid,
        level: usize,
        current_from_keyframe: &SE3,
        brightness: Brightness,
        variance_translation: &Vector3<f64>,
    ) -> AlignedState {
        let at = Evaluation::new(
            &reference.intrinsics().at_level(level),
            level,
            current_from_keyframe,
            brightness,
            &self.params,
            variance_translation,
        );
        let mut sums = self.kernel.accumulate(reference.level(level), frame.level(level), &at);
        let of_translation = reference.translation_information();
        if of_translation > 0.0 {
            for axis in 0..3 {
                sums.add_prior(axis, current_from_keyframe.translation[axis], of_translation);
            }
        }
        if self.params.estimate_brightness {
            let information = |std_dev: f64| 1.0 / (std_dev * std_dev);
            sums.add_prior(6, brightness.a, information(self.params.gain_prior_std_dev));
            sums.add_prior(7, brightness.b, information(self.params.offset_prior_std_dev));
        } else {
            sums.fix(6);
            sums.fix(7);
        }
        AlignedState {
            current_from_keyframe: *current_from_keyframe,
            brightness,
            variance_translation: *variance_translation,
            sums,
        }
    }

    /// Aligns `frame` to `reference` from an initial guess, from the coarsest level both have down to the finest.
    /// `budget` is called with the level before each iteration.
    pub fn align(
        &self,
        reference: &Reference,
        frame: &SumPyramid,
        current_from_keyframe: &SE3,
        brightness: Brightness,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> Alignment {
        let mut alignment = self.start(reference, frame, current_from_keyframe, brightness);
        self.descend(reference, frame, &mut alignment, budget);
        alignment
    }

    /// Evaluates the initial guess on the coarsest level with points.
    pub fn start(
        &self,
        reference: &Reference,
        frame: &SumPyramid,
        current_from_keyframe: &SE3,
        brightness: Brightness,
    ) -> Alignment {
        let level = next_finer_level(reference, frame, frame.num_levels()).unwrap_or(0);
        Alignment {
            state: self.evaluate(
                reference,
                frame,
                level,
                current_from_keyframe,
                brightness,
                &current_from_keyframe.translation,
            ),
            level,
            points: reference.level(level).len(),
            iterations: [0; MAX_LEVELS],
            ending: Ending::NothingInView,
            mean_squared_flow: 0.0,
            scatter: GradientScatter::default(),
        }
    }

    /// Evaluates an alignment that was cut short on the finest level at this pose, without a step: there its statistics
    /// show how well it fits, and it can be compared with others.
    pub fn evaluate_on_finest(
        &self,
        reference: &Reference,
        frame: &SumPyramid,
        cut_short: &Alignment,
        current_from_keyframe: &SE3,
        brightness: Brightness,
    ) -> Alignment {
        let finest = reference.finest_level().max(frame.finest_level());
        let held = &current_from_keyframe.translation;
        let mut alignment = Alignment {
            state: self.evaluate(reference, frame, finest, current_from_keyframe, brightness, held),
            level: finest,
            points: reference.level(finest).len(),
            ..cut_short.clone()
        };
        self.measure(reference, frame, &mut alignment);
        alignment
    }

    /// Solves the levels below the current one of `alignment`, down to the finest.
    pub fn descend(
        &self,
        reference: &Reference,
        frame: &SumPyramid,
        alignment: &mut Alignment,
        budget: &mut dyn FnMut(usize) -> bool,
    ) {
        let finest = reference.finest_level().max(frame.finest_level());
        let solved = alignment.iterations[alignment.level] > 0;
        let first = if solved { alignment.level } else { alignment.level + 1 };
        for level in (finest..first).rev() {
            if !reference.level(level).is_empty()
                && !self.solve_level(reference, frame, level, alignment, budget)
            {
                break;
            }
        }
        self.measure(reference, frame, alignment);
    }

    /// Iterates on one level; returns whether there is budget for the next.
    pub fn solve_level(
        &self,
        reference: &Reference,
        frame: &SumPyramid,
        level: usize,
        alignment: &mut Alignment,
        budget: &mut dyn FnMut(usize) -> bool,
    ) -> bool {
        if !budget(level) {
            alignment.ending = Ending::OutOfBudget;
            return false;
        }
        let AlignedState { current_from_keyframe, brightness, .. } = alignment.state;
        let held = current_from_keyframe.translation;
        let mut state =
            self.evaluate(reference, frame, level, &current_from_keyframe, brightness, &held);
        let points = reference.level(level).len();
        let min_in_view = self.params.min_in_view * points as f64;
        if f64::from(state.sums.compared) < min_in_view.max(UNKNOWNS as f64) {
            return true;
        }
        let (mut damping, mut within_budget) = (Damping::default(), true);
        for iteration in 0..self.params.max_iterations[level] {
            // The evaluation above paid for the first iteration.
            if iteration > 0 && !budget(level) {
                within_budget = false;
                break;
            }
            let Some(step) = state.sums.damped_step(damping.lambda).filter(is_sane) else {
                if damping.fail() {
                    break;
                }
                continue;
            };
            alignment.iterations[level] += 1;
            let (pose, brightness) = state.moved_by(&step);
            let candidate = self.evaluate(reference, frame, level, &pose, brightness, &held);
            let is_small = state.sums.decrement(&step) < self.params.step_tolerance;
            let is_over = if candidate.is_acceptable_after(&state, min_in_view) {
                let is_flat = candidate.energy_ratio(&state) > self.params.energy_tolerance
                    && step_in_pixels(&step, reference, level) < FLAT_STEP_PX;
                state = candidate;
                damping.succeed();
                is_flat
            } else {
                damping.fail()
            };
            if is_small || is_over {
                break;
            }
        }
        alignment.state = state;
        alignment.level = level;
        alignment.points = points;
        alignment.ending = if within_budget { Ending::Finished } else { Ending::OutOfBudget };
        within_budget
    }

    /// The sums of an alignment on its level as if every depth were exact, so that several alignments can be compared.
    /// (∂r/∂d)² V grows with the translation, so that with its own σ_r the alignment farthest from the keyframe would
    /// explain any image best; and no single translation is fair to all, since it would be that of one of them.
    pub fn sums_with_exact_depth(
        &self,
        reference: &Reference,
        frame: &SumPyramid,
        alignment: &Alignment,
    ) -> NormalEquations {
        let AlignedState { current_from_keyframe, brightness, .. } = &alignment.state;
        let (level, nowhere) = (alignment.level, Vector3::zeros());
        let state =
            self.evaluate(reference, frame, level, current_from_keyframe, *brightness, &nowhere);
        state.sums
    }

    /// Computes the statistics of the final state of an alignment, with the same weights as its sums.
    fn measure(&self, reference: &Reference, frame: &SumPyramid, alignment: &mut Alignment) {
        let level = alignment.level;
        let AlignedState { current_from_keyframe, brightness, variance_translation, .. } =
            &alignment.state;
        let at = Evaluation::new(
            &reference.intrinsics().at_level(level),
            level,
            current_from_keyframe,
            *brightness,
            &self.params,
            variance_translation,
        );
        let points = reference.level(level);
        let squared_pixel = f64::from(1u32 << (2 * level));
        alignment.mean_squared_flow = mean_squared_flow(points, &at) * squared_pixel;
        alignment.scatter = self.kernel.scatter(points, frame.level(level), &at);
    }
}

/// A step is accepted if it raises the mean energy by less than this: interpolation smooths noise, so that the energy
/// is lowest between pixels, while the gradient is not affected.
const TOLERATED_RISE: f64 = 1.02;

/// When the energy stops falling, the level ends only if the step is below this, pixels of the level: near its minimum
/// the energy hardly depends on the state.
const FLAT_STEP_PX: f64 = 0.1;

/// A step that moves more than half of the points out of the image, or beyond the range of the sensor, is unreliable
/// even if the rest fits better.
const MIN_KEPT_IN_VIEW: f64 = 0.5;

/// Whether a step is plausible: a rotation beyond a quarter turn or a gain beyond e² is an artefact of a nearly
/// singular system.
fn is_sane(step: &SVector<f64, UNKNOWNS>) -> bool {
    let rotation = step.fixed_rows::<3>(3).norm();
    rotation < std::f64::consts::FRAC_PI_2 && step[6].abs() < 2.0
}

/// Displacement of the image by a step, pixels of the level: f (‖t‖ d̄ + ‖ω‖).
fn step_in_pixels(step: &SVector<f64, UNKNOWNS>, reference: &Reference, level: usize) -> f64 {
    let at = reference.intrinsics().at_level(level);
    let translation = step.fixed_rows::<3>(0).norm() * reference.mean_inverse_depth();
    let rotation = step.fixed_rows::<3>(3).norm();
    at.fx.max(at.fy) * (translation + rotation)
}
