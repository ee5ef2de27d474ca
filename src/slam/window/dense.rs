//! Refines a keyframe's whole depth by comparing it with surrounding keyframes as the chosen points are, poses fixed.
//!
//! The filter saw each pixel in frames near its keyframe, at the tracker's poses. Keyframes are further away and their
//! poses more accurate: each inverse depth moves to where they agree best (Gauss–Newton, coarse to fine), and the
//! result is fused with the filter's value and with the neighbouring pixels. In the descent the filter's value is the
//! initial one and no prior: its errors are those of its poses, common to all pixels.

use std::collections::HashSet;
use std::ops::Range;

use rayon::prelude::*;

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::shared::SharedImage;
use crate::slam::kernel::{Body, Instructions, Kernel, SimdMode};
use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::slam::map::{LogPlane, Map, RefinedDepth};
use crate::slam::window::Window;
use crate::slam::window::comparison::{
    Compared, LANES, Pair, PairSums, Patterns, Robustness, SAMPLES, Wanted,
};
use crate::slam::window::keyframe::{WindowKeyframe, at_level, num_levels, sample_pattern};
use crate::slam::window::neighbours::{Neighbourhood, Single};
use crate::slam::window::params::WindowParams;
use crate::slam::window::plane::fit;

/// Keyframes that a keyframe's depth is compared with, those that see most of it. With four or eight, which are further
/// away, depth is no better; with two, ICL's median error is 1.9 % instead of 1.7.
const OBSERVERS: usize = 3;
/// Levels, and steps on each. Without level 1 the floor's median error is 2.2 % instead of 1.7.
const STEPS: [(usize, u32); 2] = [(1, 3), (0, 3)];
/// Points that are compared at a time: they stay in the cache.
const CHUNK: usize = 16 * LANES;
/// Largest factor by which a step may change a depth, either way: beyond it the linearisation does not hold.
const MAX_STEP: f32 = 1.3;
/// Samples of a pattern that err together: they overlap with their neighbours' interpolation.
const SAMPLES_TOGETHER: f64 = 2.0;
/// Depths that differ by more standard deviations than this belong to different surfaces: the filter's is kept.
const MAX_DEVIATIONS: f64 = 3.0;
/// Factor by which its variance then grows: it is half as certain.
const CONTRADICTED: f64 = 4.0;
/// Factor on the variance of a point on which filter and keyframes agree, for each squared standard deviation that they
/// are apart; with 2 instead of 1, one in a hundred more true depths lies within two standard deviations.
const DOUBT: f64 = 2.0;
/// Share of the filter's standard deviation that no keyframe removes: lens, shutter and slanted surfaces misplace a
/// pixel in all of them alike. Chosen by the share of true depths within one standard deviation: between 0.6 and 0.8 in
/// freiburg1_floor, ICL office3 and rooms.
const COMMON: f64 = 0.415;

/// The keyframes whose depth is to be refined, once nothing else is to be done.
#[derive(Debug, Clone, Default)]
pub(super) struct Refinement {
    waiting: Vec<u64>,
    /// Once only: fused depth is no longer the filter's, and a keyframe that none sees will not be seen later.
    done: HashSet<u64>,
    /// The keyframe that is being refined during mapping, and the result.
    begun: Option<Box<Keyframe>>,
    refined: Option<RefinedDepth>,
}

impl Refinement {
    /// Queues all keyframes that are not refined yet.
    pub fn begin(&mut self, keyframes: &[WindowKeyframe]) {
        let ids = keyframes.iter().map(|keyframe| keyframe.keyframe_id);
        self.waiting = ids.filter(|id| !self.done.contains(id)).collect();
    }
}

/// The estimate of a point.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct State {
    /// In 1 / unit of the map.
    inverse_depth: f32,
    /// H_dd.
    hessian: f32,
    /// Its right side.
    right: f32,
    /// Robust cost of the observers that agree, grey levels².
    cost: f32,
    /// Their number.
    inliers: u32,
}

/// The keyframes that a keyframe's depth is compared with, at one level.
struct Observers<'a> {
    level: usize,
    steps: u32,
    images: Vec<&'a SharedImage>,
    pairs: Vec<Pair>,
    robustness: Robustness,
}

impl Window {
    /// After the last estimate: takes the keyframe whose depth is to be refined next, the newest first.
    pub fn next_unrefined(&mut self) -> Option<u64> {
        let next = self.refinement.waiting.pop()?;
        self.refinement.done.insert(next);
        Some(next)
    }

