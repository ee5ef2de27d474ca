//! A run reconstructed from its journal.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::service::adjustments::message::adjustment_from_message;
use crate::service::journal::folder::{LOG, keyframe_file};
use crate::service::journal::log::{Record, RunStart, read_log};
use crate::service::map_file::read_map;
use crate::service::recording::Recording;
use crate::service::results::record::{LoadedMap, RunCounters};
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;

/// Why a journal cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The log cannot be read.
    #[error("{path}: {source}; the journal is not usable")]
    Read {
        /// The log.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is not a log of this version.
    #[error("{0} is not a journal of this version of semidense")]
    Unknown(PathBuf),
}

/// The contents of a journal without the depth of its keyframes.
#[derive(Debug)]
pub struct Recovered {
    /// How the run was started.
    pub start: RunStart,
    /// Its poses and times.
    pub recording: Recording,
    /// Last write to the log: about the end of the run.
    pub ended: SystemTime,
    /// The last counters; at least as many frames as poses.
    pub counters: RunCounters,
    /// The map that the mapper had switched to.
    pub loaded_map: Option<LoadedMap>,
    /// Keyframes by id and the sequence of their frame, without image and points. Their epochs change where one is
    /// joined to another.
    keyframes: BTreeMap<(u64, u64), Keyframe>,
}

impl Recovered {
    /// Reads the journal in `folder`.
    pub fn read(folder: &Path) -> Result<Self, JournalError> {
        let path = folder.join(LOG);
        let file = File::open(&path)
            .map_err(|source| JournalError::Read { path: path.clone(), source })?;
        let written = file.metadata().and_then(|found| found.modified());
        let found = Self::from_log(BufReader::new(file)).ok_or(JournalError::Unknown(path))?;
        Ok(Self { ended: written.unwrap_or(found.ended), ..found })
    }

    /// Reads a log; `None` where it does not begin with the start of a run.
    pub fn from_log(log: impl Read) -> Option<Self> {
        let mut found: Option<Self> = None;
        read_log(log, &mut |record| match (&mut found, record) {
            (None, Record::Start(start)) => found = Some(Self::of(*start)),
            (None, _) => {}
            (Some(found), record) => found.take(record),
        });
        found
    }

    fn of(start: RunStart) -> Self {
        Self {
            ended: start.began(),
            start,
            recording: Recording::default(),
            counters: RunCounters::default(),
            loaded_map: None,
            keyframes: BTreeMap::new(),
        }
    }

    fn take(&mut self, record: Record) {
        match record {
            // A log has one, as its first record.
            Record::Start(_) => {}
            // Reading the log does not check the contents of a pose; invalid ones are left out.
            Record::Pose(pose) => drop(self.recording.add_pose(&pose)),
            Record::Step(step) => {
                self.recording.add_step(step.step_nanos, step.change_nanos, step.start_frame)
            }
            Record::Adjustment(message) => {
                if let Ok(record) = adjustment_from_message(&message) {
                    self.recording.add_adjustment(record);
                }
            }
            Record::Counters(counters) => self.counters = *counters,
            Record::LoadedMap(map) => self.loaded_map = Some(*map),
            Record::Keyframe(keyframe) => {
                self.keyframes.insert((keyframe.keyframe_id, keyframe.sequence), *keyframe);
            }
            Record::KeyframePose(epoch, pose) => {
                let of_id = (pose.keyframe_id, 0)..=(pose.keyframe_id, u64::MAX);
                if let Some((_, keyframe)) = self.keyframes.range_mut(of_id).next_back() {
                    (keyframe.epoch, keyframe.map_from_keyframe) = (epoch, pose.map_from_keyframe);
                }
            }
        }
        let frames_in = self.counters.frames_in.max(self.recording.num_poses() as u64);
        self.counters.frames_in = frames_in;
    }

