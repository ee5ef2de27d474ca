//! Joint estimation of the poses of a few keyframes and the inverse depths of their points: photometric bundle
//! adjustment (Engel, Koltun, Cremers 2018 §2; Zubizarreta, Aguinaga, Montiel 2020).
//!
//! A point belongs to the keyframe that it was chosen in, its host, and is compared with every keyframe that sees it.
//! [`comparison`] is one such comparison with its derivatives, `system` the normal equations of all with the points
//! eliminated, `solver` the iterations, [`Window::optimise`] the recipe. Keyframes that have left the window and see
//! the same points hold it in place; nothing is marginalised, and the filter's variance is no prior.

mod agreement;
pub(crate) mod candidates;
pub mod comparison;
mod comparison_kernel;
mod conclusion;
pub(crate) mod confirmed;
pub(crate) mod dense;
mod elimination_kernel;
mod factors;
mod feedback;
pub mod frames;
pub(crate) mod functional;
mod holders;
pub(crate) mod keyframe;
mod looping;
pub(crate) mod marginals;
mod members;
mod neighbours;
pub mod params;
mod pass;
pub(crate) mod place_marginals;
mod plane;
mod realignment;
mod rival;
mod selection;
pub(crate) mod sighting;
mod solver;
mod surface;
mod system;
mod unit;
mod view;

use std::sync::Arc;

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::shared::SharedImage;
use crate::slam::keyframe::Keyframe;
use crate::slam::loops::{LoopParams, Loops};
use crate::slam::map::Map;
use crate::slam::window::candidates::{Candidates, MaturePoints};
use crate::slam::window::comparison::{Robustness, SAMPLES};
use crate::slam::window::dense::Refinement;
use crate::slam::window::frames::WindowFrames;
use crate::slam::window::keyframe::{WindowKeyframe, WindowPoint, num_levels};
use crate::slam::window::marginals::Marginal;
use crate::slam::window::members::Chosen;
use crate::slam::window::params::WindowParams;
use crate::slam::window::pass::Pass;
use crate::slam::window::solver::Solver;
use crate::slam::window::surface::Surface;
use crate::slam::window::system::{Level, Members};
use crate::slam::window::unit::Unit;

/// Levels of the alignment of a single image, which may be ten pixels off, and of an adjustment.
const ALIGNMENT_LEVELS: [usize; 4] = [3, 2, 1, 0];
const ADJUSTED_LEVELS: [usize; 3] = [2, 1, 0];
/// Most iterations of a level of that alignment.
const MAX_ALIGNMENT_ITERATIONS: u32 = 10;

/// The result of an adjustment.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Adjustment {
    /// Newest keyframe that took part.
    pub keyframe_id: u64,
    /// Keyframes whose poses were free.
    pub free: usize,
    /// Keyframes that held them in place.
    pub fixed: usize,
    /// Points that some keyframe agrees with.
    pub points: usize,
    /// Comparisons of a point with a keyframe, at the finest level.
    pub comparisons: usize,
    /// Share of them that are inliers.
    pub inlier_ratio: f64,
    /// Root mean square of the residuals of inliers, grey levels.
    pub rms_grey: f64,
    /// Steps tried, of all levels.
    pub iterations: u32,
}

/// Keyframes and points that are estimated jointly. The window keeps its own copy of all it needs but the images, which
/// never change, so that it can work during mapping; only [`Window::update_from_map`] and [`Window::correction`] meet
/// the map.
#[derive(Debug, Clone)]
pub struct Window {
    params: WindowParams,
    camera: Intrinsics,
    /// In the order of their creation.
    keyframes: Vec<WindowKeyframe>,
    /// Keyframes whose points are still to be chosen.
    candidates: Vec<Candidates>,
    /// Mature points of keyframes that are still to be taken in.
    mature: Vec<MaturePoints>,
    /// Keyframes that have not been aligned yet.
    unaligned: Vec<u64>,
    solver: Solver,
    /// Keyframes moved by the last estimate, in the order of their ids.
    moved: Vec<u64>,
    /// Their marginal covariances.
    marginals: Vec<Marginal>,
    frames: WindowFrames,
    /// Whether no more frames follow: the next estimate is of all keyframes and of all frames that wait.
    pub(super) is_last: bool,
    /// Whether the map contradicts itself: the next estimate is of the newest keyframes, all of them free.
    pub(super) reconsiders: bool,
    pass: Pass,
    refinement: Refinement,
    /// The search for loops; callers use it directly.
    pub(crate) loops: Loops,
    /// The epoch whose start the last estimate has refuted.
    pub(super) refuted_epoch: Option<u32>,
    /// The epoch whose start was found to be right.
    confirmed_epoch: Option<u32>,
}

