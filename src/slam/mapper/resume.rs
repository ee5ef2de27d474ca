//! Checkpoints: the part of the map that a mapper needs to continue after its death, and how it continues.

use std::sync::Arc;

use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;
use crate::slam::mapper::phase::Phase;
use crate::slam::mapper::recovery::restore_points;
use crate::slam::mapper::{Mapper, StepOutcome};

/// More keyframes than are made between two checkpoints, and more revisions.
const UNKNOWN_KEYFRAMES: u64 = 1000;
const UNKNOWN_REVISIONS: u64 = 1_000_000;
/// More epochs than a mapper starts between two checkpoints: an epoch that is proven is checkpointed at once.
const UNKNOWN_EPOCHS: u32 = 16;

impl Map {
    /// Reserves numbers in `self`, the checkpoint of a dead mapper if any. Write it before numbering anything: the next
    /// mapper then uses others, even if this one dies without another checkpoint.
    pub fn reserve_numbers(&mut self) {
        self.free_epoch = self.free_epoch.saturating_add(UNKNOWN_EPOCHS);
    }

    /// First keyframe number that none of the mappers which died since this checkpoint has assigned.
    pub fn free_keyframe_id(&self) -> u64 {
        let newest = self.keyframes.iter().map(|keyframe| keyframe.keyframe_id).max();
        newest.unwrap_or(0).saturating_add(UNKNOWN_KEYFRAMES * self.reservations())
    }

    /// First revision that none of them has assigned.
    fn free_revision(&self) -> u64 {
        let newest = self.keyframes.iter().map(|keyframe| keyframe.revision).max();
        newest.unwrap_or(0).saturating_add(UNKNOWN_REVISIONS * self.reservations())
    }

    /// At least the number of mappers that have reserved numbers since the checkpoint, and one: each of them may have
    /// assigned keyframe ids and revisions beyond those of the one before.
    fn reservations(&self) -> u64 {
        u64::from(self.free_epoch / UNKNOWN_EPOCHS).max(1)
    }
}

impl Mapper {
    /// Returns a keyframe that was left or refined and whose depth is final for now: call it after
    /// [`Mapper::finish_keyframe`], until it returns `None`.
    pub fn take_keyframe_to_save(&mut self) -> Option<&Keyframe> {
        while let Some(left) = self.left.pop_front() {
            if self.map.get(left).is_some_and(Keyframe::has_depth) {
                return self.map.get(left);
            }
        }
        None
    }

    /// Queues a keyframe whose depth may be worth saving.
    pub(super) fn queue_keyframe_to_save(&mut self, keyframe_id: u64) {
        /// Most keyframes in the queue, where none are taken.
        const MAX_QUEUED_KEYFRAMES: usize = 8;
        self.left.retain(|&id| id != keyframe_id);
        self.left.push_back(keyframe_id);
        let surplus = self.left.len().saturating_sub(MAX_QUEUED_KEYFRAMES);
        self.left.drain(..surplus);
    }

    /// The active keyframe with its image and depth, and the poses of the others of its epoch; `None`
    /// where there is no established keyframe to continue from.
    pub fn checkpoint(&self) -> Option<Map> {
        let current = self.keyframe()?;
        if current.map_state != MapState::Established {
            return None;
        }
        let of_epoch = self.map.keyframes.iter().filter(|k| k.epoch == current.epoch);
        let keyframes = of_epoch.map(|keyframe| match std::ptr::eq(keyframe, current) {
            true => keyframe.clone(),
            false => keyframe.without_depth(),
        });
        Some(Map {
            keyframes: keyframes.collect(),
            loops: Arc::clone(&self.map.loops),
            revision: self.map.revision,
            active: Some(current.keyframe_id),
            free_epoch: self.free_epoch().saturating_add(UNKNOWN_EPOCHS),
            ..Map::default()
        })
    }

    /// Takes over from the mapper of another camera: its keyframes stay in the map, and epochs, ids and
    /// revisions continue.
    pub fn continue_from(&mut self, before: Self) {
        self.map = before.map;
        self.revision = before.revision;
        self.next_keyframe_id = before.next_keyframe_id;
        self.first_free_epoch = before.first_free_epoch;
        self.resume_loops();
    }

    /// Skips the numbers that mappers which died since the checkpoint `left` may have assigned, in this map or beyond
    /// it. Call it before the first frame.
    pub fn skip_numbers_after(&mut self, left: &Map) {
        let (ids, revisions) = (left.free_keyframe_id(), left.free_revision());
        let mappers = left.reservations();
        self.next_keyframe_id =
            self.next_keyframe_id.saturating_add(UNKNOWN_KEYFRAMES * mappers).max(ids);
        self.revision = self.revision.saturating_add(UNKNOWN_REVISIONS * mappers).max(revisions);
        self.first_free_epoch = self.first_free_epoch.saturating_add(left.free_epoch);
    }

