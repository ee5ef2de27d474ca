//! Collects what a run publishes until its results are written, and keeps its journal.

use std::io;

use crate::service::adjustments::message::adjustment_from_message;
use crate::service::journal::feed::KeyframeFeed;
use crate::service::journal::log::{Record, Step};
use crate::service::journal::recovered::complete;
use crate::service::journal::{Journal, JournalOptions};
use crate::service::recording::Recording;
use crate::service::results::record::{LoadedMap, RunCounters, RunRecord};
use crate::slam::map::Map;
use crate::wire::message::{AdjustmentMessage, PoseMessage, StepMessage};
use crate::wire::place::Place;
use crate::wire::port::{Events, Hub, OpenError, ReceiveError, Subscriber};
use crate::wire::topic::{ADJUSTMENT, POSE, STEP};

/// Poses and steps as they arrive.
#[derive(Debug)]
pub struct Recorder {
    poses: Subscriber<PoseMessage, ()>,
    steps: Subscriber<StepMessage, ()>,
    adjustments: Subscriber<AdjustmentMessage, ()>,
    /// Collected so far.
    pub recording: Recording,
    /// The last step of the mapper.
    pub last_step: Option<StepMessage>,
    /// The map in the journal that the mapper has switched to.
    loaded_map: Option<LoadedMap>,
    journal: Option<Journal>,
    /// Needed by the journal alone; `None` without one, and after it has failed.
    keyframes: Option<KeyframeFeed>,
}

impl Recorder {
    /// Subscribes from now on; messages go into the journal too, without which the run continues where it cannot begin.
    pub fn open(
        hub: &Hub,
        journal: Option<&JournalOptions>,
        place: &Place,
    ) -> Result<Self, OpenError> {
        let warn = |error: &io::Error| {
            tracing::warn!(
                "no journal is kept ({error}); if this process is killed, the run is lost"
            );
        };
        let journal =
            journal.and_then(|options| Journal::begin(options, place).inspect_err(warn).ok());
        let keyframes = journal.is_some().then(|| KeyframeFeed::open(hub)).transpose()?;
        Ok(Self {
            poses: hub.subscriber(&POSE)?,
            steps: hub.subscriber(&STEP)?,
            adjustments: hub.subscriber(&ADJUSTMENT)?,
            recording: Recording::default(),
            last_step: None,
            loaded_map: None,
            journal,
            keyframes,
        })
    }

    /// Wakes with every pose.
    pub fn events(&self) -> &Events {
        self.poses.events()
    }

    /// Takes in everything that has arrived; returns whether anything had.
    pub fn collect(&mut self) -> Result<bool, ReceiveError> {
        let before = self.recording.num_poses() + self.recording.num_steps();
        while let Some(message) = self.poses.receive()? {
            let Some(pose) = message.payload().first() else { continue };
            match self.recording.add_pose(pose) {
                Err(error) => tracing::warn!("tracker/pose: {error}"),
                Ok(()) => self.keep(|| Record::Pose(Box::new(*pose))),
            }
        }
        while let Some(message) = self.steps.receive()? {
            let Some(step) = message.payload().first() else { continue };
            let StepMessage { step_nanos, change_nanos, start_frame, .. } = *step;
            self.recording.add_step(step_nanos, change_nanos, start_frame);
            self.keep(|| Record::Step(Step { step_nanos, change_nanos, start_frame }));
            self.last_step = Some(*step);
        }
        while let Some(message) = self.adjustments.receive()? {
            let Some(adjustment) = message.payload().first() else { continue };
            match adjustment_from_message(adjustment) {
                Err(error) => tracing::warn!("mapper/adjustment: {error}"),
                Ok(record) => {
                    self.recording.add_adjustment(record);
                    self.keep(|| Record::Adjustment(*adjustment));
                }
            }
        }
        self.collect_keyframes(false);
        if let Some(journal) = &self.journal {
            self.recording.release(journal.poses_on_disk());
        }
        Ok(self.recording.num_poses() + self.recording.num_steps() > before)
    }

    /// Gives the journal the keyframes that have arrived. Without them the run continues, and what is left of it after
    /// a kill has no depth: worth a warning, not the end of a run.
    fn collect_keyframes(&mut self, is_end: bool) {
        let (Some(journal), Some(keyframes)) = (&mut self.journal, &mut self.keyframes) else {
            return;
        };
        if let Err(error) = keyframes.collect(journal, is_end) {
            tracing::warn!("no further keyframes are journalled: {error}");
            self.keyframes = None;
        }
    }

    fn keep(&mut self, record: impl FnOnce() -> Record) {
        if let Some(journal) = &mut self.journal {
            journal.append(&record());
        }
    }

    /// Writes the map that the mapper has switched to into the journal, unless it is there.
    pub fn note_loaded_map(&mut self, loaded: Option<LoadedMap>) {
        if let Some(map) = loaded.filter(|map| self.loaded_map.as_ref() != Some(map)) {
            self.keep(|| Record::LoadedMap(Box::new(map.clone())));
            self.loaded_map = Some(map);
        }
    }

    /// Whether the counters are due in the journal.
    pub fn wants_counters(&self) -> bool {
        self.journal.as_ref().is_some_and(Journal::wants_counters)
    }

    /// Writes the counters so far to the journal.
    pub fn count(&mut self, counters: RunCounters) {
        if let Some(journal) = &mut self.journal {
            journal.count(counters);
        }
    }

    /// Completes the map of a mapper that died during the run, or that provided none, from the journal, with at most
    /// `max_bytes` of depth.
    pub fn complete_map(&mut self, map: &mut Map, max_bytes: u64) {
        self.collect_keyframes(true);
        if let Some(journal) = &mut self.journal {
            complete(map, journal.map(max_bytes));
            map.forget_depth_beyond(usize::try_from(max_bytes).unwrap_or(usize::MAX));
        }
    }

    /// Takes back the poses that only the journal has; returns how many cannot be read and are lost.
    pub fn read_back_poses(&mut self) -> usize {
        let num_released = self.recording.num_released();
        let Some(journal) = self.journal.as_ref().filter(|_| num_released > 0) else { return 0 };
        let missing =
            self.recording.restore_released(|take| journal.read_poses(num_released, take));
        if missing > 0 {
            let folder = journal.folder().display();
            tracing::warn!("{folder}: {missing} of {num_released} poses cannot be read back");
        }
        missing
    }

    /// The record of the whole run, after [`Recorder::read_back_poses`], and its complete journal.
    pub fn into_record(
        mut self,
        known: RunRecord,
        deadline_ms: f64,
    ) -> (RunRecord, Option<Journal>) {
        self.count(known.counters);
        self.collect_keyframes(true);
        (self.recording.into_record(known, deadline_ms), self.journal)
    }
}
