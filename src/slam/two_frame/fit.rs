//! Levenberg–Marquardt on pose, brightness and inverse depths jointly, coarse to fine; and on rotation and brightness
//! alone.

use nalgebra::{SMatrix, SVector, Vector6};
use serde::{Deserialize, Serialize};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::image::noise::ImageNoise;
use crate::slam::kernel::Kernel;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::two_frame::elimination::{Elimination, PriorWeights, prior_energy};
use crate::slam::two_frame::lanes::{FIRST_SLOPE, NUM_UNKNOWNS};
use crate::slam::two_frame::points::Points;
use crate::slam::two_frame::state::State;
use crate::slam::two_frame::system::{LevelView, System};
use crate::slam::two_frame::system_kernel::{Medians, Reduction};

/// Tuning of the fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FitParams {
    /// The camera's noise, which weights images against priors and is configured once for all.
    #[serde(skip)]
    pub noise: ImageNoise,
    /// Standard deviation of an inverse depth about its neighbours' median; the mean is 1.
    pub neighbour_std_dev: f32,
    /// Standard deviation of an inverse depth about 1: loose, rooms vary by more than a factor of 2.
    pub depth_std_dev: f32,
    /// Maximum number of iterations per level.
    pub max_iterations: u32,
    /// A level has converged when a step lowers the energy by less than this share, or is predicted to.
    pub min_energy_drop: f64,
}

impl Default for FitParams {
    fn default() -> Self {
        Self {
            noise: ImageNoise::default(),
            neighbour_std_dev: 0.5,
            depth_std_dev: 1.0,
            max_iterations: 20,
            min_energy_drop: 3e-4,
        }
    }
}

impl FitParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("neighbour_std_dev", self.neighbour_std_dev, 0.01..=100.0)?;
        check_range("depth_std_dev", self.depth_std_dev, 0.01..=100.0)?;
        check_range("max_iterations", self.max_iterations, 1..=1000)?;
        check_range("min_energy_drop", self.min_energy_drop, 0.0..=0.5)
    }

    /// A copy with priors that constrain only the unit and points without any information.
    pub fn released(&self) -> Self {
        /// Factor on the standard deviations of the priors: a hundredth of their weight. Thirty changes no
        /// figure any more.
        const RELEASE: f32 = 10.0;
        /// Weakly constrained modes take more and smaller steps.
        const MAX_ITERATIONS: u32 = 40;
        const MIN_ENERGY_DROP: f64 = 1e-6;
        Self {
            neighbour_std_dev: RELEASE * self.neighbour_std_dev,
            depth_std_dev: RELEASE * self.depth_std_dev,
            max_iterations: MAX_ITERATIONS,
            min_energy_drop: MIN_ENERGY_DROP,
            ..self.clone()
        }
    }

    fn prior_weights(&self) -> PriorWeights {
        // A residual is the difference of two noisy values.
        let noise = 2.0 * self.noise.pixel_std_dev * self.noise.pixel_std_dev;
        PriorWeights {
            neighbour: noise / self.neighbour_std_dev.powi(2),
            depth: noise / self.depth_std_dev.powi(2),
        }
    }
}

/// The current frame at all levels, with the points of the first.
#[derive(Debug, Clone, Copy)]
pub struct FitInput<'a> {
    /// The frame, finest level first.
    pub images: &'a [Image<f32>],
    /// Level of the first of the images.
    pub finest: usize,
    /// Intrinsics of all levels.
    pub intrinsics: &'a [Intrinsics],
    /// Points of the first frame.
    pub points: &'a Points,
}

impl<'a> FitInput<'a> {
    /// One level, from the finest one on.
    pub fn level(&self, level: usize) -> LevelView<'a> {
        LevelView {
            image: &self.images[level - self.finest],
            intrinsics: &self.intrinsics[level],
            patches: &self.points.patches[level],
        }
    }
}

/// The free unknowns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Freedom {
    /// Rotation and brightness.
    Rotation,
    /// Pose and brightness; the depths are fixed.
    Pose,
    /// Pose, brightness and depths.
    Everything,
}

/// Memory of the fit.
#[derive(Debug, Default)]
pub struct FitScratch {
    /// Normal equations at the best state so far; after a fit, at its result on the last level.
    pub system: System,
    trial: System,
    elimination: Elimination,
    medians: Vec<f32>,
    trial_depths: Vec<f32>,
}

