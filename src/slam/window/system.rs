//! The normal equations of a window and their reduction to the poses.
//!
//! With C_j = `camera_from_map` and left increments, the derivative with respect to the host's pose is that with
//! respect to the observer's times −Ad(C_j C_i⁻¹). Points are independent given the poses, so that each is eliminated
//! separately: `S = H − Σ h hᵀ/H_dd`.

use std::ops::Range;

use nalgebra::{DVector, Matrix6, Vector6};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::kernel::{Kernel, SimdMode};
use crate::slam::window::comparison::{
    Compared, LANES, POSE, Pair, PairSums, Robustness, SAMPLES, Wanted, sum,
};
use crate::slam::window::elimination_kernel::{
    Block, PADDED, PointRow, RowBlock, eliminate, lower,
};
use crate::slam::window::factors::{Factors, solve};
use crate::slam::window::functional::Functional;
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::view::{PairView, Views};

/// The normal equations at one state. Their memory is reused for the next.
#[derive(Debug, Clone, Default)]
pub struct System {
    /// Of the free poses, in order: the lower triangle, block by block.
    hessian: Vec<Block>,
    /// Right side.
    right: Vec<f64>,
    points: Vec<PointPart>,
    /// Σ w J ∂r/∂d of the observer, by comparison.
    mixed: Vec<[f32; PADDED]>,
    /// Cost of each comparison; NaN where it was never inside the image.
    costs: Vec<f32>,
    /// Results of the comparisons of one pair.
    seen: Vec<Compared>,
    /// What is eliminated, and the reduced equations.
    elimination: Elimination,
    /// Number of free poses.
    pub num_free: usize,
    /// Number of inliers among the comparisons.
    pub inliers: usize,
    /// Number of comparisons that were made.
    pub compared: usize,
    /// Sum of the costs of the inliers.
    pub inlier_cost: f64,
    /// Cost of the comparisons that were outside the image at the state before: left out of the comparison with it, but
    /// not of that with the next.
    pub entered_cost: f64,
}

/// Points that are eliminated at a time: their rows stay in the second-level cache.
const CHUNK: usize = 256;

/// Buffers of a solution.
#[derive(Debug, Clone, Default)]
struct Elimination {
    points: Vec<PointRow>,
    rows: Vec<RowBlock>,
    reduced: Vec<Block>,
    right: Vec<f64>,
}

/// The part of the normal equations of one point.
#[derive(Debug, Clone, Copy, Default)]
struct PointPart {
    /// Σ w J ∂r/∂d of its host.
    host: [f64; POSE],
    /// H_dd; 0 where no keyframe sees it.
    hessian: f64,
    /// Its right side.
    right: f64,
    inliers: u32,
}

/// Increments of the free parameters.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Step {
    /// Left increments (translation, rotation) of the free poses.
    pub poses: Vec<f64>,
    /// Increments of inverse depths, by point.
    pub depths: Vec<f64>,
    /// Decrease of the cost in the linear model.
    pub decrement: f64,
}

/// The keyframes that take part in an adjustment, and those of them that are free.
#[derive(Debug, Clone, Copy)]
pub struct Members<'a> {
    /// Indices in the list of keyframes.
    pub members: &'a [usize],
    /// For each, its number among the free ones; `None` where it is fixed.
    pub free: &'a [Option<usize>],
    /// Whether depths are free too.
    pub depths_are_free: bool,
}

/// The constants of all systems of a level.
#[derive(Debug, Clone, Copy)]
pub struct Level<'a> {
    /// Camera of level 0.
    pub camera: &'a Intrinsics,
    /// The level.
    pub level: usize,
    /// Robust weighting of residuals.
    pub robustness: Robustness,
}

/// Sums a pair's lanes into a pose's block and right side.
fn pose_sums(lanes: &PairSums) -> (Matrix6<f64>, Vector6<f64>) {
    let mut pose = Matrix6::zeros();
    let mut entry = 0;
    for row in 0..POSE {
        for column in row..POSE {
            let value = f64::from(sum(&lanes.pose[entry]));
            pose[(row, column)] = value;
            pose[(column, row)] = value;
            entry += 1;
        }
    }
    let right = Vector6::from_fn(|row, _| f64::from(sum(&lanes.right[row])));
    (pose, right)
}

