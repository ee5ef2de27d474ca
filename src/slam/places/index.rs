//! The index of keyframes by appearance.

use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};

use super::arrangement::{Arrangement, Match, arrange};
use super::description::{Description, FeaturePlace, MAX_FEATURES};
use super::tree::{Entry, Tree, distance};
use crate::slam::geometry::intrinsics::Intrinsics;

/// Largest number of the 256 bits in which descriptors of the same corner differ.
const MAX_DISTANCE: u32 = 50;
/// Number of leaves searched for a feature.
const LEAVES: usize = 4;
/// Keyframes with most matches whose arrangement is examined.
const MAX_ARRANGED: usize = 30;

/// A keyframe that may show the same place as an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceCandidate {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Number of features that both show, in the same arrangement.
    pub score: f32,
    /// In-plane rotation of the image, radians: a direction in the keyframe's image plus this is the same in the image.
    pub turn_rad: f32,
    /// A pixel of the image, the mean of the features that both show.
    pub pixel: [f32; 2],
    /// The corresponding pixel of the keyframe.
    pub keyframe_pixel: [f32; 2],
}

impl PlaceCandidate {
    /// `keyframe_from_image`: aligns the corresponding pixels, with the rotation in the image's plane.
    pub fn rotation(&self, camera: &Intrinsics) -> UnitQuaternion<f64> {
        let ray = |[u, v]: [f32; 2]| {
            let (x, y) = (f64::from(u) - camera.cx, f64::from(v) - camera.cy);
            Vector3::new(x / camera.fx, y / camera.fy, 1.0)
        };
        let turn = -f64::from(self.turn_rad);
        let about_axis = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
        let [ours, theirs] = [about_axis * ray(self.pixel), ray(self.keyframe_pixel)];
        let between = UnitQuaternion::rotation_between(&ours, &theirs);
        between.unwrap_or_else(UnitQuaternion::identity) * about_axis
    }
}

/// A keyframe of the index.
#[derive(Debug, Clone)]
struct Slot {
    keyframe_id: u64,
    /// Whether it was removed; its entries are still in the tree.
    is_removed: bool,
    places: Vec<FeaturePlace>,
}

/// Keyframes indexed by appearance.
#[derive(Debug, Clone, Default)]
pub struct PlaceIndex {
    tree: Tree,
    slots: Vec<Slot>,
    slot_of: BTreeMap<u64, u32>,
    removed: usize,
}

impl PlaceIndex {
    /// Number of keyframes.
    pub fn len(&self) -> usize {
        self.slot_of.len()
    }

    /// Whether there are no keyframes.
    pub fn is_empty(&self) -> bool {
        self.slot_of.is_empty()
    }

    /// Whether it contains a keyframe.
    pub fn contains(&self, keyframe_id: u64) -> bool {
        self.slot_of.contains_key(&keyframe_id)
    }

    /// Ids of its keyframes, in order.
    pub fn keyframe_ids(&self) -> impl Iterator<Item = u64> {
        self.slot_of.keys().copied()
    }

    /// Inserts a keyframe, replacing any earlier entry of it.
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

    /// Removes a keyframe; returns whether it was present.
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

    /// Frees the entries of removed keyframes.
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

    /// The `most` keyframes that share most features with an image in one arrangement, best first, the newest first
    /// among equals; without those that are `excluded`.
    pub fn candidates(
        &self,
        description: &Description,
        most: usize,
        excluded: impl Fn(u64) -> bool,
    ) -> Vec<PlaceCandidate> {
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
        ranked.truncate(MAX_ARRANGED);
        let mut found: Vec<(Arrangement, u32)> = ranked
            .into_iter()
            .filter_map(|slot| {
                let begin = matches.partition_point(|m| m.slot < slot);
                let end = matches.partition_point(|m| m.slot <= slot);
                Some((self.arranged(description, &mut matches[begin..end])?, slot))
            })
            .collect();
        found.sort_by_key(|(arrangement, slot)| std::cmp::Reverse((arrangement.agreeing, *slot)));
        found.truncate(most);
        let candidate = |(arrangement, slot): (Arrangement, u32)| PlaceCandidate {
            keyframe_id: self.slots[slot as usize].keyframe_id,
            score: arrangement.agreeing as f32,
            turn_rad: arrangement.turn_rad,
            pixel: arrangement.ours,
            keyframe_pixel: arrangement.theirs,
        };
        found.into_iter().map(candidate).collect()
    }