    /// The map, with at most `max_bytes` of depth from the files in `folder`, newest first.
    pub fn map(&self, folder: &Path, max_bytes: u64) -> Map {
        let mut keyframes: Vec<Keyframe> = self.keyframes.values().cloned().collect();
        let mut bytes = 0;
        for keyframe in keyframes.iter_mut().rev() {
            if bytes > max_bytes {
                break;
            }
            let path = folder.join(keyframe_file(keyframe));
            let Ok(map) = read_map(&path) else { continue };
            let Some(kept) = map.keyframes.into_iter().next() else { continue };
            if kept.intrinsics == keyframe.intrinsics {
                take_depth(keyframe, kept);
                bytes += (keyframe.image.len() + size_of_val(&keyframe.points[..])) as u64;
            }
        }
        Map { keyframes, ..Map::default() }
    }
}

/// The map in the journal in `folder`; empty where it cannot be read.
pub(super) fn read_map_of(folder: &Path, max_bytes: u64) -> Map {
    Recovered::read(folder).map_or_else(|_| Map::default(), |found| found.map(folder, max_bytes))
}

/// Gives a keyframe image and depth of another state of it: each is in the keyframe's own unit.
fn take_depth(keyframe: &mut Keyframe, from: Keyframe) {
    keyframe.image = from.image;
    keyframe.points = from.points;
}

/// Completes the map of a mapper that died during the run from the journal: depth that the mapper no longer has, and
/// keyframes it never received.
pub fn complete(map: &mut Map, journal: Map) {
    for kept in journal.keyframes {
        match map.keyframes.iter().position(|keyframe| keyframe.is_same(&kept)) {
            Some(index) if map.keyframes[index].points.is_empty() && !kept.points.is_empty() => {
                take_depth(&mut map.keyframes[index], kept);
            }
            Some(_) => {}
            None => map.keyframes.push(kept),
        }
    }
    map.keyframes.sort_by_key(|keyframe| (keyframe.epoch, keyframe.keyframe_id));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::results::record::RunMode;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::KeyframePose;

    fn keyframe(keyframe_id: u64, epoch: u32) -> Keyframe {
        let at = Keyframe::at(Sim3::identity(), Intrinsics::pinhole(4, 4, 4.0), Vec::new(), vec![]);
        Keyframe { keyframe_id, epoch, sequence: 10 * keyframe_id, ..at }
    }

    #[test]
    fn a_joined_keyframe_is_one_keyframe_in_its_new_epoch() {
        let start = RunStart {
            mode: RunMode::Live,
            source: "sim".into(),
            rig: None,
            folder: "/x".into(),
            config: String::new(),
            poses_given: false,
            is_depth_from_sensor: false,
            first_keyframe_id: 0,
            began_nanos: 0,
        };
        let mut found = Recovered::of(start);
        for (id, epoch) in [(0, 0), (1, 1), (2, 1)] {
            found.take(Record::Keyframe(Box::new(keyframe(id, epoch))));
        }
        // Epoch 1 is joined to 0: one keyframe moves, another is written again.
        let map_from_keyframe = Sim3 { scale: 2.0, ..Sim3::identity() };
        let pose = KeyframePose { keyframe_id: 1, revision: 9, map_from_keyframe };
        found.take(Record::KeyframePose(0, pose));
        found.take(Record::Keyframe(Box::new(keyframe(2, 0))));
        let journal = found.map(Path::new("/nonexistent"), 0);
        let epochs: Vec<_> = journal.keyframes.iter().map(|k| (k.keyframe_id, k.epoch)).collect();
        assert_eq!(epochs, [(0, 0), (1, 0), (2, 0)]);
        assert_eq!(journal.keyframes[1].map_from_keyframe, map_from_keyframe);
        // A mapper's map that the journal has in an older state.
        let mut map = Map { keyframes: vec![keyframe(0, 0), keyframe(1, 0)], ..Map::default() };
        let old = Map { keyframes: vec![keyframe(1, 1), keyframe(2, 1)], ..Map::default() };
        complete(&mut map, old);
        let epochs: Vec<_> = map.keyframes.iter().map(|k| (k.keyframe_id, k.epoch)).collect();
        assert_eq!(epochs, [(0, 0), (1, 0), (2, 1)]);
    }
}
