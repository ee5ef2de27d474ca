//! The index of keyframes by what they look like.

use std::collections::BTreeMap;

use super::arrangement::{Match, agreeing};
use super::description::{Description, FeaturePlace, MAX_FEATURES};
use super::tree::{Entry, Tree, distance};

/// Bits of 256 in which descriptors of the same corner differ at most.
const MAX_DISTANCE: u32 = 50;
/// Leaves that are searched for a feature.
const LEAVES: usize = 4;
/// Keyframes with most matches whose arrangement is looked at.
const MOST_ARRANGED: usize = 30;

/// A keyframe that may show what an image does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Features that both show, in the same arrangement.
    pub score: f32,
}

/// A keyframe of the index.
#[derive(Debug, Clone)]
struct Slot {
    keyframe_id: u64,
    /// Whether it was taken out; its entries are still there.
    is_removed: bool,
    places: Vec<FeaturePlace>,
}

/// Keyframes by what they look like.
#[derive(Debug, Clone)]
pub struct PlaceIndex {
    tree: Tree,
    slots: Vec<Slot>,
    slot_of: BTreeMap<u64, u32>,
    removed: usize,
}

impl Default for PlaceIndex {
    fn default() -> Self {
        Self::new()
    }
}

impl PlaceIndex {
    /// Without keyframes.
    pub fn new() -> Self {
        Self { tree: Tree::new(), slots: Vec::new(), slot_of: BTreeMap::new(), removed: 0 }
    }

    /// Keyframes in it.
    pub fn len(&self) -> usize {
        self.slot_of.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.slot_of.is_empty()
    }

    /// Whether a keyframe is in it.
    pub fn contains(&self, keyframe_id: u64) -> bool {
        self.slot_of.contains_key(&keyframe_id)
    }

    /// Enters a keyframe, in place of what was known of it.
    pub fn insert(&mut self, keyframe_id: u64, description: &Description) {
        self.remove(keyframe_id);
        let slot = self.slots.len() as u32;
        let features = &description.features[..description.features.len().min(MAX_FEATURES)];
        for (feature, of) in (0..).zip(features) {
            self.tree.insert(Entry { bits: of.bits, slot, feature });
        }
        let places = features.iter().map(|feature| feature.place).collect();
        self.slots.push(Slot { keyframe_id, is_removed: false, places });
        self.slot_of.insert(keyframe_id, slot);
    }

    /// Takes a keyframe out; whether it was there.
    pub fn remove(&mut self, keyframe_id: u64) -> bool {
        let Some(slot) = self.slot_of.remove(&keyframe_id) else { return false };
        let slot = &mut self.slots[slot as usize];
        slot.is_removed = true;
        slot.places = Vec::new();
        self.removed += 1;
        if 4 * self.removed > self.slots.len() {
            self.sweep();
        }
        true
    }

    /// Frees what removed keyframes have left.
    fn sweep(&mut self) {
        let slots = &self.slots;
        self.tree.retain(|entry| !slots[entry.slot as usize].is_removed);
        let mut next = 0;
        let new: Vec<u32> = slots
            .iter()
            .map(|slot| {
                let at = next;
                next += u32::from(!slot.is_removed);
                at
            })
            .collect();
        self.tree.renumber(&new);
        self.slots.retain(|slot| !slot.is_removed);
        self.slot_of.values_mut().for_each(|slot| *slot = new[*slot as usize]);
        self.removed = 0;
    }

    /// The keyframes, `most` of them, that share most features with an image in one arrangement, best first, of equals the
    /// newest; without those that are `excluded`.
    pub fn candidates(
        &self,
        description: &Description,
        most: usize,
        excluded: impl Fn(u64) -> bool,
    ) -> Vec<Candidate> {
        let is_excluded: Vec<bool> =
            self.slots.iter().map(|slot| slot.is_removed || excluded(slot.keyframe_id)).collect();
        let mut matches = self.matches(description, &is_excluded);
        let mut votes = vec![0u32; self.slots.len()];
        matches.sort_by_key(|m| (m.slot, m.ours, m.distance, m.theirs));
        matches.dedup_by_key(|m| (m.slot, m.ours));
        for m in &matches {
            votes[m.slot as usize] += 1;
        }
        let mut ranked: Vec<u32> =
            (0..votes.len() as u32).filter(|&slot| votes[slot as usize] > 0).collect();
        ranked.sort_by_key(|&slot| std::cmp::Reverse((votes[slot as usize], slot)));
        ranked.truncate(MOST_ARRANGED);
        let mut found: Vec<(u32, u32)> = ranked
            .into_iter()
            .map(|slot| {
                let begin = matches.partition_point(|m| m.slot < slot);
                let end = matches.partition_point(|m| m.slot <= slot);
                (self.agreeing(description, &mut matches[begin..end]), slot)
            })
            .collect();
        found.sort_by(|one, other| other.cmp(one));
        found.truncate(most);
        let candidate = |(score, slot): (u32, u32)| Candidate {
            keyframe_id: self.slots[slot as usize].keyframe_id,
            score: score as f32,
        };
        found.into_iter().map(candidate).collect()
    }

    /// Pairs of features that look alike.
    fn matches(&self, description: &Description, is_excluded: &[bool]) -> Vec<Match> {
        let mut matches = Vec::new();
        let none = Default::default();
        for (k, feature) in description.features.iter().enumerate() {
            let unsure = description.unsure.get(k).unwrap_or(&none);
            self.tree.visit(&feature.bits, unsure, LEAVES, &mut |entries| {
                for entry in entries {
                    let distance = distance(&feature.bits, &entry.bits);
                    if distance <= MAX_DISTANCE && !is_excluded[entry.slot as usize] {
                        let Entry { slot, feature: theirs, .. } = *entry;
                        let (ours, distance) = (k as u16, distance as u16);
                        matches.push(Match { slot, ours, theirs, distance });
                    }
                }
            });
        }
        matches
    }

    /// Matches with one keyframe that agree on an arrangement.
    fn agreeing(&self, description: &Description, matches: &mut [Match]) -> u32 {
        matches.sort_by_key(|m| (m.distance, m.ours));
        let pairs: Vec<(FeaturePlace, FeaturePlace)> = matches
            .iter()
            .filter_map(|m| {
                let theirs = self.slots[m.slot as usize].places.get(usize::from(m.theirs))?;
                Some((description.features[usize::from(m.ours)].place, *theirs))
            })
            .collect();
        agreeing(&pairs, f32::from(description.width))
    }

    /// Bytes of memory.
    pub fn bytes(&self) -> usize {
        let places =
            |slot: &Slot| size_of::<Slot>() + slot.places.capacity() * size_of::<FeaturePlace>();
        self.tree.bytes() + self.slots.iter().map(places).sum::<usize>()
    }
}
