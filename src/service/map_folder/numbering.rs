//! Numbers of a map that a running mapper switches to: in the run its keyframes and epochs get numbers that the run has
//! not assigned yet, on disk they keep their own.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::slam::keyframe::Keyframe;
use crate::slam::loops::record::LoopRecord;
use crate::slam::map::Map;
use crate::slam::mapper::Mapper;

/// Offset of the numbers of a run from those on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Numbering {
    /// Of keyframes.
    pub ids: u64,
    /// Of epochs.
    pub epochs: u32,
    /// Of corrections of the map.
    pub revisions: u64,
}

impl Numbering {
    /// Above the numbers that a mapper has assigned.
    pub fn above(mapper: &Mapper) -> Self {
        Self {
            ids: mapper.free_keyframe_id(),
            epochs: mapper.free_epoch(),
            revisions: mapper.map().revision,
        }
    }

    /// Above the numbers that a mapper which died after this checkpoint has assigned.
    pub fn above_map(map: &Map) -> Self {
        Self { ids: map.free_keyframe_id(), epochs: map.free_epoch, revisions: map.revision }
    }

    /// A map in the numbers of the run.
    pub fn in_run(&self, map: Map) -> Map {
        let renumbered = |keyframe: Keyframe| Keyframe {
            keyframe_id: keyframe.keyframe_id.saturating_add(self.ids),
            epoch: keyframe.epoch.saturating_add(self.epochs),
            ..keyframe
        };
        Map {
            keyframes: map.keyframes.into_iter().map(renumbered).collect(),
            loops: Arc::new(LoopRecord::default().with(&map.loops, self.ids)),
            revision: map.revision.saturating_add(self.revisions),
            free_epoch: map.free_epoch.saturating_add(self.epochs),
            ..map
        }
    }

    /// A keyframe in the numbers of the disk; `None` for those that the run had before.
    pub fn on_disk(&self, keyframe: Keyframe) -> Option<Keyframe> {
        let keyframe_id = keyframe.keyframe_id.checked_sub(self.ids)?;
        let epoch = keyframe.epoch.checked_sub(self.epochs)?;
        Some(Keyframe { keyframe_id, epoch, ..keyframe })
    }

    /// The contents of a manifest in the numbers of the disk.
    pub fn head_on_disk(&self, head: Map) -> Map {
        if *self == Self::default() {
            return head;
        }
        Map {
            keyframes: head.keyframes.into_iter().filter_map(|of| self.on_disk(of)).collect(),
            loops: Arc::new(head.loops.from(self.ids)),
            revision: head.revision.saturating_sub(self.revisions),
            free_epoch: head.free_epoch.saturating_sub(self.epochs),
            ..head
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::loop_bytes::tests::loops;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::sim3::Sim3;

    #[test]
    fn the_disk_keeps_its_numbers_and_omits_earlier_keyframes_of_the_run() {
        let camera = Intrinsics::pinhole(64, 48, 60.0);
        let keyframe = |keyframe_id: u64, epoch: u32| Keyframe {
            keyframe_id,
            epoch,
            ..Keyframe::at(Sim3::identity(), camera, Vec::new(), Vec::new())
        };
        let keyframes = vec![keyframe(0, 0), keyframe(3, 2)];
        let loops = Arc::new(loops());
        let map = Map { keyframes, loops, revision: 4, free_epoch: 3, ..Map::default() };
        let numbering = Numbering { ids: 100, epochs: 7, revisions: 20 };
        let in_run = numbering.in_run(map.clone());
        let numbers: Vec<(u64, u32)> =
            in_run.keyframes.iter().map(|of| (of.keyframe_id, of.epoch)).collect();
        assert_eq!(numbers, [(100, 7), (103, 9)]);
        assert_eq!((in_run.revision, in_run.free_epoch), (24, 10));
        assert!(in_run.loops.links.iter().all(|link| link.i >= 100 && link.j >= 100));
        let before = [keyframe(0, 0), keyframe(99, 6)];
        let loops = Arc::new(LoopRecord::default().with(&in_run.loops, 0).with(&map.loops, 0));
        assert_ne!(*loops, *in_run.loops);
        let head = numbering.head_on_disk(Map {
            keyframes: before.into_iter().chain(in_run.keyframes).collect(),
            loops,
            ..in_run
        });
        assert_eq!(head.keyframes, map.keyframes);
        assert_eq!((head.revision, head.free_epoch), (4, 3));
        assert_eq!(head.loops.links, map.loops.links);
        assert_eq!(head.loops.held_by, map.loops.held_by);
        assert_eq!(head.loops.relative_covariances, map.loops.relative_covariances);
        assert_eq!(head.loops.beginnings, map.loops.beginnings);
    }
}