    /// Continues from a checkpoint: its keyframe becomes active again, the epoch and all ids continue. From a map that
    /// this camera cannot have made, only the numbers continue.
    pub fn resume(&mut self, map: Map) -> StepOutcome {
        let fits = |keyframe: &Keyframe| {
            keyframe.intrinsics == self.intrinsics
                && keyframe.image.len() == self.intrinsics.width * self.intrinsics.height
                && !keyframe.points.is_empty()
                && keyframe.map_state == MapState::Established
        };
        if map.free_epoch == 0 && map.keyframes.is_empty() {
            return StepOutcome::default();
        }
        // The dead mapper may have assigned numbers after its last checkpoint: skip these.
        self.revision = map.free_revision();
        self.next_keyframe_id = map.free_keyframe_id();
        self.first_free_epoch = map.free_epoch;
        let was_active = map.active.and_then(|active| map.index_of(active));
        let was_active = was_active.filter(|&index| fits(&map.keyframes[index]));
        let Some(index) = was_active.or_else(|| map.keyframes.iter().rposition(fits)) else {
            return StepOutcome::default();
        };
        self.map = Map { active: None, ..map };
        self.index_map();
        let keyframe = &self.map.keyframes[index];
        self.depth.restart(&keyframe.image, &self.params);
        restore_points(&mut self.depth.active, &keyframe.points);
        // The pose of the map in odometry's world when the mapper died.
        self.world_from_map = Self::world_from_map_of(keyframe);
        self.past.clear();
        self.phase = Phase::Mapping;
        self.activate_keyframe(index);
        StepOutcome::keyframe_restored(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::DepthPoint;
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::prior::MapUse;
    use crate::slam::test_scene::CAMERA;

    fn mapper() -> Mapper {
        Mapper::new(CAMERA, MapperParams::default()).unwrap()
    }

    fn keyframe(epoch: u32) -> Keyframe {
        let point = DepthPoint { u: 9, v: 9, inverse_depth: 1.0, variance: 0.1, intensity: 9.0 };
        Keyframe {
            keyframe_id: 3,
            epoch,
            revision: 5,
            sequence: 1,
            ..Keyframe::at(
                Sim3::identity(),
                CAMERA,
                vec![point],
                (0..CAMERA.width * CAMERA.height).map(|i| (i * i % 251) as u8).collect(),
            )
        }
    }

    /// The checkpoint of a mapper that dies after its start, and its first numbers: epoch, keyframe and revision.
    fn short_life(left: Option<Map>) -> (Map, (u32, u64, u64)) {
        let mut reserved = left.clone().unwrap_or_default();
        reserved.reserve_numbers();
        let mut mapper = mapper();
        if let Some(map) = left {
            mapper.resume(map);
        }
        (reserved, (mapper.free_epoch(), mapper.free_keyframe_id(), mapper.revision))
    }

    #[test]
    fn no_mapper_reuses_numbers_of_one_that_died_without_a_checkpoint() {
        let (left, first) = short_life(None);
        let (left, second) = short_life(Some(left));
        let (_, third) = short_life(Some(left));
        assert_eq!(first, (0, 0, 0));
        assert!(second.0 > first.0 && third.0 > second.0, "{second:?} {third:?}");
        assert!(second.1 >= UNKNOWN_KEYFRAMES && second.2 >= UNKNOWN_REVISIONS, "{second:?}");
        assert!(third.1 - second.1 >= UNKNOWN_KEYFRAMES, "{second:?} {third:?}");
        assert!(third.2 - second.2 >= UNKNOWN_REVISIONS, "{second:?} {third:?}");
    }

    #[test]
    fn mappers_that_die_in_a_map_on_disk_before_a_checkpoint_assign_different_numbers() {
        let map = || Map { keyframes: vec![keyframe(2)], free_epoch: 7, ..Map::default() };
        let mut left: Option<Map> = None;
        let mut numbers = Vec::new();
        for _ in 0..3 {
            let mut mapper = mapper();
            mapper.start_in_map(map(), MapUse::Extend).unwrap();
            left.iter().for_each(|left| mapper.skip_numbers_after(left));
            numbers.push([
                mapper.next_keyframe_id / UNKNOWN_KEYFRAMES,
                mapper.revision / UNKNOWN_REVISIONS,
                u64::from((mapper.free_epoch() - 7) / UNKNOWN_EPOCHS),
            ]);
            left.get_or_insert_default().reserve_numbers();
        }
        assert_eq!(numbers, [[0, 0, 0], [1, 1, 1], [2, 2, 2]]);
    }

    #[test]
    fn an_established_epoch_continues_and_the_next_one_has_a_new_number() {
        let mut first = mapper();
        first.resume(Map { keyframes: vec![keyframe(2)], free_epoch: 7, ..Map::default() });
        assert_eq!(first.keyframe().unwrap().epoch, 2);
        // It is lost, starts an epoch with this number that is never proven, and dies.
        let unproven = first.free_epoch();
        let mut second = mapper();
        second.resume(first.checkpoint().unwrap());
        assert_eq!(second.keyframe().unwrap().epoch, 2);
        assert!(second.free_epoch() > unproven);
        let mut with_another_camera = mapper();
        let unproven = second.free_epoch();
        with_another_camera.continue_from(second);
        assert_eq!(with_another_camera.free_epoch(), unproven);
    }
}
