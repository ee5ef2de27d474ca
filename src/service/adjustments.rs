//! Joint estimation of keyframes on a separate thread while frames continue: what is handed over, when a result enters
//! the map, and what is counted.
//!
//! One estimate is in flight at a time. Keyframes added meanwhile wait for the next one, which takes in all of them.

pub mod message;
mod thread;

use std::io;
use std::os::fd::BorrowedFd;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use crate::service::adjustments::thread::{AdjustmentThread, Optimise};
use crate::service::schedule::Background;
use crate::slam::keyframe::MapState;
use crate::slam::loops::SearchReport;
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::window::{Adjustment, Window};

/// Live: longest wait for estimates after the last frame, twenty times their duration.
const LAST_ADJUSTMENTS: Duration = Duration::from_secs(5);

/// When an estimate enters the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Entry {
    /// After this many frames, waiting for it if need be: the same map in every run.
    AfterFrames(u64),
    /// Between two frames as soon as it is ready. No frame waits.
    WhenReady,
}

/// The outcome of an estimate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// It entered the map.
    Entered,
    /// It entered a map that had gained a keyframe meanwhile, which moved along.
    Merged,
    /// The map had changed too much for it to apply.
    Dropped,
}

/// A finished estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdjustmentRecord {
    /// Sequence of the last frame before it entered.
    pub sequence: u64,
    /// Frames from its start until then.
    pub frames: u64,
    /// CPU time it took, nanoseconds.
    pub nanos: u64,
    /// Its outcome.
    pub fate: Fate,
    /// Its result.
    pub adjustment: Adjustment,
}

/// A finished search for a place that was seen before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchRecord {
    /// Sequence of the last frame before it finished.
    pub sequence: u64,
    /// CPU time it took, nanoseconds.
    pub nanos: u64,
    /// Its result.
    pub report: SearchReport,
}

/// The estimate in flight, and the state of the map it was taken from.
#[derive(Debug, Clone, Copy)]
struct InFlight {
    /// Frames counted when it began.
    began: u64,
    epoch: u32,
    map_revision: u64,
    newest: Option<u64>,
    /// Whether it began after the last frame.
    is_last: bool,
    /// Whether the mapper it was taken from has been replaced.
    is_orphan: bool,
}

/// The joint estimation of a mapper's keyframes.
pub struct Adjustments {
    entry: Entry,
    /// `None` where joint estimation is switched off or has failed.
    thread: Option<AdjustmentThread>,
    in_flight: Option<InFlight>,
    /// Frames so far, and the sequence of the last.
    frames: u64,
    sequence: u64,
    records: Vec<AdjustmentRecord>,
    searches: Vec<SearchRecord>,
    failure: Option<String>,
}

impl Adjustments {
    /// Starts the thread.
    pub fn start(entry: Entry, background: Background) -> io::Result<Self> {
        Self::start_with(entry, background, Box::new(Window::optimise))
    }

    fn start_with(entry: Entry, background: Background, optimise: Optimise) -> io::Result<Self> {
        let thread = Some(AdjustmentThread::start(background, optimise)?);
        Ok(Self {
            entry,
            thread,
            in_flight: None,
            frames: 0,
            sequence: 0,
            records: Vec::new(),
            searches: Vec::new(),
            failure: None,
        })
    }

