//! The journal of a replay: the same records, taken from the run record that grows in the same process.

use std::collections::HashMap;
use std::io;
use std::time::{Duration, Instant};

use crate::service::adjustments::message::adjustment_message;
use crate::service::journal::log::{Record, Step};
use crate::service::journal::{Journal, JournalOptions};
use crate::service::replay::ReplayProgress;
use crate::service::results::record::RunRecord;
use crate::slam::keyframe::{Keyframe, KeyframePose};
use crate::wire::conversion::{PoseTiming, code_from_start_frame, pose_message};
use crate::wire::place::Place;

/// Time between two writes of the same keyframe to the journal.
const PERIOD: Duration = Duration::from_secs(2);

/// Follows a replay.
#[derive(Debug)]
pub struct ReplayJournal {
    journal: Journal,
    begin: Instant,
    /// Poses, steps and joint estimates in the journal.
    poses: usize,
    steps: usize,
    adjustments: usize,
    /// Revisions in the journal, by keyframe.
    revisions: HashMap<u64, u64>,
    active: Option<u64>,
    looked: Instant,
}

impl ReplayJournal {
    /// Begins the journal.
    pub fn begin(options: &JournalOptions, place: &Place) -> io::Result<Self> {
        Ok(Self {
            journal: Journal::begin(options, place)?,
            begin: Instant::now(),
            poses: 0,
            steps: 0,
            adjustments: 0,
            revisions: HashMap::new(),
            active: None,
            looked: Instant::now(),
        })
    }

    /// The journal alone, to be finished.
    pub fn into_journal(self) -> Journal {
        self.journal
    }

    /// Takes in what a frame has added.
    pub fn observe(&mut self, progress: &ReplayProgress<'_>) {
        self.take_poses(progress.record, code_from_start_frame(progress.start_frame));
        let active = progress.keyframe.map(|keyframe| keyframe.keyframe_id);
        let has_changed = active != self.active;
        if has_changed || self.looked.elapsed() >= PERIOD {
            self.looked = Instant::now();
            // A keyframe for which the disk was too slow is retried in the next round.
            self.active = active;
            self.take_keyframes(&progress.map.keyframes);
        }
        if self.journal.wants_counters() {
            self.journal.count(progress.record.counters);
        }
    }

    fn take_poses(&mut self, record: &RunRecord, start_frame: u32) {
        let published_nanos = i64::try_from(self.begin.elapsed().as_nanos()).unwrap_or(i64::MAX);
        for pose in &record.poses[self.poses..] {
            let track_nanos = pose.track_nanos.unwrap_or(0);
            let timing = PoseTiming { published_nanos, track_nanos, ..PoseTiming::default() };
            let message = pose_message(&pose.estimate, &timing);
            self.journal.append(&Record::Pose(Box::new(message)));
        }
        for step in &record.map_nanos[self.steps..] {
            let (step_nanos, change_nanos) = (*step, 0);
            self.journal.append(&Record::Step(Step { step_nanos, change_nanos, start_frame }));
        }
        for adjustment in &record.adjustments[self.adjustments..] {
            self.journal.append(&Record::Adjustment(adjustment_message(adjustment)));
        }
        (self.poses, self.steps) = (record.poses.len(), record.map_nanos.len());
        self.adjustments = record.adjustments.len();
    }

    /// Gives the journal every keyframe whose state there is older. Of older keyframes, many of which a correction
    /// moves, and of those that have lost their depth, only the poses: depth hardly changes any more, and takes 2 MB each.
    fn take_keyframes(&mut self, keyframes: &[Keyframe]) {
        const WITH_DEPTH: usize = 3;
        let older = keyframes.len().saturating_sub(WITH_DEPTH);
        for (index, keyframe) in keyframes.iter().enumerate() {
            let key = keyframe.keyframe_id;
            let known = self.revisions.get(&key);
            if known == Some(&keyframe.revision) || known.is_none() && !keyframe.has_depth() {
                continue;
            }
            if known.is_some() && (index < older || !keyframe.has_depth()) {
                let pose = KeyframePose::of(keyframe);
                self.journal.append(&Record::KeyframePose(keyframe.epoch, pose));
            } else if self.journal.put_keyframe(keyframe.clone()).is_some() {
                return;
            }
            self.revisions.insert(key, keyframe.revision);
        }
    }
}
