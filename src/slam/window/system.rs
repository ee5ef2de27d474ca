//! The normal equations of a window and their reduction to the poses.
//!
//! With C_j = `camera_from_map` and an increment from the left, the derivative by the host's pose is that by the
//! observer's times −Ad(C_j C_i⁻¹). Points are independent given the poses, so that each is eliminated by itself:
//! `S = H − Σ h hᵀ/H_dd`.

use nalgebra::{DMatrix, DVector, Matrix6, Vector6};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::window::comparison_kernel::{
    POSE, Pair, PairSums, PointSums, Robustness, Seen, kernel, sum,
};
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::view::{PointView, Views};

/// The normal equations at one state. Its memory is kept from one to the next.
#[derive(Debug, Clone, Default)]
pub struct System {
    /// Of the free poses, in their order; row after row, both triangles.
    hessian: Vec<f64>,
    /// Right side.
    right: Vec<f64>,
    points: Vec<PointPart>,
    /// Σ w J ∂r/∂d of the observer, by comparison.
    mixed: Vec<[f32; POSE]>,
    /// Cost of each comparison; NaN where it was never inside the image.
    costs: Vec<f32>,
    /// Number of free poses.
    pub num_free: usize,
    /// Comparisons that count.
    pub inliers: usize,
    /// Comparisons that were made.
    pub compared: usize,
    /// Sum of the costs of those that count.
    pub inlier_cost: f64,
}

/// The part of the normal equations of one point.
#[derive(Debug, Clone, Copy, Default)]
struct PointPart {
    /// H_dd; 0 where nothing saw it.
    hessian: f64,
    /// Its right side.
    right: f64,
    /// Σ w J ∂r/∂d of its host.
    host: [f64; POSE],
    inliers: u32,
}

/// Increments of everything that is free.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Step {
    /// Left increments (translation, rotation) of the free poses.
    pub poses: Vec<f64>,
    /// By point.
    pub depths: Vec<f64>,
    /// By how much the linear model lowers the cost.
    pub decrement: f64,
}

/// What is adjusted: keyframes, of them those that take part, and of them those that are free.
#[derive(Debug, Clone, Copy)]
pub struct Members<'a> {
    /// Places in the list of keyframes.
    pub members: &'a [usize],
    /// For each its number among the free ones.
    pub free: &'a [Option<usize>],
    /// Whether depths are free too.
    pub depths_are_free: bool,
}

/// What stays the same for all systems of a level.
#[derive(Debug, Clone, Copy)]
pub struct Level<'a> {
    /// Camera of level 0.
    pub camera: &'a Intrinsics,
    /// The level.
    pub level: usize,
    /// How residuals count.
    pub robustness: Robustness,
}

/// The same of a pose's block as of the pair's lanes.
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

/// Transposed: a row vector of the observer's pose becomes one of the host's.
fn carried(by_host: &[[f32; POSE]; POSE], of: &[f32; POSE]) -> [f32; POSE] {
    let mut out = [0.0; POSE];
    for (row, value) in by_host.iter().zip(of) {
        for (to, entry) in out.iter_mut().zip(row) {
            *to += entry * value;
        }
    }
    out
}

impl System {
    /// Linearises at the state that `keyframes` are in and returns the cost, of which that of comparisons that were
    /// not inside the image `before` is left out, and of those that are not any more is what it was.
    pub fn linearise(
        &mut self,
        keyframes: &[WindowKeyframe],
        members: &Members<'_>,
        views: &Views,
        at: &Level<'_>,
        before: Option<&System>,
    ) -> f64 {
        let compare = kernel();
        let camera = at.camera.at_level(at.level);
        self.restart(members, views);
        let mut cost = 0.0;
        let mut pairs = Vec::with_capacity(members.members.len());
        for (host, host_views) in views.of_hosts() {
            let host_pose = keyframes[members.members[host]].camera_from_map.inverse();
            pairs.clear();
            pairs.extend(members.members.iter().map(|&observer| {
                let observer_from_host = keyframes[observer].camera_from_map * host_pose;
                let by_host = -observer_from_host.adjoint();
                let rows = std::array::from_fn(|r| std::array::from_fn(|c| by_host[(r, c)] as f32));
                (Pair::new(&observer_from_host, &camera), by_host, rows, PairSums::default())
            }));
            let points = &keyframes[members.members[host]].points;
            let host_is_free = members.free[host].is_some();
            for view in host_views {
                let point = &points[view.point];
                let (look, depth) = (&point.looks[at.level], point.inverse_depth as f32);
                let mut part = PointPart::default();
                for place in view.first..view.first + view.count {
                    let observer = views.observers[place];
                    let image = &keyframes[members.members[observer]].images[at.level];
                    let (pair, _, by_host, sums) = &mut pairs[observer];
                    let seen = match look.is_whole() {
                        true => compare(image, pair, look, point.ray, depth, &at.robustness, sums),
                        false => Seen::Outside,
                    };
                    let was = before.map(|system| system.costs[place]);
                    cost += f64::from(self.note(place, &seen, was, at));
                    if let Seen::Same(_, sums) = seen {
                        part.add(&sums, host_is_free.then_some(by_host));
                        self.mixed[place] = sums.mixed;
                    }
                }
                self.points.push(part);
            }
            self.add_pairs(host, members, &pairs);
        }
        cost
    }