    /// Readable when an estimate is ready: then call [`Adjustments::apply_ready`]. `None` where that lets nothing in,
    /// as a wait on it would return at once over and over.
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        let thread = self.thread.as_ref().filter(|_| self.entry == Entry::WhenReady);
        thread.map(AdjustmentThread::descriptor)
    }

    /// Takes the estimates that finished since the last call.
    pub fn take_records(&mut self) -> impl Iterator<Item = AdjustmentRecord> {
        std::mem::take(&mut self.records).into_iter()
    }

    /// Takes the searches for loops that finished since the last call.
    pub fn take_searches(&mut self) -> impl Iterator<Item = SearchRecord> {
        std::mem::take(&mut self.searches).into_iter()
    }

    /// Takes the reason why joint estimation stopped; `None` while it runs, and once the reason was taken.
    pub fn take_failure(&mut self) -> Option<String> {
        self.failure.take()
    }

    /// After each frame of the mapper, with its keyframe finished: lets in what is due, hands over what is new. Returns
    /// what is to be published.
    pub fn after_frame(&mut self, mapper: &mut Mapper, sequence: u64) -> StepOutcome {
        self.frames += 1;
        self.sequence = sequence;
        let before = self.apply_due(mapper);
        self.begin(mapper);
        // With a delay of 0 frames an estimate is due with its own frame.
        merged_outcome(before, self.apply_due(mapper))
    }

    /// Between two frames: lets in what is ready, unless it enters at a fixed frame.
    pub fn apply_ready(&mut self, mapper: &mut Mapper) -> StepOutcome {
        match self.entry {
            Entry::AfterFrames(_) => StepOutcome::default(),
            Entry::WhenReady => {
                let outcome = self.apply_due(mapper);
                self.begin(mapper);
                outcome
            }
        }
    }

    /// After the last frame: lets in the estimate in flight, estimates all keyframes once more, realigns the last
    /// frames and refines the keyframes' depth. Waits for it; live, where other work may hold the CPU, not for long.
    pub fn finish(&mut self, mapper: &mut Mapper) -> StepOutcome {
        let is_live = self.entry == Entry::WhenReady;
        let deadline = is_live.then(|| Instant::now() + LAST_ADJUSTMENTS);
        let left =
            || deadline.map_or(Duration::MAX, |end| end.saturating_duration_since(Instant::now()));
        let (_, mut outcome) = self.take_in(mapper, left());
        while !left().is_zero() {
            self.begin_with(mapper, true, Mapper::begin_last_search);
            let (fate, closed) = self.take_in(mapper, left());
            outcome = merged_outcome(outcome, closed);
            // One that cannot enter would be solved again and again.
            if fate.is_none_or(|fate| fate == Fate::Dropped) {
                break;
            }
        }
        self.begin_with(mapper, true, Mapper::begin_last_adjustment);
        outcome = merged_outcome(outcome, self.take_in(mapper, left()).1);
        while !left().is_zero() && mapper.refine_depth() {
            outcome.graph_changed = true;
        }
        mapper.store_confirmed_points();
        outcome
    }

    /// The mapper is replaced by one for another camera: the estimate in flight is of no use to it.
    pub fn abandon(&mut self) {
        self.in_flight.iter_mut().for_each(|in_flight| in_flight.is_orphan = true);
    }

    /// Hands over what is new, unless an estimate is in flight.
    fn begin(&mut self, mapper: &mut Mapper) {
        // In lockstep and replay depth is refined after the last frame, with the final poses.
        let may_refine = self.entry == Entry::WhenReady;
        self.begin_with(mapper, false, |mapper| mapper.begin_adjustment(may_refine));
    }

    fn begin_with(
        &mut self,
        mapper: &mut Mapper,
        is_last: bool,
        begin: impl FnOnce(&mut Mapper) -> Option<Box<Window>>,
    ) {
        let (None, Some(thread)) = (self.in_flight, &self.thread) else { return };
        let Some(window) = begin(mapper) else { return };
        self.in_flight = Some(InFlight {
            began: self.frames,
            epoch: mapper.keyframe().map_or(0, |keyframe| keyframe.epoch),
            map_revision: mapper.map().revision,
            newest: newest(mapper),
            is_last,
            is_orphan: false,
        });
        thread.hand_over(window);
    }

    /// Lets in what is due.
    fn apply_due(&mut self, mapper: &mut Mapper) -> StepOutcome {
        let timeout = match (self.entry, &self.in_flight) {
            (Entry::AfterFrames(frames), Some(in_flight))
                if self.frames < in_flight.began.saturating_add(frames) =>
            {
                return StepOutcome::default();
            }
            (Entry::AfterFrames(_), _) => Duration::MAX,
            (Entry::WhenReady, _) => Duration::ZERO,
        };
        self.take_in(mapper, timeout).1
    }

    /// Lets in the estimate in flight if it comes back within `timeout`; its fate is `None` if it did not.
    fn take_in(&mut self, mapper: &mut Mapper, timeout: Duration) -> (Option<Fate>, StepOutcome) {
        let (Some(in_flight), Some(thread)) = (self.in_flight, &self.thread) else {
            return Default::default();
        };
        let mut finished = match thread.wait_at_most(timeout) {
            Ok(finished) => finished,
            Err(RecvTimeoutError::Timeout) => return Default::default(),
            Err(RecvTimeoutError::Disconnected) => {
                self.give_up();
                return Default::default();
            }
        };
        self.in_flight = None;
        let fate = fate(mapper, &in_flight);
        if let Some(report) = finished.window.loops.take_report() {
            let (sequence, nanos) = (self.sequence, finished.nanos);
            self.searches.push(SearchRecord { sequence, nanos, report });
        }
        if let Some(adjustment) = finished.adjustment {
            let frames = self.frames.saturating_sub(in_flight.began);
            let (sequence, nanos) = (self.sequence, finished.nanos);
            self.records.push(AdjustmentRecord { sequence, frames, nanos, fate, adjustment });
        }
        let outcome = match fate {
            _ if in_flight.is_orphan => StepOutcome::default(),
            Fate::Dropped => {
                mapper.drop_adjustment(finished.window);
                StepOutcome::default()
            }
            Fate::Entered | Fate::Merged => mapper.end_adjustment(finished.window),
        };
        (Some(fate), outcome)
    }

    /// The thread has panicked: keyframes are no longer estimated jointly.
    fn give_up(&mut self) {
        self.in_flight = None;
        let message = self.thread.take().map(AdjustmentThread::panic_message).unwrap_or_default();
        let failure = format!(
            "the joint estimation of keyframes has failed ({message}); mapping continues without it, and drifts more: please report this"
        );
        tracing::error!("{failure}");
        self.failure = Some(failure);
    }
}

fn newest(mapper: &Mapper) -> Option<u64> {
    mapper.map().keyframes.last().map(|keyframe| keyframe.keyframe_id)
}

/// The fate of an estimate, given the current map.
fn fate(mapper: &Mapper, in_flight: &InFlight) -> Fate {
    let is_same_map = mapper.keyframe().is_some_and(|active| {
        active.epoch == in_flight.epoch
            // After the last frame its keyframes are estimated whatever became of the active one.
            && (in_flight.is_last || active.map_state == MapState::Established)
            // Otherwise another correction has moved its keyframes.
            && mapper.map().revision == in_flight.map_revision
    });
    match (is_same_map && !in_flight.is_orphan, newest(mapper) == in_flight.newest) {
        (false, _) => Fate::Dropped,
        (true, false) => Fate::Merged,
        (true, true) => Fate::Entered,
    }
}

/// What is to be published after both steps.
fn merged_outcome(one: StepOutcome, other: StepOutcome) -> StepOutcome {
    StepOutcome {
        keyframe_created: one.keyframe_created || other.keyframe_created,
        keyframe_restored: one.keyframe_restored || other.keyframe_restored,
        keyframe_changed: one.keyframe_changed || other.keyframe_changed,
        graph_changed: one.graph_changed || other.graph_changed,
        ..one
    }
}

#[cfg(test)]
mod pass_tests;
#[cfg(test)]
mod refinement_tests;
#[cfg(test)]
pub(in crate::service) mod tests;