/// Fits `state` on one level and returns its final energy, including the priors.
pub fn fit_level(
    input: &FitInput<'_>,
    level: usize,
    freedom: Freedom,
    state: &mut State,
    scratch: &mut FitScratch,
    params: &FitParams,
) -> f64 {
    let view = input.level(level);
    let weights = params.prior_weights();
    scratch.system.evaluate(&view, state);
    find_medians(input, state, &mut scratch.medians);
    let mut damping = Damping::FIRST;
    let mut before = energy(&scratch.system, state, &scratch.medians, weights);
    for _ in 0..params.max_iterations {
        let Some(step) = step_of(freedom, scratch, state, damping.factor, weights) else {
            // The model does not hold as far as the step that it suggests.
            if damping.fail() {
                break;
            }
            continue;
        };
        let least_drop = params.min_energy_drop * before;
        if step.predicted_decrease < least_drop {
            break;
        }
        let depths = std::mem::take(&mut scratch.trial_depths);
        let mut next = State { inverse_depths: depths, ..moved(state, &step.of_pose) };
        if freedom != Freedom::Everything {
            next.inverse_depths.clone_from(&state.inverse_depths);
        }
        scratch.trial.evaluate(&view, &next);
        let after = energy(&scratch.trial, &next, &scratch.medians, weights);
        let is_over = if after < before {
            std::mem::swap(state, &mut next);
            std::mem::swap(&mut scratch.system, &mut scratch.trial);
            let is_small = before - after < least_drop;
            find_medians(input, state, &mut scratch.medians);
            before = energy(&scratch.system, state, &scratch.medians, weights);
            damping.succeed();
            is_small
        } else {
            damping.fail()
        };
        scratch.trial_depths = next.inverse_depths;
        if is_over {
            break;
        }
    }
    before
}

/// A matrix over the unknowns of pose and brightness: normal equations, or the covariance for residuals of variance 1.
pub type PoseMatrix = SMatrix<f64, NUM_UNKNOWNS, NUM_UNKNOWNS>;

/// Damping of the steps, and how many further consecutive ones may fail.
struct Damping {
    factor: f64,
    patience: u32,
}

impl Damping {
    /// A level that is far from its minimum may need smaller steps than the first.
    const FIRST: Self = Self { factor: 0.01, patience: 3 };

    /// A step lowered the energy. Once one no longer does, only kinks between pixels are left: of six smaller steps one
    /// lowered it, by less than half a per cent.
    fn succeed(&mut self) {
        const SUCCESS_FACTOR: f64 = 0.3;
        const MIN_DAMPING: f64 = 1e-6;
        self.factor = (self.factor * SUCCESS_FACTOR).max(MIN_DAMPING);
        self.patience = 1;
    }

    /// There was no step, or it did not lower the energy; returns whether to stop.
    fn fail(&mut self) -> bool {
        const FAILURE_FACTOR: f64 = 25.0;
        self.factor *= FAILURE_FACTOR;
        self.patience -= 1;
        self.patience == 0
    }
}

/// A step of the free unknowns; that of the depths is in the scratch.
struct Step {
    of_pose: SVector<f64, NUM_UNKNOWNS>,
    /// Predicted decrease of the energy if it were quadratic and the step undamped: −gᵀδ.
    predicted_decrease: f64,
}

/// Energy of `system`, evaluated at `state`, with the priors.
fn energy(system: &System, state: &State, medians: &[f32], weights: PriorWeights) -> f64 {
    system.energy + prior_energy(&state.inverse_depths, medians, weights)
}

/// The step of the free unknowns; free depths after it are written to `trial_depths`. `None` where it cannot be taken.
fn step_of(
    freedom: Freedom,
    scratch: &mut FitScratch,
    state: &State,
    damping: f64,
    weights: PriorWeights,
) -> Option<Step> {
    if freedom == Freedom::Everything {
        scratch.elimination.weights = weights;
        return joint_step(scratch, state, damping);
    }
    let system = &scratch.system;
    let mut hessian = system.hessian;
    for i in 0..NUM_UNKNOWNS {
        hessian[(i, i)] = hessian[(i, i)] * (1.0 + damping) + f64::MIN_POSITIVE;
    }
    let of_pose = solve_free(freedom, system.has_slopes, &hessian, &system.gradient)?;
    Some(Step { of_pose, predicted_decrease: -system.gradient.dot(&of_pose) })
}