    fn restart(&mut self, members: &Members<'_>, views: &Views) {
        let num_free = members.free.iter().flatten().count();
        let size = POSE * num_free;
        self.num_free = num_free;
        self.hessian.clear();
        self.hessian.resize(size * size, 0.0);
        self.right.clear();
        self.right.resize(size, 0.0);
        self.points.clear();
        self.mixed.clear();
        self.mixed.resize(views.observers.len(), [0.0; POSE]);
        self.costs.clear();
        self.costs.resize(views.observers.len(), f32::NAN);
        (self.inliers, self.compared, self.inlier_cost) = (0, 0, 0.0);
    }

    /// Keeps what a comparison costs and returns what of it can be compared with the state before.
    fn note(&mut self, place: usize, seen: &Seen, was: Option<f32>, at: &Level<'_>) -> f32 {
        let cost = match seen {
            Seen::Outside => was.unwrap_or(f32::NAN),
            Seen::Other => at.robustness.most_energy,
            Seen::Same(cost, _) => *cost,
        };
        self.costs[place] = cost;
        self.compared += usize::from(!matches!(seen, Seen::Outside));
        if let Seen::Same(cost, _) = seen {
            self.inliers += 1;
            self.inlier_cost += f64::from(*cost);
        }
        let is_new = was.is_some_and(f32::is_nan);
        if is_new || cost.is_nan() { 0.0 } else { cost }
    }

    #[allow(clippy::type_complexity, reason = "what a pair is made of")]
    fn add_pairs(
        &mut self,
        host: usize,
        members: &Members<'_>,
        pairs: &[(Pair, Matrix6<f64>, [[f32; POSE]; POSE], PairSums)],
    ) {
        for (observer, (_, by_host, _, lanes)) in pairs.iter().enumerate() {
            let (i, j) = (members.free[host], members.free[observer]);
            if observer == host || (i.is_none() && j.is_none()) {
                continue;
            }
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
                self.add_block(j, i, &between);
                self.add_block(i, j, &between.transpose());
            }
        }
    }

    fn add_block(&mut self, row: usize, column: usize, block: &Matrix6<f64>) {
        let size = POSE * self.num_free;
        for r in 0..POSE {
            for c in 0..POSE {
                self.hessian[(POSE * row + r) * size + POSE * column + c] += block[(r, c)];
            }
        }
    }

    fn add_right(&mut self, row: usize, of: &Vector6<f64>) {
        for r in 0..POSE {
            self.right[POSE * row + r] += of[r];
        }
    }

    /// The row of the poses that a point has to do with, and the first and last of its entries that are not 0.
    fn row_of(&self, host: Option<usize>, view: &PointView, part: &PointPart, to: &mut Row<'_>) {
        to.clear();
        if let Some(host) = host {
            to.add(host, &part.host);
        }
        for place in view.first..view.first + view.count {
            if let Some(free) = to.free[to.views.observers[place]] {
                to.add(free, &self.mixed[place].map(f64::from));
            }
        }
    }

    /// The increments of poses and inverse depths that a share `damping` added to each diagonal element gives; false
    /// where the poses are not determined.
    pub fn solve(
        &self,
        members: &Members<'_>,
        views: &Views,
        damping: f64,
        step: &mut Step,
    ) -> bool {
        let size = POSE * self.num_free;
        let mut reduced = self.hessian.clone();
        let mut right = self.right.clone();
        for k in 0..size {
            reduced[k * size + k] *= 1.0 + damping;
        }
        let mut row = Row::new(size, members.free, views);
        if members.depths_are_free {
            for (part, (host, view)) in self.points.iter().zip(views.with_hosts()) {
                if !(part.hessian > 0.0) {
                    continue;
                }
                self.row_of(members.free[host], view, part, &mut row);
                row.eliminate(
                    1.0 / (part.hessian * (1.0 + damping)),
                    part.right,
                    &mut reduced,
                    &mut right,
                );
            }
        }
        step.depths.clear();
        let Some(poses) = solve_scaled(&mut reduced, &right) else { return false };
        step.poses.clear();
        step.poses.extend(poses.iter());
        step.decrement = -dot(&self.right, &step.poses);
        for (part, (host, view)) in self.points.iter().zip(views.with_hosts()) {
            let mut change = 0.0;
            if members.depths_are_free && part.hessian > 0.0 {
                self.row_of(members.free[host], view, part, &mut row);
                let along = row.along(&step.poses);
                change = -(part.right + along) / (part.hessian * (1.0 + damping));
                step.decrement -= part.right * change;
            }
            step.depths.push(change);
        }
        true
    }

    /// Keyframes that agree with each point, in the order of the views.
    pub fn inliers_by_point(&self) -> impl Iterator<Item = u32> {
        self.points.iter().map(|part| part.inliers)
    }
}