    /// The estimate was dropped: depth is not refined from it.
    pub fn discard_refinement(&mut self) {
        let Refinement { waiting, done, begun, refined } = &mut self.refinement;
        waiting.clear();
        let begun = begun.take().map(|of| of.keyframe_id);
        for id in begun.into_iter().chain(refined.take().map(|of| of.keyframe_id)) {
            done.remove(&id);
        }
    }

    /// During mapping: takes the newest keyframe that is no longer free with every new one and has not been refined,
    /// for [`Window::optimise`]; false where there is none. Call it when there is nothing else to estimate.
    pub fn begin_refinement(&mut self, map: &Map, active: u64) -> bool {
        let Some(newest) = self.keyframes.len().checked_sub(1) else { return false };
        let of_epoch = self.of_epoch_up_to(newest);
        let WindowParams { num_free, num_first, .. } = self.params;
        if of_epoch.len() <= num_first {
            return false;
        }
        let settled = &of_epoch[..of_epoch.len().saturating_sub(num_free)];
        let keyframe = settled.iter().rev().find_map(|&index| {
            let id = self.keyframes[index].keyframe_id;
            let is_open = id != active && !self.refinement.done.contains(&id);
            map.get(id).filter(|of| is_open && of.has_depth() && !of.is_refined)
        });
        let Some(keyframe) = keyframe else { return false };
        self.moved.clear();
        self.marginals.clear();
        self.refinement.done.insert(keyframe.keyframe_id);
        self.refinement.begun = Some(Box::new(keyframe.clone()));
        true
    }

    /// The keyframe's depth has changed since its refinement began: it is refined another time.
    pub fn requeue_refinement(&mut self, keyframe_id: u64) {
        self.refinement.done.remove(&keyframe_id);
    }

    /// Refines the keyframe that was taken for this; false where none was.
    pub(super) fn run_refinement(&mut self) -> bool {
        let Some(keyframe) = self.refinement.begun.take() else { return false };
        self.refinement.refined = self.refine_keyframe(&keyframe);
        true
    }

    /// Takes the depth that was refined during mapping.
    pub fn take_refined(&mut self) -> Option<RefinedDepth> {
        self.refinement.refined.take()
    }

    /// Refines the depth of a keyframe of the map from those that see most of it; `None` where none does.
    pub fn refine_keyframe(&self, keyframe: &Keyframe) -> Option<RefinedDepth> {
        let index = self.index_of(keyframe.keyframe_id)?;
        let host = &self.keyframes[index];
        let is_other = |&k: &usize| k != index && self.keyframes[k].epoch == host.epoch;
        let others: Vec<usize> = (0..self.keyframes.len()).filter(is_other).collect();
        let mut observers = self.covisible(&others, &[index]);
        observers.truncate(OBSERVERS);
        if observers.is_empty() {
            return None;
        }
        let images = |&k: &usize| self.images_of(&self.keyframes[k]);
        let of_host = images(&index);
        let of_observers: Vec<Vec<SharedImage>> = observers.iter().map(images).collect();
        let levels: Vec<Observers<'_>> = STEPS
            .into_iter()
            .filter(|(level, _)| *level < of_host.len())
            .map(|(level, steps)| self.observers(host, &observers, &of_observers, level, steps))
            .collect();
        let points = self.placed_points(host, keyframe);
        let found = by_chunk(points.len(), |chunk| self.descend(&points[chunk], &of_host, &levels));
        let squared = mean_squared_residual(&found);
        let fuse = |place: usize| fused(&points[place], &found[place], squared);
        let singles = by_chunk(points.len(), |chunk| chunk.map(fuse).collect());
        let neighbourhood = Neighbourhood::new(&points, &singles, self.camera.width);
        let unit = keyframe.map_from_keyframe.scale as f32;
        let smooth = |place: usize| {
            let point = neighbourhood.smoothed(place);
            let (inverse_depth, variance) =
                (point.inverse_depth * unit, point.variance * unit * unit);
            DepthPoint { inverse_depth, variance, ..point }
        };
        let smooth = by_chunk(points.len(), |chunk| chunk.map(smooth).collect());
        let (keyframe_id, of_revision) = (keyframe.keyframe_id, keyframe.revision);
        Some(RefinedDepth { keyframe_id, of_revision, points: smooth })
    }