impl Window {
    /// Creates an empty window for images of `camera`.
    pub fn new(camera: Intrinsics, params: WindowParams) -> Self {
        Self {
            params,
            camera,
            keyframes: Vec::new(),
            candidates: Vec::new(),
            mature: Vec::new(),
            unaligned: Vec::new(),
            solver: Solver::default(),
            moved: Vec::new(),
            marginals: Vec::new(),
            frames: WindowFrames::default(),
            is_last: false,
            reconsiders: false,
            pass: Pass::default(),
            refinement: Refinement::default(),
            loops: Loops::new(camera, LoopParams::default()),
            refuted_epoch: None,
            confirmed_epoch: None,
        }
    }

    /// Updates the window from the map, whose keyframe `active` is still being observed. False where there is nothing
    /// new to estimate.
    pub fn update_from_map(&mut self, map: &Map, active: u64) -> bool {
        self.moved.clear();
        self.marginals.clear();
        self.refuted_epoch = None;
        self.pass.finish_piece();
        // Keyframes left by a mapper that died are where they were estimated to be.
        let is_resumed = self.keyframes.is_empty() && map.keyframes.len() > 1;
        let held: Vec<&Keyframe> = map.keyframes.iter().filter(|of| of.is_usable()).collect();
        let mut ids: Vec<u64> = held.iter().map(|keyframe| keyframe.keyframe_id).collect();
        ids.sort_unstable();
        let is_known = |id: u64| ids.binary_search(&id).is_ok();
        self.keyframes.retain(|keyframe| is_known(keyframe.keyframe_id));
        self.unaligned.retain(|id| is_known(*id));
        self.candidates.retain(|of| is_known(of.keyframe_id));
        for keyframe in held {
            let id = keyframe.keyframe_id;
            let mut is_host = false;
            match self.index_of(id) {
                Some(place) => is_host = self.update(place, keyframe),
                None if !self.add(keyframe) => continue,
                None if !is_resumed || id == active => self.unaligned.push(id),
                None => {}
            }
            if id != active && !is_host && !self.candidates.iter().any(|of| of.keyframe_id == id) {
                let (depth, mature) = (keyframe.points.clone(), self.mature_of(id));
                self.candidates.push(Candidates { keyframe_id: id, depth, mature });
            }
        }
        self.mature.clear();
        !self.unaligned.is_empty()
    }

    /// Updates a keyframe from the map; returns whether its points are chosen.
    fn update(&mut self, place: usize, from: &Keyframe) -> bool {
        let known = &mut self.keyframes[place];
        known.camera_from_map = from.map_from_keyframe.rigid.inverse();
        known.unit = from.map_from_keyframe.scale;
        if known.epoch != from.epoch {
            // Its epoch was joined to another, which has another unit: its points are chosen anew.
            known.epoch = from.epoch;
            known.points.clear();
            known.is_host = false;
        }
        known.is_host
    }

    /// Adds a keyframe; false where its image is not of the camera's size.
    fn add(&mut self, keyframe: &Keyframe) -> bool {
        let Some(image) = self.image_of(Arc::clone(&keyframe.image)) else { return false };
        let (id, Sim3 { rigid, scale }) = (keyframe.keyframe_id, keyframe.map_from_keyframe);
        let mut added = WindowKeyframe::new(id, keyframe.epoch, image, rigid.inverse(), scale);
        added.surface = Surface::of(&keyframe.points, &self.camera);
        let place = self.keyframes.partition_point(|of| of.keyframe_id < id);
        self.keyframes.insert(place, added);
        true
    }

    /// An image of these pixels; `None` where it is not of the camera's size.
    fn image_of(&self, pixels: Arc<[u8]>) -> Option<SharedImage> {
        SharedImage::try_from_pixels(self.camera.width, self.camera.height, pixels)
    }

    /// Appends a camera that is not a keyframe for the duration of a query, in the unit of a keyframe; `None` where its
    /// image is not of the camera's size.
    fn push_camera(
        &mut self,
        epoch: u32,
        pixels: Arc<[u8]>,
        camera_from_map: SE3,
        unit: f64,
    ) -> Option<()> {
        let image = self.image_of(pixels)?;
        self.keyframes.push(WindowKeyframe::new(u64::MAX, epoch, image, camera_from_map, unit));
        Some(())
    }

    fn get(&self, keyframe_id: u64) -> Option<&WindowKeyframe> {
        self.keyframes.get(self.index_of(keyframe_id)?)
    }

