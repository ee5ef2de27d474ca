//! Several starts of the joint fit, of which the best is kept.
//!
//! With little parallax the energy has several minima (near and far exchanged, a translation taken for a rotation), and
//! a fit that started in the wrong one stays there while the baseline grows. So each frame is fitted from the results
//! of the previous frame's two best fits, from these aligned first with the depths they found, from rest, from the
//! mirrored solution and, in the first frame and once parallax may show, from a small step in each direction. The
//! earlier frames choose between the two best.

use nalgebra::{Vector3, Vector6};
use rayon::prelude::*;

use crate::slam::geometry::se3::SE3;
use crate::slam::two_frame::earlier_frames::EarlierFrames;
use crate::slam::two_frame::fit::{
    FitInput, FitParams, FitScratch, Freedom, fit_level, predicted_decrease_by_slopes,
};
use crate::slam::two_frame::state::State;
use crate::slam::two_frame::system::compare;

/// Survivors, the same aligned first, rest, mirror and six directions.
const MAX_HYPOTHESES: usize = 2 * NUM_SURVIVORS + 2 + 6;
/// Fits that continue to the finest level and to the next frame.
const NUM_SURVIVORS: usize = 2;

/// Cosine of 30°: closer directions are the same motion, estimated inaccurately.
pub(super) const RIVAL_COSINE: f64 = 0.87;

/// One start and its result.
#[derive(Debug)]
struct MotionHypothesis {
    state: State,
    energy: f64,
    scratch: FitScratch,
}

/// The second best motion of a frame, if its direction clearly differs from the best.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rival {
    /// Excess of its energy, over this frame and the earlier ones, relative to the best.
    pub excess: f64,
    /// Rotation of the best motion over that of this one.
    pub turn_ratio: f64,
    /// Rotation between the two, radians, over the translation of the best in mean depths: for the two motions that a
    /// plane allows, the sine of the angle between the path and its normal.
    pub turn_apart: f64,
}

/// The hypotheses of one frame, best first after a fit.
#[derive(Debug)]
pub struct Hypotheses {
    all: Vec<MotionHypothesis>,
    used: usize,
    /// How many of the first ones are results of the previous frame.
    survivors: usize,
    /// The second best motion of the latest frame, if the two differ clearly in direction.
    pub rival: Option<Rival>,
    /// Number of earlier frames that scored the latest one; 0 where there is only one motion.
    pub scored_by: usize,
}

impl Hypotheses {
    /// Memory for all hypotheses, each with the same state.
    pub fn new(state: &State) -> Self {
        let empty = |_| MotionHypothesis {
            state: state.clone(),
            energy: f64::INFINITY,
            scratch: FitScratch::default(),
        };
        let all = (0..MAX_HYPOTHESES).map(empty).collect();
        Self { all, used: 0, survivors: 0, rival: None, scored_by: 0 }
    }

    /// Forgets the results of earlier frames.
    pub fn restart(&mut self) {
        (self.used, self.survivors) = (0, 0);
        (self.rival, self.scored_by) = (None, 0);
    }