/// The state after a step of pose and brightness, without depths.
fn moved(state: &State, step: &SVector<f64, NUM_UNKNOWNS>) -> State {
    /// Slope behind a lens that loses half of the light in the corners, where the image has moved by a tenth to a fifth
    /// of its width, 1 per unit of the ray. Without the bound, slopes of 6 explain a different scene.
    const MAX_GAIN_SLOPE: f64 = 0.5;
    let twist = Vector6::from_iterator(step.iter().take(6).copied());
    let mut brightness = state.brightness;
    brightness.a += step[6];
    brightness.b += step[7];
    State {
        current_from_first: SE3::exp(&twist) * state.current_from_first,
        brightness,
        gain_slopes: state.gain_slopes.map(|slopes| {
            let slope = |i: usize| slopes[i] + step[FIRST_SLOPE + i];
            [0, 1].map(|i| slope(i).clamp(-MAX_GAIN_SLOPE, MAX_GAIN_SLOPE))
        }),
        inverse_depths: Vec::new(),
    }
}

fn find_medians(input: &FitInput<'_>, state: &State, medians: &mut Vec<f32>) {
    let (neighbours, inverse_depths) = (&input.points.neighbours, &state.inverse_depths);
    Kernel::fastest().run(Medians { neighbours, inverse_depths, medians });
}

/// −H⁻¹g over the free unknowns of pose and brightness; `None` where that is not a valid step.
fn solve_free(
    freedom: Freedom,
    has_slopes: bool,
    hessian: &PoseMatrix,
    gradient: &SVector<f64, NUM_UNKNOWNS>,
) -> Option<SVector<f64, NUM_UNKNOWNS>> {
    const ROTATION: usize = 3;
    const HELD: usize = FIRST_SLOPE - ROTATION;
    const FREE: usize = NUM_UNKNOWNS - ROTATION;
    let step = match (freedom, has_slopes) {
        (Freedom::Rotation, true) => solve::<ROTATION, FREE>(hessian, gradient),
        (Freedom::Rotation, false) => solve::<ROTATION, HELD>(hessian, gradient),
        (_, true) => solve::<0, NUM_UNKNOWNS>(hessian, gradient),
        (_, false) => solve::<0, FIRST_SLOPE>(hessian, gradient),
    };
    step.filter(is_sane)
}

/// −H⁻¹g over `COUNT` unknowns from `FIRST` on; 0 for the others.
fn solve<const FIRST: usize, const COUNT: usize>(
    hessian: &PoseMatrix,
    gradient: &SVector<f64, NUM_UNKNOWNS>,
) -> Option<SVector<f64, NUM_UNKNOWNS>> {
    let hessian = hessian.fixed_view::<COUNT, COUNT>(FIRST, FIRST).into_owned();
    let gradient = gradient.fixed_rows::<COUNT>(FIRST).into_owned();
    let mut step = SVector::<f64, NUM_UNKNOWNS>::zeros();
    step.fixed_rows_mut::<COUNT>(FIRST).copy_from(&hessian.cholesky()?.solve(&-gradient));
    Some(step)
}

/// The step of pose and brightness; the depths after it are written to `trial_depths`.
fn joint_step(scratch: &mut FitScratch, state: &State, damping: f64) -> Option<Step> {
    let (system, elimination) = (&scratch.system, &mut scratch.elimination);
    elimination.damping_factor = 1.0 + damping as f32;
    let (inverse_depths, medians) = (&state.inverse_depths, &scratch.medians);
    Kernel::fastest().run(Reduction { elimination, system, inverse_depths, medians });
    let (mut hessian, mut gradient) = (system.hessian, system.gradient);
    for r in 0..NUM_UNKNOWNS {
        hessian[(r, r)] *= 1.0 + damping;
        gradient[r] -= elimination.sums.row(r);
        // The factorisation reads only the lower triangle.
        for c in 0..=r {
            hessian[(r, c)] -= elimination.sums.entry(r, c);
        }
    }
    let of_pose = solve_free(Freedom::Everything, system.has_slopes, &hessian, &gradient)?;
    let after = &mut scratch.trial_depths;
    let by_depths = elimination.depths_after(system, &state.inverse_depths, &of_pose, after);
    Some(Step { of_pose, predicted_decrease: by_depths - system.gradient.dot(&of_pose) })
}