    /// A keyframe's index in the list, which is in the order of creation.
    fn index_of(&self, keyframe_id: u64) -> Option<usize> {
        self.keyframes.binary_search_by_key(&keyframe_id, |of| of.keyframe_id).ok()
    }

    /// Runs the task that was begun, or else estimates the newest keyframes and points; `None` without an estimate.
    pub fn optimise(&mut self) -> Option<Adjustment> {
        if self.run_refinement() || self.run_search() || self.realign_planned_frames() {
            return None;
        }
        let mut is_new = false;
        for id in std::mem::take(&mut self.unaligned) {
            let Some(index) = self.index_of(id) else { continue };
            self.choose_points_before(index);
            self.align(index);
            self.pass.added += 1;
            is_new = true;
        }
        let newest = self.keyframes.len().checked_sub(1)?;
        let mut adjustment = None;
        if is_new {
            let chosen = self.choose_members(newest);
            adjustment = self.adjust(&chosen);
            if adjustment.is_some() {
                self.report_estimate(&chosen);
            }
            if adjustment.is_some() && self.is_refuted(&chosen) {
                self.refuted_epoch = Some(self.keyframes[newest].epoch);
            }
            self.plan_search(self.num_unsettled());
            if self.refuted_epoch.is_none() {
                self.plan_frames(newest, chosen.is_first);
            }
            self.free_unused_images(&chosen.members);
        }
        if std::mem::take(&mut self.is_last) {
            adjustment = self.adjust_all(newest).or(adjustment);
            self.realign_rest();
            self.free_unused_images(&[]);
            self.refinement.begin(&self.keyframes);
        } else if std::mem::take(&mut self.reconsiders) {
            adjustment = self.adjust_newest(newest).or(adjustment);
        } else if !is_new {
            adjustment = self.adjust_piece(newest);
        }
        adjustment
    }

    /// Frees the images of keyframes that no longer take part.
    fn free_unused_images(&mut self, members: &[usize]) {
        for (index, keyframe) in self.keyframes.iter_mut().enumerate() {
            if !members.contains(&index) {
                keyframe.drop_pyramid();
            }
        }
    }

    /// Chooses points in the keyframes before one, whose depth is final for now.
    fn choose_points_before(&mut self, index: usize) {
        let newest = self.keyframes[index].keyframe_id;
        let ready = self.candidates.extract_if(.., |of| of.keyframe_id < newest);
        for candidates in ready.collect::<Vec<_>>() {
            let Some(host) = self.index_of(candidates.keyframe_id) else { continue };
            self.make_host(host, &candidates);
        }
    }

    fn make_host(&mut self, host: usize, candidates: &Candidates) {
        // The candidates were traced with poses on the keyframe's depth: the plane applies to both.
        let plane = plane::fit(&self.projected_correspondences(host, &candidates.depth))
            .unwrap_or_default();
        let params = &self.params;
        let keyframe = &mut self.keyframes[host];
        keyframe.build_pyramid(&self.camera);
        let chosen = candidates.choose(keyframe.images[0].pixels(), &self.camera, params);
        keyframe.points = chosen
            .iter()
            .map(|point| {
                let mut of = WindowPoint::new(
                    (point.u, point.v),
                    f64::from(point.inverse_depth) / keyframe.unit,
                    &keyframe.images,
                    &self.camera,
                    params,
                );
                let [x, y] = of.ray.map(f64::from);
                of.inverse_depth *= (plane[0] + plane[1] * x + plane[2] * y).exp();
                of
            })
            .collect();
        (keyframe.is_host, keyframe.agreed) = (true, Vec::new());
    }

    /// Aligns a single keyframe to the points of those that see the same scene.
    fn align(&mut self, index: usize) {
        let mut members = self.hosts_to_align_to(index);
        if members.is_empty() {
            return;
        }
        members.push(index);
        if self.align_last(&members, &ALIGNMENT_LEVELS, MAX_ALIGNMENT_ITERATIONS) {
            self.note_agreement(&members);
        }
    }

    /// Aligns only the last of the members to the points of the others; false where its pose is not determined.
    fn align_last(&mut self, members: &[usize], levels: &[usize], iterations: u32) -> bool {
        let last = members.len() - 1;
        let free: Vec<_> = (0..members.len()).map(|k| (k == last).then_some(0)).collect();
        let members = Members { members, free: &free, depths_are_free: false };
        self.run(&members, levels, iterations, |_, observer| observer == last)
    }

