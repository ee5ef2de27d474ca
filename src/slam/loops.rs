//! Loops: a keyframe revisits a place with which it was not estimated, and the map is moved so that both agree (Engel,
//! Schöps, Cremers 2014, §3.5–3.6).
//!
//! [`Loops::plan`] chooses the keyframes to compare by their appearance (`likeness`); [`Loops::run`] is the recipe:
//! pairs are measured in both directions (`graph::constraint`), one that the drift of the chain allows (`chain`) is
//! confirmed by a second, independent pair (`search`), and then the pose graph of the epoch is solved (`closure`). It
//! is slow and runs in the background on copies; [`Loops::begin`] and [`Loops::take_closure`] access the map.

mod chain;
mod closure;
mod likeness;
pub(crate) mod record;
mod search;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::graph::constraint::Refusal;
use crate::slam::keyframe::Keyframe;
use crate::slam::loops::likeness::AppearanceIndex;
use crate::slam::map::Map;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::places::PlaceCandidate;

pub use closure::Closure;
pub use record::{Link, LoopRecord};

/// Tuning of the search for loops.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LoopParams {
    /// Number of most similar keyframes that a settled one is compared with; 0 disables the search for loops.
    pub num_candidates: usize,
    /// Fewest features in the same arrangement for two keyframes to be compared.
    pub min_features: f32,
    /// Factor on the variance of a keyframe's pose relative to those it was estimated with: effects outside the
    /// window's model add up along a chain.
    pub drift_inflation: f64,
}

impl Default for LoopParams {
    fn default() -> Self {
        Self { num_candidates: 3, min_features: 20.0, drift_inflation: 4.0 }
    }
}

impl LoopParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("num_candidates", self.num_candidates, 0..=50)?;
        check_range("min_features", self.min_features, 1.0..=1000.0)?;
        check_range("drift_inflation", self.drift_inflation, 0.01..=1e4)
    }
}

/// The outcome of a search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SearchOutcome {
    /// No candidate is the same place; the reason for the first one.
    Refused(Refusal),
    /// A candidate is plausible and is to be confirmed.
    Proposed,
    /// A candidate would be the same place, but is further off than the map can have drifted: χ²₇ of that.
    AgainstDrift(f64),
    /// No second pair confirms it.
    Unconfirmed,
    /// Together with the earlier loops it contradicts the map.
    Inconsistent,
    /// The map already agrees with it: it is kept as a constraint.
    AlreadyConsistent,
    /// The map is corrected.
    Closed,
    /// Two epochs are joined.
    Joined,
}

/// Report of a finished search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchReport {
    /// The keyframe that was searched.
    pub keyframe_id: u64,
    /// The candidate that was to be confirmed, or else the most similar one.
    pub other: Option<u64>,
    /// Features that the most similar candidate shows in the same arrangement.
    pub likeness: f32,
    /// Pairs that were measured.
    pub compared: u32,
    /// Its outcome.
    pub outcome: SearchOutcome,
    /// The last pair whose measurement was accepted: ids of i and j, with `j_from_i`.
    pub measured: Option<(u64, u64, Sim3)>,
}

/// Two keyframes to be compared, with the initial similarity.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pair {
    i: u64,
    j: u64,
    /// In a search only its rotation counts.
    j_from_i: Sim3,
}

/// The next thing to do.
#[derive(Debug, Clone)]
enum Stage {
    /// Measure pairs without an initial pose.
    Search,
    /// Measure pairs that could confirm a loop.
    Confirm(Box<Link>),
    /// A correction was not applied: solve the graph again.
    Close { num_newest: usize },
}

#[derive(Debug, Clone)]
struct Plan {
    of: u64,
    stage: Stage,
    pairs: Vec<Pair>,
    /// Features shared with the most similar candidate.
    likeness: f32,
}

/// A plan with copies of the keyframes it needs.
#[derive(Debug, Clone)]
struct Job {
    plan: Plan,
    /// In order of their ids.
    keyframes: Vec<Keyframe>,
    /// All keyframes of the map without their depth, in order of their ids.
    nodes: Vec<Keyframe>,
    /// For each of them, whether it can be compared with others.
    is_usable: Vec<bool>,
}

impl Job {
    fn keyframe(&self, id: u64) -> Option<&Keyframe> {
        find(&self.keyframes, id)
    }

    fn node(&self, id: u64) -> Option<&Keyframe> {
        find(&self.nodes, id)
    }
}

/// The keyframe with an id, in a list ordered by id.
fn find(keyframes: &[Keyframe], id: u64) -> Option<&Keyframe> {
    let place = keyframes.binary_search_by_key(&id, |keyframe| keyframe.keyframe_id).ok()?;
    keyframes.get(place)
}