    /// Pairs of features that look alike.
    fn matches(&self, description: &Description, is_excluded: &[bool]) -> Vec<Match> {
        let mut matches = Vec::new();
        let none = Default::default();
        for (k, feature) in description.features.iter().take(MAX_FEATURES).enumerate() {
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

    /// The arrangement of one keyframe's matching features.
    fn arranged(&self, description: &Description, matches: &mut [Match]) -> Option<Arrangement> {
        matches.sort_by_key(|m| (m.distance, m.ours));
        let pairs: Vec<(FeaturePlace, FeaturePlace)> = matches
            .iter()
            .filter_map(|m| {
                let theirs = self.slots[m.slot as usize].places.get(usize::from(m.theirs))?;
                Some((description.features[usize::from(m.ours)].place, *theirs))
            })
            .collect();
        arrange(&pairs, f32::from(description.width))
    }

    /// Bytes of memory.
    pub fn bytes(&self) -> usize {
        let places =
            |slot: &Slot| size_of::<Slot>() + slot.places.capacity() * size_of::<FeaturePlace>();
        self.tree.bytes() + self.slots.iter().map(places).sum::<usize>()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::places::Describer;
    use crate::slam::test_scene::{CAMERA, Scene};

    fn seen(twist: [f64; 6], seed: u64) -> Description {
        let pose = SE3::exp(&Vector6::from(twist));
        let pixels = Scene::new(3).render(&CAMERA, &pose).noisy(2.0, seed);
        Describer::default().describe(&pixels, CAMERA.width, CAMERA.height).unwrap()
    }

    fn panned(angle: f64) -> [f64; 6] {
        [0.0, 0.0, 0.0, 0.0, angle, 0.0]
    }

    /// Views all around, 60° apart.
    fn around() -> PlaceIndex {
        let mut index = PlaceIndex::default();
        for k in 0..6 {
            index.insert(10 + k, &seen(panned(k as f64 * std::f64::consts::FRAC_PI_3), k));
        }
        index
    }

    fn ids(found: &[PlaceCandidate]) -> Vec<u64> {
        found.iter().map(|candidate| candidate.keyframe_id).collect()
    }

    #[test]
    fn a_place_is_found_from_the_side_rotated_and_rolled() {
        let index = around();
        for (twist, expected) in [
            ([0.2, -0.1, 0.1, 0.0, 0.0, 0.0], 10),
            ([0.0, 0.0, 0.0, 0.0, 0.2, 0.0], 10),
            ([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], 10),
            ([0.0, 0.0, 0.0, 0.0, 0.0, 1.6], 10),
            (panned(2.0 * std::f64::consts::FRAC_PI_3 + 0.1), 12),
        ] {
            let found = index.candidates(&seen(twist, 99), 2, |_| false);
            assert_eq!(found[0].keyframe_id, expected, "{twist:?}: {found:?}");
            assert!(
                found.get(1).is_none_or(|other| 2.0 * other.score < found[0].score),
                "{found:?}"
            );
        }
    }

    #[test]
    fn excluded_or_removed_keyframes_are_not_found() {
        let mut index = around();
        let here = seen([0.0; 6], 99);
        assert_eq!(ids(&index.candidates(&here, 1, |_| false)), [10]);
        assert!(!ids(&index.candidates(&here, 6, |id| id == 10)).contains(&10));
        assert_eq!(index.candidates(&here, 0, |_| false), []);
        assert!(index.remove(10) && !index.remove(10));
        assert_eq!((index.len(), index.contains(10)), (5, false));
        assert!(!ids(&index.candidates(&here, 6, |_| false)).contains(&10));
        index.insert(10, &here);
        assert_eq!(ids(&index.candidates(&here, 1, |_| false)), [10]);
    }

    #[test]
    fn removed_keyframes_leave_no_memory_and_no_trace() {
        let views: Vec<Description> = (0..6).map(|k| seen(panned(f64::from(k)), 7)).collect();
        let mut index = around();
        let bytes = index.bytes();
        for round in 0..100 {
            let of = |k: usize| 100 + (6 * round + k) as u64;
            (0..6).for_each(|k| index.insert(of(k), &views[k]));
            (0..6).for_each(|k| assert!(index.remove(of(k))));
        }
        assert!(index.bytes() < 3 * bytes, "{bytes} B became {}", index.bytes());
        let here = seen([0.0; 6], 99);
        assert_eq!(ids(&index.candidates(&here, 1, |_| false)), [10]);
    }

    #[test]
    fn the_newest_of_equals_is_first_and_an_id_is_inserted_once() {
        let mut index = PlaceIndex::default();
        let here = seen([0.0; 6], 1);
        [4, 9, 4].into_iter().for_each(|id| index.insert(id, &here));
        assert_eq!(index.len(), 2);
        assert_eq!(ids(&index.candidates(&here, 9, |_| false)), [4, 9]);
    }

    #[test]
    fn a_stored_description_finds_and_is_found() {
        let here = seen([0.0; 6], 1);
        let features = here.features().to_vec();
        let kept = Description::of_features(CAMERA.width, CAMERA.height, features).unwrap();
        assert_eq!(kept.features(), here.features());
        let mut index = around();
        index.insert(50, &kept);
        assert_eq!(ids(&index.candidates(&here, 1, |_| false)), [50]);
        assert_eq!(ids(&around().candidates(&kept, 1, |_| false)), [10]);
    }
}