impl System {
    /// Linearises at the state of `keyframes` and returns the cost. Comparisons that were outside the image `before`
    /// are left out; those that have left it since keep their previous cost.
    pub fn linearise(
        &mut self,
        keyframes: &[WindowKeyframe],
        members: &Members<'_>,
        views: &Views,
        at: &Level<'_>,
        before: Option<&System>,
    ) -> f64 {
        let kernel = Kernel::choose(SimdMode::Auto);
        let camera = at.camera.at_level(at.level);
        self.restart(members, views);
        let mut cost = 0.0;
        for of in &views.pairs {
            let [host, observer] = [of.host, of.observer].map(|k| &keyframes[members.members[k]]);
            let [host_is_free, is_free] = [of.host, of.observer].map(|k| members.free[k].is_some());
            let observer_from_host = observer.camera_from_map * host.camera_from_map.inverse();
            let wanted = Wanted {
                poses: host_is_free || is_free,
                depths: members.depths_are_free,
                host: host_is_free,
            };
            let pair = Pair::new(&observer_from_host, &camera, wanted);
            let (image, mut sums) = (&observer.images[at.level], PairSums::default());
            let patterns = &views.patterns[of.blocks()];
            self.seen.resize(patterns.len(), Compared::NONE);
            kernel.compare(image, &pair, patterns, &at.robustness, &mut self.seen, &mut sums);
            cost += self.note(of, &wanted, views, at, before);
            if wanted.poses {
                self.add_pair(of, members, &Pair::by_host(&observer_from_host), &sums);
            }
        }
        cost
    }

    fn restart(&mut self, members: &Members<'_>, views: &Views) {
        let num_free = members.free.iter().flatten().count();
        let size = POSE * num_free;
        self.num_free = num_free;
        self.hessian.clear();
        self.hessian.resize(lower(num_free, 0), [[0.0; PADDED]; POSE]);
        self.right.clear();
        self.right.resize(size, 0.0);
        self.points.clear();
        self.points.resize(views.points.len(), PointPart::default());
        self.mixed.clear();
        self.mixed.resize(views.slots.len(), [0.0; PADDED]);
        self.costs.clear();
        self.costs.resize(views.slots.len(), f32::NAN);
        (self.inliers, self.compared) = (0, 0);
        (self.inlier_cost, self.entered_cost) = (0.0, 0.0);
    }

    /// Stores the results of a pair's comparisons and returns the part of their cost that is comparable with the state
    /// before.
    fn note(
        &mut self,
        of: &PairView,
        wanted: &Wanted,
        views: &Views,
        at: &Level<'_>,
        before: Option<&System>,
    ) -> f64 {
        let most = at.robustness.most_energy;
        let mut totals = [0.0f64; LANES];
        for (block, seen) in of.blocks().zip(&self.seen) {
            let places = LANES * block..LANES * (block + 1);
            let costs = &mut self.costs[places.clone()];
            let was = before.map(|system| &system.costs[places.clone()]);
            for lane in 0..LANES {
                let found = seen.cost[lane];
                let (was, is_new) = match was {
                    Some(was) => (was[lane], was[lane].is_nan()),
                    None => (f32::NAN, false),
                };
                let cost = if found.is_nan() { was } else { found.min(most) };
                costs[lane] = cost;
                let is_same = found < f32::INFINITY;
                self.compared += usize::from(!found.is_nan());
                self.inliers += usize::from(is_same);
                self.inlier_cost += f64::from(if is_same { found } else { 0.0 });
                let cost = f64::from(if cost.is_nan() { 0.0 } else { cost });
                totals[lane] += if is_new { 0.0 } else { cost };
                self.entered_cost += if is_new { cost } else { 0.0 };
            }
            for (lane, &slot) in views.slots[places.clone()].iter().enumerate() {
                self.points[slot].add(seen, lane, wanted);
            }
            if wanted.depths && wanted.poses {
                for (lane, mixed) in self.mixed[places].iter_mut().enumerate() {
                    for (to, of) in mixed.iter_mut().zip(&seen.observer) {
                        *to = of[lane];
                    }
                }
            }
        }
        totals.iter().sum()
    }

