//! State of the search for loops of a map, stored with the map.

use std::collections::{BTreeMap, BTreeSet};

use crate::slam::geometry::sim3::{Matrix7, Sim3};
use crate::slam::graph::constraint::Measurement;
use crate::slam::keyframe::Keyframe;

/// A loop: a measurement between two keyframes, by their ids.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// One keyframe.
    pub i: u64,
    /// The other.
    pub j: u64,
    /// The similarity between them, in their units.
    pub j_from_i: Sim3,
    /// Covariance of its left increment (translation, rotation, log scale), in units of j.
    pub covariance: Matrix7,
}

/// Loops of a map, and the keyframes that each was estimated against.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LoopRecord {
    /// Accepted loops, in the order in which they were found.
    pub links: Vec<Link>,
    /// By keyframe: the older ones that its pose was estimated against.
    pub held_by: BTreeMap<u64, Vec<u64>>,
    /// By keyframe: covariance of the left increment of its pose relative to those, in its unit.
    pub relative_covariances: BTreeMap<u64, Matrix7>,
    /// Keyframes without a link to the one before: the first of epochs that were joined to others.
    pub beginnings: BTreeSet<u64>,
    /// All keyframes up to this one have been searched.
    pub searched_to: Option<u64>,
}

impl Link {
    pub(super) fn of(i: u64, j: u64, measurement: &Measurement) -> Self {
        let Measurement { j_from_i, covariance, .. } = *measurement;
        Self { i, j, j_from_i, covariance }
    }
}

impl LoopRecord {
    /// Whether nothing is stored.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Keyframes at the ends of loops.
    pub fn keyframe_ids(&self) -> BTreeSet<u64> {
        self.links.iter().flat_map(|link| [link.i, link.j]).collect()
    }

    /// Takes the place covariances of keyframes that were estimated as those relative to others, which they were before
    /// these were stored.
    pub fn take_places_as_relative<'a>(&mut self, keyframes: impl Iterator<Item = &'a Keyframe>) {
        let estimated = keyframes.filter(|of| self.held_by.contains_key(&of.keyframe_id));
        let relative = |of: &Keyframe| {
            (of.keyframe_id, of.place_covariance.of_left_increment(&of.map_from_keyframe))
        };
        self.relative_covariances = estimated.map(relative).collect();
    }

    /// Merges the loops of two maps, with `ids` added to the ids of the second.
    pub fn with(mut self, second: &Self, ids: u64) -> Self {
        let moved = |id: &u64| id.saturating_add(ids);
        let links = second.links.iter().map(|of| Link { i: moved(&of.i), j: moved(&of.j), ..*of });
        self.links.extend(links);
        let held = second.held_by.iter();
        self.held_by.extend(held.map(|(id, by)| (moved(id), by.iter().map(moved).collect())));
        let covariances = second.relative_covariances.iter();
        self.relative_covariances.extend(covariances.map(|(id, of)| (moved(id), *of)));
        self.beginnings.extend(second.beginnings.iter().map(moved));
        self.searched_to = second.searched_to.as_ref().map(moved).or(self.searched_to);
        self
    }

    /// The loops of the keyframes from id `ids` on, with `ids` subtracted from theirs.
    pub fn from(&self, ids: u64) -> Self {
        let moved = |id: u64| id.checked_sub(ids);
        let link = |of: &Link| Some(Link { i: moved(of.i)?, j: moved(of.j)?, ..*of });
        let held = |(&id, by): (&u64, &Vec<u64>)| {
            Some((moved(id)?, by.iter().copied().filter_map(moved).collect()))
        };
        Self {
            links: self.links.iter().filter_map(link).collect(),
            held_by: self.held_by.iter().filter_map(held).collect(),
            relative_covariances: {
                let of_id = |(&id, &of): (&u64, &Matrix7)| Some((moved(id)?, of));
                self.relative_covariances.iter().filter_map(of_id).collect()
            },
            beginnings: self.beginnings.iter().copied().filter_map(moved).collect(),
            searched_to: self.searched_to.and_then(moved),
        }
    }

    /// By keyframe: those that it was estimated with, older and newer, as far as they held each other.
    pub(super) fn partners(&self) -> BTreeMap<u64, BTreeSet<u64>> {
        let mut partners: BTreeMap<u64, BTreeSet<u64>> = BTreeMap::new();
        for (&one, by) in &self.held_by {
            for &other in by {
                partners.entry(one).or_default().insert(other);
                partners.entry(other).or_default().insert(one);
            }
        }
        partners
    }

    /// The newest keyframe that cannot be searched any more: it was searched already, or it has no record of what it
    /// was estimated with, so its neighbours would be taken for loops.
    pub(super) fn last_searched(&self, keyframes: &[Keyframe]) -> Option<u64> {
        let is_unknown = |id: &u64| !self.held_by.contains_key(id);
        let unknown = keyframes.iter().map(|of| of.keyframe_id).filter(is_unknown).max();
        self.searched_to.max(unknown)
    }
}