/// Whether a step can be taken: finite and within what two consecutive frames show.
fn is_sane(step: &SVector<f64, NUM_UNKNOWNS>) -> bool {
    /// In mean depths, radians and log gain; the offset is bounded by the grey scale.
    const LARGEST: f64 = 1.0;
    const OFFSET: usize = 7;
    step.iter().enumerate().all(|(i, x)| x.is_finite() && (i == OFFSET || x.abs() < LARGEST))
}

/// Share by which the energy of a fit that ended at `state` would decrease if the gain could vary over the image, to
/// first order: the predicted decrease with free slopes minus the one still predicted without. The scratch is left as
/// the fit left it on this level.
pub fn predicted_decrease_by_slopes(
    input: &FitInput<'_>,
    level: usize,
    state: &State,
    scratch: &mut FitScratch,
    params: &FitParams,
) -> f64 {
    let predicted = |scratch: &mut FitScratch, state: &State| {
        let step = step_of(Freedom::Everything, scratch, state, 0.0, params.prior_weights());
        step.map_or(0.0, |step| step.predicted_decrease)
    };
    let held = predicted(scratch, state);
    let mut freed = state.clone();
    freed.free_slopes();
    scratch.trial.evaluate(&input.level(level), &freed);
    std::mem::swap(&mut scratch.system, &mut scratch.trial);
    let free = predicted(scratch, &freed);
    std::mem::swap(&mut scratch.system, &mut scratch.trial);
    (free - held) / scratch.system.energy.max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::Brightness;
    use crate::slam::two_frame::lanes::{LANES, lanes};
    use crate::slam::two_frame::system::SystemBlock;

    /// For a quadratic energy, with its priors, the undamped step achieves the predicted decrease.
    #[test]
    fn a_step_achieves_the_predicted_decrease() {
        let block = SystemBlock {
            mixed: std::array::from_fn(|k| lanes(|l| 0.1 * ((3 * k + l) as f32).sin())),
            information: lanes(|l| 3.0 + l as f32),
            gradient: lanes(|l| 0.4 * (l as f32).cos()),
            energy: [0.0; LANES],
            weight: [1.0; LANES],
            squared_speed: [1.0; LANES],
            visible: [true; LANES],
        };
        let system = System {
            blocks: vec![block],
            num_points: LANES,
            hessian: SMatrix::identity() * 9.0,
            gradient: SVector::from_fn(|k, _| 0.3 * (k as f64).sin()),
            ..System::default()
        };
        let state = State {
            current_from_first: SE3::identity(),
            brightness: Brightness::default(),
            gain_slopes: None,
            inverse_depths: (0..LANES).map(|l| 0.8 + 0.05 * l as f32).collect(),
        };
        let weights = PriorWeights { neighbour: 0.7, depth: 0.5 };
        let medians = vec![1.1; LANES];
        let mut scratch = FitScratch { system, medians, ..FitScratch::default() };
        scratch.elimination.weights = weights;
        let Step { of_pose, predicted_decrease } = joint_step(&mut scratch, &state, 0.0).unwrap();

        let (system, before) = (&scratch.system, &state.inverse_depths);
        let quadratic = (of_pose.transpose() * system.hessian * of_pose)[0];
        let mut change = 2.0 * system.gradient.dot(&of_pose) + quadratic;
        for (l, point) in system.points().enumerate() {
            let moved = f64::from(scratch.trial_depths[l] - before[l]);
            let mixed = SVector::from(point.mixed.map(f64::from)).dot(&of_pose);
            let [gradient, information] = [point.gradient, point.information].map(f64::from);
            change += (2.0 * (gradient + mixed) + information * moved) * moved;
        }
        let prior = |depths: &[f32]| prior_energy(depths, &scratch.medians, weights);
        change += prior(&scratch.trial_depths) - prior(before);
        assert!(change < -0.05, "{change}");
        assert!(
            (predicted_decrease + change).abs() < 1e-4 * predicted_decrease,
            "{predicted_decrease} {change}"
        );
    }
}