    fn add_pair(
        &mut self,
        of: &PairView,
        members: &Members<'_>,
        by_host: &Matrix6<f64>,
        lanes: &PairSums,
    ) {
        let (i, j) = (members.free[of.host], members.free[of.observer]);
        let (pose, right) = pose_sums(lanes);
        if let Some(j) = j {
            self.add_block(j, j, &pose);
            self.add_right(j, &right);
        }
        if let Some(i) = i {
            self.add_block(i, i, &(by_host.transpose() * pose * by_host));
            self.add_right(i, &(by_host.transpose() * right));
        }
        if let (Some(i), Some(j)) = (i, j) {
            let between = pose * by_host;
            if j > i {
                self.add_block(j, i, &between);
            } else {
                self.add_block(i, j, &between.transpose());
            }
        }
    }

    /// Adds to the lower triangle.
    fn add_block(&mut self, row: usize, column: usize, block: &Matrix6<f64>) {
        let to = &mut self.hessian[lower(row, column)];
        for r in 0..POSE {
            for c in 0..POSE {
                to[r][c] += block[(r, c)];
            }
        }
    }

    fn add_right(&mut self, row: usize, of: &Vector6<f64>) {
        for r in 0..POSE {
            self.right[POSE * row + r] += of[r];
        }
    }

    /// Collects the rows of points to be eliminated.
    fn collect(
        &self,
        points: Range<usize>,
        members: &Members<'_>,
        views: &Views,
        damping: f64,
        to: &mut Elimination,
    ) {
        to.points.clear();
        to.rows.clear();
        for (part, view) in self.points[points.clone()].iter().zip(&views.points[points]) {
            if !(part.hessian > 0.0) {
                continue;
            }
            let first = to.rows.len();
            let [h0, h1, h2, h3, h4, h5] = part.host;
            let mut host = members.free[view.host].map(|pose| {
                let values = [h0, h1, h2, h3, h4, h5, 0.0, 0.0];
                (view.host, RowBlock { pose, values })
            });
            for link in views.links(view) {
                to.rows.extend(host.take_if(|(place, _)| *place < link.observer).map(|of| of.1));
                if let Some(pose) = members.free[link.observer] {
                    to.rows.push(RowBlock { pose, values: self.mixed[link.place].map(f64::from) });
                }
            }
            to.rows.extend(host.map(|of| of.1));
            let inverse = 1.0 / (part.hessian * (1.0 + damping));
            let count = to.rows.len() - first;
            to.points.push(PointRow { first, count, inverse, right: part.right });
        }
    }

    /// Computes the increments of poses and inverse depths with a share `damping` added to each diagonal element; false
    /// where the poses are not determined.
    pub fn solve(
        &mut self,
        members: &Members<'_>,
        views: &Views,
        damping: f64,
        step: &mut Step,
    ) -> bool {
        self.reduce(members, views, damping);
        step.depths.clear();
        step.depths.resize(self.points.len(), 0.0);
        let Elimination { reduced, right, .. } = &self.elimination;
        let Some(poses) = solve(reduced, right) else { return false };
        step.poses.clear();
        step.poses.extend(poses.iter());
        step.decrement = -dot(&self.right, &step.poses);
        if !members.depths_are_free {
            return true;
        }
        for ((change, part), view) in step.depths.iter_mut().zip(&self.points).zip(&views.points) {
            if !(part.hessian > 0.0) {
                continue;
            }
            let of = |pose: usize| &step.poses[POSE * pose..][..POSE];
            let mut along = members.free[view.host].map_or(0.0, |pose| dot(&part.host, of(pose)));
            for link in views.links(view) {
                if let Some(pose) = members.free[link.observer] {
                    along += dot(&self.mixed[link.place].map(f64::from), of(pose));
                }
            }
            *change = -(part.right + along) / (part.hessian * (1.0 + damping));
            step.decrement -= part.right * *change;
        }
        true
    }

