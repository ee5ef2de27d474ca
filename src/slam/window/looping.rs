//! The window's side of the search for loops: reports estimates, schedules the search and follows closures.

use crate::slam::geometry::sim3::Sim3;
use crate::slam::loops::{Closure, LoopParams, Loops};
use crate::slam::map::{Correction, Map};
use crate::slam::window::Window;
use crate::slam::window::members::{Chosen, MIN_COMMON};

/// Keyframes whose depth is incomplete: the one being observed, and the previous one, whose final depth is pending.
const UNFINISHED: usize = 2;

impl Window {
    /// The same window, with a search for loops.
    pub fn with_loops(mut self, params: LoopParams) -> Self {
        self.loops = Loops::new(self.camera, params);
        self
    }

    /// Begins the search for a settled keyframe in older ones, by [`Window::optimise`]; false where there is none. Call
    /// it when there is nothing else to estimate. In a complete map, with `is_last`, all keyframes have settled.
    pub fn begin_search(&mut self, map: &Map, is_last: bool) -> bool {
        if is_last {
            self.plan_search(0);
        }
        if !self.loops.begin(map) {
            return false;
        }
        self.moved.clear();
        self.marginals.clear();
        true
    }

    /// Runs a search that was begun; false where none was.
    pub(super) fn run_search(&mut self) -> bool {
        let is_done = self.loops.run();
        if is_done {
            self.plan_search(self.num_unsettled());
        }
        is_done
    }

    /// Reports an estimate of the newest keyframes, right after it: which keyframes held the newest one.
    pub(super) fn report_estimate(&mut self, chosen: &Chosen) {
        let Some((&newest, others)) = chosen.members.split_last() else { return };
        let agreeing = self.agreeing_with_last(chosen);
        let of = |member: &usize| self.keyframes[*member].keyframe_id;
        // Those in its view but behind a wall hold nothing.
        let holds = others.iter().zip(&agreeing).filter(|(_, count)| **count >= MIN_COMMON);
        let all: Vec<u64> = holds.map(|(member, _)| of(member)).collect();
        let fixed = others.iter().zip(&chosen.free).filter(|(_, free)| free.is_none());
        let held = fixed.map(|(member, _)| of(member)).filter(|id| all.contains(id));
        let held: Vec<u64> = held.collect();
        let newest = of(&newest);
        self.loops.note_estimate(newest, &all, &held);
    }

    /// For each member, the number of inliers among its comparisons with the last one.
    fn agreeing_with_last(&self, chosen: &Chosen) -> Vec<usize> {
        let last = chosen.members.len() - 1;
        let most_energy = self.robustness().most_energy;
        let mut counts = vec![0; chosen.members.len()];
        for pair in &self.solver.views.pairs {
            let other = match (pair.host == last, pair.observer == last) {
                (true, false) => pair.observer,
                (false, true) => pair.host,
                _ => continue,
            };
            counts[other] += self.solver.system.inliers_among(pair.places(), most_energy);
        }
        counts
    }

    /// Records for the search the covariances of a correction that the map contains.
    pub fn record_covariances(&mut self, correction: &Correction) {
        for of in &correction.keyframes {
            let Some(relative) = &of.relative_place else { continue };
            self.loops.note_covariance(of.keyframe_id, &of.map_from_keyframe, relative);
        }
    }

    pub(super) fn num_unsettled(&self) -> usize {
        self.params.num_free.max(1)
    }

    /// Plans the next searches, the newest keyframes left out.
    pub(super) fn plan_search(&mut self, num_unsettled: usize) {
        let known: Vec<u64> = self.keyframes.iter().map(|of| of.keyframe_id).collect();
        // Keyframes of another epoch need not wait for their pose there to settle: only their depth must be complete.
        let is_one_epoch = self.keyframes.windows(2).all(|pair| pair[0].epoch == pair[1].epoch);
        let num_unsettled =
            if is_one_epoch { num_unsettled } else { num_unsettled.min(UNFINISHED) };
        self.loops.plan(&known, known.len().saturating_sub(num_unsettled));
    }

    /// Follows a closure: points move with their hosts, and a pass is due to estimate what the loop joins.
    pub fn apply_closure(&mut self, closure: &Closure) {
        for keyframe in &mut self.keyframes {
            let Some(by) = closure.of(keyframe.keyframe_id, keyframe.epoch) else { continue };
            let place = *by * Sim3::new(keyframe.camera_from_map.inverse(), keyframe.unit);
            keyframe.camera_from_map = place.rigid.inverse();
            keyframe.unit = place.scale;
            keyframe.points.iter_mut().for_each(|point| point.inverse_depth /= by.scale);
        }
        self.pass.request();
    }
}