    /// A keyframe's images at the levels that are used.
    fn images_of(&self, keyframe: &WindowKeyframe) -> Vec<SharedImage> {
        let mut images: Vec<SharedImage> = keyframe.images.first().cloned().into_iter().collect();
        while let Some(finer) = images.last()
            && images.len() < STEPS.len().min(num_levels(&self.camera))
        {
            images.push(finer.halved());
        }
        images
    }

    fn observers<'a>(
        &self,
        host: &WindowKeyframe,
        observers: &[usize],
        images: &'a [Vec<SharedImage>],
        level: usize,
        steps: u32,
    ) -> Observers<'a> {
        let camera = self.camera.at_level(level);
        let wanted = Wanted { poses: false, depths: true, host: false };
        let pair = |&k: &usize| {
            let observer_from_host =
                self.keyframes[k].camera_from_map * host.camera_from_map.inverse();
            Pair::new(&observer_from_host, &camera, wanted)
        };
        Observers {
            level,
            steps,
            images: images.iter().map(|of| &of[level]).collect(),
            pairs: observers.iter().map(pair).collect(),
            robustness: self.robustness(),
        }
    }

    /// The keyframe's points, inverse depth in 1 / unit of the map, corrected by the plane that fits its chosen points.
    fn placed_points(&self, host: &WindowKeyframe, keyframe: &Keyframe) -> Vec<DepthPoint> {
        let [offset, per_x, per_y] =
            fit(&self.own_correspondences(host, keyframe)).unwrap_or_default();
        let plane = LogPlane { offset, per_x, per_y };
        let unit = keyframe.map_from_keyframe.scale;
        let place = |point: &DepthPoint| {
            let (u, v) = (f64::from(point.u), f64::from(point.v));
            let factor = (plane.factor(&self.camera, u, v) / unit) as f32;
            let (inverse_depth, variance) =
                (point.inverse_depth * factor, point.variance * factor * factor);
            DepthPoint { inverse_depth, variance, ..*point }
        };
        keyframe.points.iter().map(place).collect()
    }

    /// Moves the depths of some points to where the observers agree best.
    fn descend(
        &self,
        points: &[DepthPoint],
        images: &[SharedImage],
        levels: &[Observers<'_>],
    ) -> Vec<State> {
        let begin =
            |point: &DepthPoint| State { inverse_depth: point.inverse_depth, ..State::default() };
        let mut states: Vec<State> = points.iter().map(begin).collect();
        let mut chunk = Chunk::of(points.len());
        for observers in levels {
            let (level, camera) = (observers.level, &self.camera);
            let half_weight_gradient = self.params.half_weight_gradient;
            let (image, patterns) = (&images[level], &mut chunk.patterns);
            let appearance =
                PatternSampler { points, image, level, camera, half_weight_gradient, patterns };
            Kernel::fastest().run(appearance);
            chunk.descend(&mut states, observers);
        }
        states
    }
}

/// Applies `of` to all points by chunks: in parallel in a thread pool, alone in the estimates' thread alongside frames.
fn by_chunk<T: Send>(points: usize, of: impl Fn(Range<usize>) -> Vec<T> + Sync) -> Vec<T> {
    let chunk = |index: usize| of(CHUNK * index..(CHUNK * (index + 1)).min(points));
    let chunks = 0..points.div_ceil(CHUNK);
    match rayon::current_thread_index() {
        Some(_) => {
            chunks.into_par_iter().map(chunk).collect::<Vec<_>>().into_iter().flatten().collect()
        }
        None => chunks.flat_map(chunk).collect(),
    }
}

/// Determines the appearance of a host's points at a level.
struct PatternSampler<'a> {
    points: &'a [DepthPoint],
    image: &'a SharedImage,
    level: usize,
    camera: &'a Intrinsics,
    half_weight_gradient: f32,
    patterns: &'a mut [Patterns],
}

impl Body for PatternSampler<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        self.patterns.fill(Patterns::NONE);
        for (place, point) in self.points.iter().enumerate() {
            let [u, v] = [point.u, point.v].map(|pixel| at_level(pixel, self.level));
            let appearance = sample_pattern(self.image, u, v, self.half_weight_gradient);
            let ray = self.camera.ray(f64::from(point.u), f64::from(point.v));
            let ray = [ray.x as f32, ray.y as f32];
            self.patterns[place / LANES].set(place % LANES, &appearance, ray);
        }
    }
}

/// Points of a host at a level, and the results of their comparison with an observer.
struct Chunk {
    patterns: Vec<Patterns>,
    seen: Vec<Compared>,
}