    /// Eliminates the points from the equations of the poses, into `elimination`.
    fn reduce(&mut self, members: &Members<'_>, views: &Views, damping: f64) {
        let mut memory = std::mem::take(&mut self.elimination);
        memory.reduced.clone_from(&self.hessian);
        memory.right.clone_from(&self.right);
        for pose in 0..self.num_free {
            let diagonal = &mut memory.reduced[lower(pose, pose)];
            (0..POSE).for_each(|k| diagonal[k][k] *= 1.0 + damping);
        }
        let num_points = if members.depths_are_free { self.points.len() } else { 0 };
        let kernel = Kernel::choose(SimdMode::Auto);
        for first in (0..num_points).step_by(CHUNK) {
            let some = first..(first + CHUNK).min(num_points);
            self.collect(some, members, views, damping, &mut memory);
            let Elimination { points, rows, reduced, right } = &mut memory;
            eliminate(kernel, points, rows, reduced, right);
        }
        self.elimination = memory;
    }

    /// Standard deviation of the inverse depth of a point, by its index in the views, if all poses were exact; infinite
    /// where no keyframe sees it.
    pub fn depth_deviation(&self, slot: usize) -> f64 {
        (self.mean_squared_residual() / self.points[slot].hessian).sqrt()
    }

    /// Factors of the reduced equations of the poses, without damping but with a stiffness along `stiffened`; `None`
    /// where the poses are not determined.
    pub fn factors(
        &mut self,
        members: &Members<'_>,
        views: &Views,
        stiffened: Option<&DVector<f64>>,
    ) -> Option<Factors> {
        self.reduce(members, views, 0.0);
        Factors::of(&self.elimination.reduced, POSE * self.num_free, stiffened)
    }

    /// A vector whose dot product with that of another function of the same depths is gᵀ H⁻¹ g'; `factors` are those of
    /// this system.
    pub fn whitened(
        &self,
        factors: &Factors,
        members: &Members<'_>,
        views: &Views,
        of: &Functional,
    ) -> DVector<f64> {
        let mut poses = of.poses.clone();
        let mut depths = Vec::with_capacity(of.depths.len());
        for &(slot, by_depth) in &of.depths {
            let (part, view) = (&self.points[slot], &views.points[slot]);
            if !(part.hessian > 0.0) {
                depths.push(0.0);
                continue;
            }
            depths.push(by_depth / part.hessian.sqrt());
            let share = by_depth / part.hessian;
            let mut take = |pose: usize, mixed: &[f64]| {
                for (to, of) in poses.as_mut_slice()[POSE * pose..].iter_mut().zip(mixed) {
                    *to -= share * of;
                }
            };
            if let Some(pose) = members.free[view.host] {
                take(pose, &part.host);
            }
            for link in views.links(view) {
                if let Some(pose) = members.free[link.observer] {
                    take(pose, &self.mixed[link.place].map(f64::from)[..POSE]);
                }
            }
        }
        let poses = factors.whiten(poses);
        DVector::from_iterator(poses.len() + depths.len(), poses.iter().copied().chain(depths))
    }

    /// Mean over the inliers, grey levels².
    pub fn mean_squared_residual(&self) -> f64 {
        self.inlier_cost / (SAMPLES * self.inliers.max(1)) as f64
    }

    /// Number of inliers among the comparisons at these places.
    pub fn inliers_among(&self, places: std::ops::Range<usize>, most_energy: f32) -> usize {
        let costs = self.costs.get(places).unwrap_or_default();
        costs.iter().filter(|cost| **cost < most_energy).count()
    }

    /// Number of keyframes that agree with each point, in the order of the views.
    pub fn inliers_by_point(&self) -> impl Iterator<Item = u32> {
        self.points.iter().map(|part| part.inliers)
    }
}

impl PointPart {
    /// Adds a comparison, whose sums are all 0 unless it is an inlier.
    #[inline(always)]
    fn add(&mut self, seen: &Compared, lane: usize, wanted: &Wanted) {
        self.inliers += u32::from(seen.cost[lane] < f32::INFINITY);
        if !wanted.depths {
            return;
        }
        self.hessian += f64::from(seen.depth[lane]);
        self.right += f64::from(seen.depth_right[lane]);
        if wanted.host {
            for (to, of) in self.host.iter_mut().zip(&seen.host) {
                *to += f64::from(of[lane]);
            }
        }
    }
}

fn dot(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(a, b)| a * b).sum()
}