    /// Fits all hypotheses to a frame. `rotation` is its fit without translation; `with_directions` adds the starts in
    /// each direction, and scores the survivors by `earlier_frames`, which pays only where there may be parallax. The
    /// result does not depend on the number of threads.
    pub fn fit(
        &mut self,
        input: &FitInput<'_>,
        rotation: &State,
        with_directions: bool,
        earlier_frames: &EarlierFrames,
        params: &FitParams,
    ) {
        self.propose(rotation, with_directions);
        let fit_down_to =
            |finest: usize, from: usize, freedom, hypothesis: &mut MotionHypothesis| {
                for level in (finest..from).rev() {
                    let (state, scratch) = (&mut hypothesis.state, &mut hypothesis.scratch);
                    hypothesis.energy = fit_level(input, level, freedom, state, scratch, params);
                }
            };
        /// Level down to which every start is fitted: one level coarser, at 160 columns, a wrong minimum of a recording
        /// looks better than the right one.
        const COARSE_LEVEL: usize = 1;
        let levels = input.images.len();
        let coarse = COARSE_LEVEL.min(levels - 1);
        let all = &mut self.all[..self.used];
        let aligned = self.survivors..2 * self.survivors;
        all[aligned].par_iter_mut().for_each(|h| fit_down_to(coarse, levels, Freedom::Pose, h));
        all.par_iter_mut().for_each(|h| fit_down_to(coarse, levels, Freedom::Everything, h));
        all.sort_by(|a, b| a.energy.total_cmp(&b.energy));
        self.survivors = bring_forward_distinct(all);
        if coarse > 0 {
            let best = all[..self.survivors].par_iter_mut();
            best.for_each(|h| fit_down_to(0, coarse, Freedom::Everything, h));
            all[..self.survivors].sort_by(|a, b| a.energy.total_cmp(&b.energy));
        }
        (self.rival, self.scored_by) = (None, 0);
        if with_directions && self.survivors > 1 {
            self.score(input, earlier_frames, params);
        }
    }

    /// Puts the survivor first whose depths best explain the images of this frame and the earlier ones.
    fn score(&mut self, input: &FitInput<'_>, earlier_frames: &EarlierFrames, params: &FitParams) {
        self.scored_by = earlier_frames.len();
        let of_this_frame = compare(&self.all[0].scratch.system, &self.all[1].scratch.system);
        let depths = [0, 1].map(|i| self.all[i].state.inverse_depths.as_slice());
        let of_earlier_frames = earlier_frames.compare(input, depths, params);
        let [mut best, mut other] = [0, 1].map(|i| of_this_frame[i] + of_earlier_frames[i]);
        /// A motion that sees less than this share of the other's points has lost them, however well the rest fits.
        const MIN_SEEN: f64 = 1.0 / 3.0;
        let seen = [0, 1].map(|i| self.all[i].scratch.system.num_visible as f64);
        let [is_blind, other_is_blind] = [0, 1].map(|i| seen[i] < MIN_SEEN * seen[1 - i]);
        if is_blind || other < best && !other_is_blind {
            self.all.swap(0, 1);
            std::mem::swap(&mut best, &mut other);
        }
        let poses = [0, 1].map(|i| self.all[i].state.current_from_first.inverse());
        if heading(&poses[0]).dot(&heading(&poses[1])) < RIVAL_COSINE {
            let turns = poses.map(|pose| pose.rotation.angle().max(f64::MIN_POSITIVE));
            let excess = (other - best) / best.max(f64::MIN_POSITIVE);
            let translation = poses[0].translation.norm() * mean(&self.all[0].state.inverse_depths);
            let between = (poses[0].rotation.inverse() * poses[1].rotation).angle();
            self.rival = Some(Rival {
                excess,
                turn_ratio: turns[0] / turns[1],
                turn_apart: between / translation.max(f64::MIN_POSITIVE),
            });
        }
    }

    /// Share by which the energy of the best fit would decrease if the gain could vary over the image.
    pub fn predicted_decrease_by_slopes(
        &mut self,
        input: &FitInput<'_>,
        params: &FitParams,
    ) -> f64 {
        let best = &mut self.all[0];
        predicted_decrease_by_slopes(input, 0, &best.state, &mut best.scratch, params)
    }

    /// Lets the gain vary over the image, from the next fit on.
    pub fn free_slopes(&mut self) {
        self.all[..self.survivors].iter_mut().for_each(|h| h.state.free_slopes());
    }

    /// Fits the best hypothesis again on one level, from its current state.
    pub fn refit(&mut self, input: &FitInput<'_>, level: usize, params: &FitParams) {
        let best = &mut self.all[0];
        let (state, scratch) = (&mut best.state, &mut best.scratch);
        best.energy = fit_level(input, level, Freedom::Everything, state, scratch, params);
    }