/// The search for loops and its results.
#[derive(Debug, Clone)]
pub struct Loops {
    params: LoopParams,
    intrinsics: Intrinsics,
    likeness: AppearanceIndex,
    /// By keyframe: those that it was estimated with, older and newer.
    partners: BTreeMap<u64, BTreeSet<u64>>,
    /// First keyframes of epochs, including joined ones: those on either side have different views.
    epoch_starts: BTreeSet<u64>,
    /// Shared with the map that stores it.
    record: Arc<LoopRecord>,
    plan: Option<Plan>,
    job: Option<Box<Job>>,
    closure: Option<Closure>,
    report: Option<SearchReport>,
    /// Of the search in progress: see the report.
    measured: Option<(u64, u64, Sim3)>,
    /// The keyframe searched last, if none of its candidates shows its place.
    fruitless: Option<u64>,
}

impl Loops {
    /// Without any loops yet, for keyframes of `intrinsics`.
    pub fn new(intrinsics: Intrinsics, params: LoopParams) -> Self {
        Self {
            params,
            intrinsics,
            likeness: AppearanceIndex::default(),
            partners: BTreeMap::new(),
            epoch_starts: BTreeSet::new(),
            record: Arc::default(),
            plan: None,
            job: None,
            closure: None,
            report: None,
            measured: None,
            fruitless: None,
        }
    }

    /// Whether loops are searched for.
    pub fn is_on(&self) -> bool {
        self.params.num_candidates > 0
    }

    /// Takes the descriptions of the keyframes of a map, in order of their ids, that are new since the last call.
    pub fn offer(&mut self, keyframes: &[Keyframe]) {
        if self.is_on() {
            let new = self.likeness.offer(keyframes);
            let pairs = keyframes[new.saturating_sub(1)..].windows(2);
            let starts = pairs.filter(|pair| pair[0].epoch != pair[1].epoch);
            self.epoch_starts.extend(starts.map(|pair| pair[1].keyframe_id));
        }
    }

    /// Records that a keyframe was estimated with others, all free except those in `held`.
    pub fn note_estimate(&mut self, newest: u64, others: &[u64], held: &[u64]) {
        /// Preceding keyframes that its pose counts as estimated against, in addition to those held.
        const NUM_BEFORE: usize = 2;
        if !self.is_on() {
            return;
        }
        for &other in others {
            self.partners.entry(newest).or_default().insert(other);
            self.partners.entry(other).or_default().insert(newest);
            // The free ones are estimated against all that are held.
            if !held.contains(&other) {
                for &of in held {
                    self.partners.entry(other).or_default().insert(of);
                    self.partners.entry(of).or_default().insert(other);
                }
            }
        }
        let before = others.iter().rev().filter(|other| !held.contains(other)).take(NUM_BEFORE);
        let against: Vec<u64> = held.iter().chain(before).copied().collect();
        Arc::make_mut(&mut self.record).held_by.insert(newest, against);
    }

    /// Continues from the loops that an earlier mapper stored for these keyframes. Those already searched, and those
    /// without a record of what they were estimated with, can be found but are not searched.
    pub fn resume_from(&mut self, known: Arc<LoopRecord>, keyframes: &[Keyframe]) {
        self.partners = known.partners();
        self.record = known;
        let last = self.record.last_searched(keyframes);
        if self.record.searched_to != last {
            Arc::make_mut(&mut self.record).searched_to = last;
        }
    }

    /// The loops found so far, to be stored with the map.
    pub fn record(&self) -> &Arc<LoopRecord> {
        &self.record
    }

    /// Plans the next step. `known` are the keyframes with image and depth, in order of their ids; those from
    /// `num_settled` on may still move.
    pub fn plan(&mut self, known: &[u64], num_settled: usize) {
        /// Keyframes after a fruitless one that have the same view, and are not searched.
        const PAUSE: usize = 2;
        if self.plan.is_some() || !self.is_on() {
            return;
        }
        self.likeness.enter(known);
        self.record.searched_to.into_iter().for_each(|to| self.likeness.forget(to));
        for (place, &of) in known.iter().enumerate().take(num_settled) {
            if self.record.searched_to.is_some_and(|to| of <= to) {
                continue;
            }
            let is_after = |id| known[place.saturating_sub(PAUSE)..place].contains(&id);
            let pairs = match self.fruitless.is_some_and(is_after) {
                true => Vec::new(),
                false => self.candidates(known, place),
            };
            if let Some((_, likeness)) = pairs.first().copied() {
                let pairs = pairs.into_iter().map(|(pair, _)| pair).collect();
                self.plan = Some(Plan { of, stage: Stage::Search, pairs, likeness });
                return;
            }
            self.mark_searched(of);
        }
    }

