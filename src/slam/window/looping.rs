//! Where the search for loops meets the window: what it is told, when it is its turn, and what moves with the map.

use crate::slam::geometry::sim3::Sim3;
use crate::slam::loops::{Closure, LoopParams, Loops};
use crate::slam::map::Map;
use crate::slam::window::Window;
use crate::slam::window::members::{Chosen, FEWEST_COMMON};

/// Keyframes whose depth is not complete: the one that is observed, and the one before it, which gets its last depth.
const UNFINISHED: usize = 2;

impl Window {
    /// The same, looking for loops.
    pub fn with_loops(mut self, params: LoopParams) -> Self {
        self.loops = Loops::new(self.camera, params);
        self
    }

    /// Whether a keyframe that has settled is to be looked for in older ones, by [`Window::optimise`]: to be asked where
    /// nothing else is to be estimated. Of a map that is complete, with `is_last`, all have settled.
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

    /// Does a search that was begun; false where none was.
    pub(super) fn search_begun(&mut self) -> bool {
        let is_done = self.loops.run();
        if is_done {
            self.plan_search(self.num_unsettled());
        }
        is_done
    }

    /// Tells of an estimate of the newest keyframes, right after it: who held the newest one.
    pub(super) fn tell_estimate(&mut self, chosen: &Chosen) {
        let Some((&newest, others)) = chosen.members.split_last() else { return };
        let agreeing = self.agreeing_with_last(chosen);
        let of = |member: &usize| self.keyframes[*member].keyframe_id;
        // Those that stand in front of it behind a wall hold nothing.
        let holds = others.iter().zip(&agreeing).filter(|(_, count)| **count >= FEWEST_COMMON);
        let all: Vec<u64> = holds.map(|(member, _)| of(member)).collect();
        let fixed = others.iter().zip(&chosen.free).filter(|(_, free)| free.is_none());
        let held = fixed.map(|(member, _)| of(member)).filter(|id| all.contains(id));
        let held: Vec<u64> = held.collect();
        let newest = of(&newest);
        self.loops.note_estimate(newest, &all, &held);
    }

    /// By member how many comparisons with the last one count.
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

    pub(super) fn num_unsettled(&self) -> usize {
        self.params.num_free.max(1)
    }

    /// Chooses what is searched next, the newest keyframes left out.
    pub(super) fn plan_search(&mut self, num_unsettled: usize) {
        let known: Vec<u64> = self.keyframes.iter().map(|of| of.keyframe_id).collect();
        // What lies in another epoch need not wait until it knows its place in its own: only its depth must be there.
        let is_one_epoch = self.keyframes.windows(2).all(|pair| pair[0].epoch == pair[1].epoch);
        let num_unsettled =
            if is_one_epoch { num_unsettled } else { num_unsettled.min(UNFINISHED) };
        self.loops.plan(&known, known.len().saturating_sub(num_unsettled));
    }

    /// The map was moved: points move with their hosts, and what the loop joins is to be estimated together.
    pub fn follow(&mut self, closure: &Closure) {
        for keyframe in &mut self.keyframes {
            let Some(by) = closure.of(keyframe.keyframe_id, keyframe.epoch) else { continue };
            let place = *by * Sim3::new(keyframe.camera_from_map.inverse(), keyframe.unit);
            keyframe.camera_from_map = place.rigid.inverse();
            keyframe.unit = place.scale;
            keyframe.points.iter_mut().for_each(|point| point.inverse_depth /= by.scale);
        }
        self.pass.call();
    }
}