impl Chunk {
    /// Buffers for this many points.
    fn of(points: usize) -> Self {
        let blocks = points.div_ceil(LANES);
        Self { patterns: vec![Patterns::NONE; blocks], seen: vec![Compared::NONE; blocks] }
    }

    /// A few steps for each point independently; a step that does not lower the cost is not taken.
    fn descend(&mut self, states: &mut [State], observers: &Observers<'_>) {
        self.linearise(states, observers);
        let mut trial = states.to_vec();
        for _ in 0..observers.steps {
            for (trial, state) in trial.iter_mut().zip(&*states) {
                trial.inverse_depth = state.stepped();
            }
            self.linearise(&mut trial, observers);
            for (state, trial) in states.iter_mut().zip(&trial) {
                if trial.energy(observers) < state.energy(observers) {
                    *state = *trial;
                }
            }
        }
    }

    fn linearise(&mut self, states: &mut [State], observers: &Observers<'_>) {
        for (block, states) in self.patterns.iter_mut().zip(states.chunks_mut(LANES)) {
            for (to, state) in block.inverse_depth.iter_mut().zip(states) {
                *to = state.inverse_depth;
                *state = State { inverse_depth: state.inverse_depth, ..State::default() };
            }
        }
        let kernel = Kernel::choose(SimdMode::Auto);
        for (image, pair) in observers.images.iter().zip(&observers.pairs) {
            let (mut sums, robustness) = (PairSums::default(), &observers.robustness);
            kernel.compare(image, pair, &self.patterns, robustness, &mut self.seen, &mut sums);
            for (seen, states) in self.seen.iter().zip(states.chunks_mut(LANES)) {
                for (lane, state) in states.iter_mut().enumerate() {
                    state.add(seen, lane);
                }
            }
        }
    }
}

impl State {
    fn add(&mut self, seen: &Compared, lane: usize) {
        if seen.cost[lane] < f32::INFINITY {
            self.inliers += 1;
            self.cost += seen.cost[lane];
        }
        self.hessian += seen.depth[lane];
        self.right += seen.depth_right[lane];
    }

    /// The minimum of the linear model, at most a factor of `MAX_STEP` away.
    fn stepped(&self) -> f32 {
        let Self { inverse_depth, hessian, right, .. } = *self;
        if !(hessian > 0.0 && inverse_depth > 0.0) {
            return inverse_depth;
        }
        let stepped = inverse_depth - right / hessian;
        stepped.clamp(inverse_depth / MAX_STEP, inverse_depth * MAX_STEP)
    }

    /// Cost of all observers, including those that see something else or nothing.
    fn energy(&self, observers: &Observers<'_>) -> f32 {
        let others = observers.pairs.len() as f32 - self.inliers as f32;
        self.cost + others * observers.robustness.most_energy
    }
}

/// Mean over the observers that agree, grey levels².
fn mean_squared_residual(found: &[State]) -> f64 {
    let cost: f64 = found.iter().map(|state| f64::from(state.cost)).sum();
    let inliers: usize = found.iter().map(|state| state.inliers as usize).sum();
    cost / (SAMPLES * inliers.max(1)) as f64
}

/// Fuses the filter's depth with that of the keyframes, weighted by certainty.
fn fused(filter: &DepthPoint, found: &State, mean_squared_residual: f64) -> Single {
    let (was, of_filter) = (f64::from(filter.inverse_depth), f64::from(filter.variance));
    let common = COMMON * COMMON * of_filter;
    // The filter's depth, its variance multiplied by `doubt`.
    let unchanged = |doubt: f64| Single {
        inverse_depth: was,
        own: doubt * (of_filter - common),
        common: doubt * common,
        most: doubt * of_filter,
    };
    if found.inliers == 0 || !(found.hessian > 0.0) {
        return unchanged(1.0);
    }
    let of_keyframes = SAMPLES_TOGETHER * mean_squared_residual / f64::from(found.hessian);
    let is = f64::from(found.inverse_depth);
    let apart = (is - was).powi(2) / (of_keyframes + of_filter);
    if !(apart <= MAX_DEVIATIONS * MAX_DEVIATIONS) {
        return unchanged(CONTRADICTED);
    }
    let share = of_filter / (of_filter + of_keyframes);
    // Depths that contradict each other are less certain than those that agree.
    let doubt = (DOUBT * apart).max(1.0);
    let own = share * of_keyframes;
    Single {
        inverse_depth: was + share * (is - was),
        own: doubt * own,
        common: doubt * common,
        most: doubt * (own + common).min(of_filter),
    }
}