    /// Keyframes similar to one that were estimated neither with it nor with those around it.
    fn candidates(&self, known: &[u64], place: usize) -> Vec<(Pair, f32)> {
        /// Keyframes before and after one that share its view.
        const AROUND: usize = 7;
        let of = known[place];
        let mut is_open = vec![true; known.len()];
        let place_of = |id: &u64| known.partition_point(|known| known < id);
        let mut close = |at: usize| {
            let start = self.epoch_starts.range(..=known[at]).next_back().map_or(0, place_of);
            let next = self.epoch_starts.range(known[at] + 1..).next();
            let end = next.map_or(known.len(), place_of).min(at + AROUND + 1);
            is_open[start.max(at.saturating_sub(AROUND))..end].fill(false);
        };
        close(place);
        for partner in self.partners.get(&of).into_iter().flatten() {
            known.binary_search(partner).into_iter().for_each(&mut close);
        }
        let open = known[..place].iter().zip(&is_open).filter(|(_, is_open)| **is_open);
        let open: Vec<u64> = open.map(|(id, _)| *id).collect();
        let LoopParams { num_candidates, min_features, .. } = self.params;
        let alike = self.likeness.candidates(of, &open, num_candidates, min_features);
        let pair = |alike: PlaceCandidate| {
            let rigid = SE3 { rotation: alike.rotation(&self.intrinsics), ..SE3::identity() };
            (Pair { i: of, j: alike.keyframe_id, j_from_i: Sim3::new(rigid, 1.0) }, alike.score)
        };
        alike.into_iter().map(pair).collect()
    }

    /// Copies what the plan needs; returns false where there is nothing to do.
    pub fn begin(&mut self, map: &Map) -> bool {
        let Some(plan) = self.plan.take() else { return false };
        let ids: BTreeSet<u64> = plan.pairs.iter().flat_map(|pair| [pair.i, pair.j]).collect();
        let keyframes =
            ids.iter().filter_map(|id| map.get(*id).filter(|of| of.is_usable()).cloned());
        let keyframes: Vec<Keyframe> = keyframes.collect();
        let mut nodes: Vec<&Keyframe> = map.keyframes.iter().collect();
        nodes.sort_by_key(|node| node.keyframe_id);
        let is_usable = nodes.iter().map(|node| node.is_usable()).collect();
        let nodes = nodes.into_iter().map(Keyframe::without_depth).collect();
        self.job = Some(Box::new(Job { plan, keyframes, nodes, is_usable }));
        true
    }

    /// Runs the prepared job; returns false where there is none.
    pub fn run(&mut self) -> bool {
        let Some(job) = self.job.take() else { return false };
        let of = job.plan.of;
        let (other, (compared, outcome)) = match &job.plan.stage {
            Stage::Search => (job.plan.pairs.first().map(|pair| pair.j), self.search(&job)),
            Stage::Confirm(link) => (Some(link.j), self.confirm(&job, link)),
            Stage::Close { num_newest } => (None, (0, self.settle(&job, *num_newest))),
        };
        if outcome != SearchOutcome::Proposed && self.record.searched_to.is_none_or(|to| to < of) {
            self.mark_searched(of);
        }
        let is_fruitless =
            matches!(outcome, SearchOutcome::Refused(_) | SearchOutcome::AgainstDrift(_));
        self.fruitless = is_fruitless.then_some(of);
        let (measured, likeness) = (self.measured.take(), job.plan.likeness);
        let keyframe_id = of;
        self.report =
            Some(SearchReport { keyframe_id, other, likeness, compared, outcome, measured });
        true
    }

    /// Takes the report of the last search.
    pub fn take_report(&mut self) -> Option<SearchReport> {
        self.report.take()
    }

    /// Takes the closure to be applied to the map.
    pub fn take_closure(&mut self) -> Option<Closure> {
        self.closure.take()
    }

    /// Plans to solve the graph again, as the map changed meanwhile and the closure was not applied.
    pub fn repeat_closure(&mut self) {
        let Some(closure) = self.closure.take() else { return };
        let num_newest = confirmations(closure.join.is_none()) + 1;
        let of = self.record.links.last().map_or(0, |link| link.i);
        let stage = Stage::Close { num_newest };
        self.plan = Some(Plan { of, stage, pairs: Vec::new(), likeness: 0.0 });
    }

    fn mark_searched(&mut self, keyframe_id: u64) {
        Arc::make_mut(&mut self.record).searched_to = Some(keyframe_id);
        self.likeness.forget(keyframe_id);
    }
}

/// Number of pairs that must confirm a loop, within an epoch and between two.
fn confirmations(is_one_epoch: bool) -> usize {
    if is_one_epoch { 1 } else { 2 }
}