impl PointPart {
    fn add(&mut self, sums: &PointSums, by_host: Option<&[[f32; POSE]; POSE]>) {
        self.hessian += f64::from(sums.depth);
        self.right += f64::from(sums.depth_right);
        self.inliers += 1;
        if let Some(by_host) = by_host {
            let carried = carried(by_host, &sums.mixed);
            self.host.iter_mut().zip(carried).for_each(|(to, of)| *to += f64::from(of));
        }
    }
}

/// A row of the poses, dense, with the blocks that are not 0.
struct Row<'a> {
    values: Vec<f64>,
    blocks: Vec<usize>,
    free: &'a [Option<usize>],
    views: &'a Views,
}

impl<'a> Row<'a> {
    fn new(size: usize, free: &'a [Option<usize>], views: &'a Views) -> Self {
        Self { values: vec![0.0; size], blocks: Vec::with_capacity(size / POSE), free, views }
    }

    fn clear(&mut self) {
        for &block in &self.blocks {
            self.values[POSE * block..][..POSE].fill(0.0);
        }
        self.blocks.clear();
    }

    /// Adds what belongs to a pose, each once.
    fn add(&mut self, free: usize, of: &[f64; POSE]) {
        self.values[POSE * free..][..POSE].copy_from_slice(of);
        self.blocks.push(free);
    }

    fn along(&self, poses: &[f64]) -> f64 {
        self.blocks
            .iter()
            .map(|&block| dot(&self.values[POSE * block..][..POSE], &poses[POSE * block..][..POSE]))
            .sum()
    }

    /// Takes a point of this row out of the lower triangle of the equations of the poses.
    fn eliminate(&self, inverse: f64, point_right: f64, reduced: &mut [f64], right: &mut [f64]) {
        let size = self.values.len();
        for &block in &self.blocks {
            for row in POSE * block..POSE * (block + 1) {
                let weighted = inverse * self.values[row];
                right[row] -= weighted * point_right;
                let end = POSE * (block + 1);
                let entries = reduced[row * size..][..end].iter_mut();
                for (entry, value) in entries.zip(&self.values[..end]) {
                    *entry -= weighted * value;
                }
            }
        }
    }
}

fn dot(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(a, b)| a * b).sum()
}

/// Solves `matrix · x = −right` of a lower triangle, after scaling to a unit diagonal; translations and rotations differ
/// by the depth.
fn solve_scaled(lower: &mut [f64], right: &[f64]) -> Option<DVector<f64>> {
    let size = right.len();
    if size == 0 {
        return Some(DVector::zeros(0));
    }
    /// Added to the unit diagonal: the gauge that nothing holds must not be singular.
    const REGULARISATION: f64 = 1e-9;
    let scale =
        DVector::from_fn(size, |k, _| 1.0 / lower[k * size + k].max(f64::MIN_POSITIVE).sqrt());
    let matrix = DMatrix::from_fn(size, size, |row, column| {
        let (row, column) = (row.max(column), row.min(column));
        let regular = if row == column { REGULARISATION } else { 0.0 };
        lower[row * size + column] * scale[row] * scale[column] + regular
    });
    let right = DVector::from_fn(size, |k, _| right[k] * scale[k]);
    let step = -matrix.cholesky()?.solve(&right).component_mul(&scale);
    step.iter().all(|x| x.is_finite()).then_some(step)
}