    fn adjust(&mut self, chosen: &Chosen) -> Option<Adjustment> {
        let iterations = match chosen.is_first {
            true => self.params.max_first_iterations,
            false => self.params.max_iterations,
        };
        self.adjust_within(chosen, iterations)
    }

    /// The same with at most `iterations` per level.
    fn adjust_within(&mut self, chosen: &Chosen, iterations: u32) -> Option<Adjustment> {
        let num_free = chosen.free.iter().flatten().count();
        if num_free == 0 {
            return None;
        }
        let members =
            Members { members: &chosen.members, free: &chosen.free, depths_are_free: true };
        self.thin_out(&chosen.members);
        self.solver.iterations = 0;
        let unit = Unit::of(&self.keyframes, &members);
        if !self.run(&members, &ADJUSTED_LEVELS, iterations, |_, _| true) {
            return None;
        }
        self.note_agreement(&chosen.members);
        let most = self.robustness().most_energy;
        let mut found =
            marginals::marginals(&self.keyframes, &members, &mut self.solver, &self.camera, most);
        // Places are in the unit of the equations; modes are without a unit.
        let restored = unit.and_then(|unit| unit.restore(&mut self.keyframes, members.members));
        if let Some(by) = restored {
            let places = found.iter_mut().filter_map(|of| of.place.as_mut());
            places.for_each(|place| place.transport(&by));
        }
        let free = members.members.iter().zip(members.free).filter(|(_, free)| free.is_some());
        let moved: Vec<u64> = free.map(|(&index, _)| self.keyframes[index].keyframe_id).collect();
        self.marginals.retain(|known| !moved.contains(&known.keyframe_id));
        self.marginals.extend(found);
        self.moved.extend(moved);
        self.moved.sort_unstable();
        self.moved.dedup();
        let points = self.confirm(&members);
        let system = &self.solver.system;
        Some(Adjustment {
            keyframe_id: self.keyframes[*chosen.members.last()?].keyframe_id,
            free: num_free,
            fixed: members.members.len() - num_free,
            points,
            comparisons: system.compared,
            inlier_ratio: system.inliers as f64 / system.compared.max(1) as f64,
            rms_grey: system.mean_squared_residual().sqrt(),
            iterations: self.solver.iterations,
        })
    }

    /// Drops points of hosts beyond what can be estimated together: as many in all as the first keyframes have.
    fn thin_out(&mut self, members: &[usize]) {
        let WindowParams { points, max_points, num_first, .. } = self.params;
        let hosts = members.iter().filter(|&&member| self.keyframes[member].is_host).count();
        let each = points * num_first / hosts.max(1);
        for &member in members {
            let kept = &mut self.keyframes[member].points;
            kept.truncate(each.clamp(points, max_points.max(points)));
            kept.shrink_to_fit();
        }
    }

    fn robustness(&self) -> Robustness {
        Robustness {
            huber_grey: self.params.huber_grey,
            most_energy: SAMPLES as f32 * self.params.truncation_grey.powi(2),
        }
    }

    /// Adjusts the free parameters, level by level; false where one is not determined.
    fn run(
        &mut self,
        members: &Members<'_>,
        levels: &[usize],
        iterations: u32,
        mut may: impl FnMut(usize, usize) -> bool,
    ) -> bool {
        for &index in members.members {
            self.keyframes[index].build_pyramid(&self.camera);
        }
        let robustness = self.robustness();
        let finest = num_levels(&self.camera) - 1;
        levels.iter().filter(|&&level| level <= finest).all(|&level| {
            let at = Level { camera: &self.camera, level, robustness };
            let views = &mut self.solver.views;
            views.find(&self.keyframes, members.members, &self.camera, &mut may);
            views.sample_patterns(&self.keyframes, members.members, level);
            let converged = self.params.converged_decrement;
            self.solver.adjust(&mut self.keyframes, members, &at, iterations, converged)
        })
    }

    /// Counts the keyframes that agree with each point and drops points without any; returns the number of the others.
    fn confirm(&mut self, members: &Members<'_>) -> usize {
        let mut points = 0;
        let views = &self.solver.views;
        for (view, inliers) in views.points.iter().zip(self.solver.system.inliers_by_point()) {
            if views.links(view).is_empty() {
                continue;
            }
            let point = &mut self.keyframes[members.members[view.host]].points[view.point];
            point.confirmations = inliers;
            point.is_alive = inliers > 0;
            points += usize::from(point.is_alive);
        }
        points
    }
}

#[cfg(test)]
mod comparison_tests;
#[cfg(test)]
mod dense_tests;
#[cfg(test)]
mod marginal_tests;
#[cfg(test)]
mod pass_tests;
#[cfg(test)]
mod tests;