    /// The best fit with its normal equations at the finest level; before any fit the initial state.
    pub fn best(&mut self) -> (&mut State, &FitScratch) {
        let best = &mut self.all[0];
        (&mut best.state, &best.scratch)
    }

    /// Sets the starts after the survivors. The first of them are the survivors again, to be aligned with their depths
    /// before these are free: where the camera moved by many pixels, depths end in wrong minima before the pose is
    /// right.
    fn propose(&mut self, rotation: &State, with_directions: bool) {
        self.used = self.survivors;
        for survivor in 0..self.survivors {
            let state = self.all[survivor].state.clone();
            self.add(&state, state.current_from_first, |d| d);
        }
        self.add(rotation, rotation.current_from_first, |_| 1.0);
        if self.survivors > 0 {
            let best = self.all[0].state.clone();
            let pose = mirrored(&best.current_from_first, &rotation.current_from_first);
            // Near and far exchanged about the mean; a point nearer than twice that becomes distant.
            self.add(&best, pose, |d| (2.0 - d).clamp(0.1, 2.0));
        }
        if with_directions {
            for axis in 0..6 {
                let pose = stepped(&rotation.current_from_first, axis);
                self.add(rotation, pose, |_| 1.0);
            }
        }
    }

    fn add(&mut self, like: &State, current_from_first: SE3, depth: impl Fn(f32) -> f32) {
        let state = &mut self.all[self.used].state;
        state.current_from_first = current_from_first;
        (state.brightness, state.gain_slopes) = (like.brightness, like.gain_slopes);
        state.inverse_depths.clear();
        state.inverse_depths.extend(like.inverse_depths.iter().map(|&d| depth(d)));
        self.used += 1;
    }
}

/// Moves the best hypothesis whose direction differs from that of the best one to the second position; returns the
/// number of survivors.
fn bring_forward_distinct(sorted: &mut [MotionHypothesis]) -> usize {
    /// Cosine of 15° between directions that count as the same.
    const SAME_COSINE: f64 = 0.966;
    let direction = |i: usize| heading(&sorted[i].state.current_from_first);
    let best = direction(0);
    let other = (1..sorted.len()).find(|&i| direction(i).dot(&best) < SAME_COSINE);
    let Some(other) = other else { return 1 };
    sorted.swap(1, other);
    NUM_SURVIVORS
}

/// Mean of the inverse depths.
fn mean(inverse_depths: &[f32]) -> f64 {
    inverse_depths.iter().map(|&d| f64::from(d)).sum::<f64>() / inverse_depths.len().max(1) as f64
}

/// Direction of a pose's translation; zero without one.
fn heading(pose: &SE3) -> Vector3<f64> {
    pose.translation / pose.translation.norm().max(f64::MIN_POSITIVE)
}

/// The mirrored pose: the translation reversed, the rotation on the other side of the one that best explains the frame
/// without translation.
fn mirrored(current_from_first: &SE3, rotation_alone: &SE3) -> SE3 {
    let best = rotation_alone.rotation;
    SE3 {
        rotation: best * current_from_first.rotation.inverse() * best,
        translation: -current_from_first.translation,
    }
}

/// A step along one of ±x, ±y, ±z with the rotation that keeps the centre of the image in place.
fn stepped(rotation_alone: &SE3, axis: usize) -> SE3 {
    /// In mean depths: about the size at which a start is proven.
    const STEP: f64 = 0.02;
    let mut step = Vector3::zeros();
    step[axis % 3] = if axis < 3 { STEP } else { -STEP };
    // At depth 1 the centre moves by (t_x + ω_y, t_y − ω_x).
    let turn = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, step.y, -step.x, 0.0));
    SE3 { rotation: turn.rotation * rotation_alone.rotation, translation: step }
}
