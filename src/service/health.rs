//! The health of a process: state, counters and latencies, published once a second and on change.

use crate::service::adjustments::{AdjustmentRecord, Fate};
use crate::service::clock::now_nanos;
use crate::service::manager_notice::ManagerNotice;
use crate::service::schedule::{Policy, Refusal, active_scheduling, peak_rss_bytes};
use crate::slam::loops::SearchOutcome;
use crate::wire::command::{text_bytes, text_from_bytes};
use crate::wire::message::{HISTOGRAM_BUCKETS, HealthMessage, TEXT_BYTES};
use crate::wire::port::{Hub, OpenError, Publisher};
use crate::wire::topic::Topic;

/// Time between two reports when nothing changes.
const REPORT_PERIOD_NANOS: i64 = 1_000_000_000;
/// Time between two progress reports: smooth to the eye, negligible for the machine.
const PROGRESS_PERIOD_NANOS: i64 = 100_000_000;

/// Shortest time between two reports of rare events: they are sent at once, so that a kill loses none, but a process
/// that counts one with every frame must not spend more time on reports than on work.
const EVENT_PERIOD_NANOS: i64 = 10_000_000;

/// What a process is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProcessState {
    /// It opens its ports and its input.
    Starting,
    /// It completes what must precede the first frame.
    Preparing,
    /// It waits for the first frame.
    Ready,
    /// It works.
    Running,
    /// Its input has ended.
    Finished,
    /// It cannot continue.
    Failed,
    /// It works, but its input has stopped.
    Stale,
}

impl ProcessState {
    const ALL: [(Self, u32, &'static str); 7] = [
        (Self::Starting, 0, "starting"),
        (Self::Preparing, 1, "preparing"),
        (Self::Ready, 2, "ready"),
        (Self::Running, 3, "running"),
        (Self::Finished, 4, "finished"),
        (Self::Failed, 5, "failed"),
        (Self::Stale, 6, "stale"),
    ];

    /// The state of a code; `None` for an invalid code.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.iter().find(|(_, c, _)| *c == code).map(|(state, ..)| *state)
    }

    /// Its code in [`HealthMessage`].
    pub fn code(self) -> u32 {
        self as u32
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        Self::ALL[self as usize].2
    }
}

/// The bucket of a latency: half octaves from 1 µs, the last holds everything from 12 s.
pub fn bucket(nanos: u64) -> usize {
    let micros = nanos / 1000;
    if micros == 0 {
        return 0;
    }
    let octave = micros.ilog2() as usize;
    // The upper half octave starts at 2^(octave + ½).
    let upper = u128::from(micros) * u128::from(micros) >= 1_u128 << (2 * octave + 1);
    (2 * octave + usize::from(upper)).min(HISTOGRAM_BUCKETS - 1)
}

/// The latency in milliseconds that `share` (0 to 1) of the counted ones do not exceed, assuming an even spread over
/// their bucket: accurate to a few percent where many fell into it, never beyond its end. `None` where nothing was
/// counted.
pub fn percentile_ms(counts: &[u64; HISTOGRAM_BUCKETS], share: f64) -> Option<f64> {
    let total: u64 = counts.iter().fold(0, |sum, &count| sum.saturating_add(count));
    let wanted = (share * total as f64).ceil().max(1.0);
    let mut below = 0_u64;
    for (index, &count) in counts.iter().enumerate() {
        let with = below.saturating_add(count);
        if count > 0 && with as f64 >= wanted {
            let begin = if index == 0 { 0.0 } else { bucket_end_ms(index - 1) };
            let part = ((wanted - below as f64) / count as f64).clamp(0.0, 1.0);
            return Some(begin + part * (bucket_end_ms(index) - begin));
        }
        below = with;
    }
    None
}

/// Mean of the counted latencies, milliseconds, each at the middle of its bucket. `None` where nothing was counted.
pub fn mean_ms(counts: &[u64; HISTOGRAM_BUCKETS]) -> Option<f64> {
    let begin = |index: usize| if index == 0 { 0.0 } else { bucket_end_ms(index - 1) };
    let middle = |index: usize| 0.5 * (begin(index) + bucket_end_ms(index));
    let sum: f64 =
        counts.iter().enumerate().map(|(index, &count)| count as f64 * middle(index)).sum();
    let total: f64 = counts.iter().map(|&count| count as f64).sum();
    (total > 0.0).then_some(sum / total)
}

/// End of a bucket, milliseconds.
pub fn bucket_end_ms(index: usize) -> f64 {
    f64::powf(2.0, (index as f64 + 1.0) / 2.0) / 1000.0
}

/// Why a process is in its state, as text.
pub fn cause(message: &HealthMessage) -> String {
    text_from_bytes(&message.cause, message.cause_bytes)
}

/// Source of the frames, as text; empty except for capture.
pub fn source(message: &HealthMessage) -> String {
    text_from_bytes(&message.source, message.source_bytes)
}

/// What the system refused, as text; empty where nothing was.
pub fn warning(message: &HealthMessage) -> String {
    text_from_bytes(&message.warning, message.warning_bytes)
}

/// Policies and their names, in the order of their codes in [`HealthMessage`]; a larger code is an unknown one.
const POLICIES: [(Policy, &str); 3] =
    [(Policy::Other, "other"), (Policy::Fifo, "fifo"), (Policy::Deadline, "deadline")];

/// The code of a policy in [`HealthMessage`].
fn scheduling_code(policy: Option<Policy>) -> u32 {
    let known = POLICIES.iter().position(|(of, _)| Some(*of) == policy);
    known.unwrap_or(POLICIES.len()) as u32
}

/// Name of a policy from its code.
pub fn scheduling_name(code: u32) -> &'static str {
    POLICIES.get(code as usize).map_or("unknown", |(_, name)| name)
}

/// A state with its cause and the length of that in bytes, as a process reported it.
pub type StateAndCause = (u32, [u8; TEXT_BYTES], u32);

/// Counts, and publishes when due: to subscribers and to the service manager.
#[derive(Debug)]
pub struct Health {
    publisher: Publisher<HealthMessage, ()>,
    message: HealthMessage,
    changed: bool,
    notice: ManagerNotice,
    /// Frames counted when the rate was last computed, and the time of that.
    rated: (u64, i64),
    /// Rare events in the last report.
    told_events: u64,
}

impl Health {
    /// Opens the topic and reports [`ProcessState::Starting`].
    pub fn open(hub: &Hub, topic: &Topic) -> Result<Self, OpenError> {
        let message = HealthMessage {
            started_nanos: now_nanos(),
            process_id: std::process::id(),
            state: ProcessState::Starting.code(),
            scheduling: scheduling_code(None),
            ..HealthMessage::empty()
        };
        let publisher = hub.publisher(topic, 1)?;
        let notice = ManagerNotice::from_environment();
        let rated = (0, message.started_nanos);
        let told_events = 0;
        let mut health = Self { publisher, message, changed: true, notice, rated, told_events };
        health.report();
        Ok(health)
    }

    /// The counters, to be incremented.
    pub fn counters(&mut self) -> &mut HealthMessage {
        &mut self.message
    }

    /// Sets the source of the frames; it is sent with the next report.
    pub fn set_source(&mut self, name: &str) {
        (self.message.source, self.message.source_bytes) = text_bytes(name);
    }

    /// Counts one latency.
    pub fn count_latency(&mut self, nanos: u64) {
        self.message.latency_counts[bucket(nanos)] += 1;
    }

    /// Counts the time that the work on a frame took.
    pub fn count_work(&mut self, nanos: u64) {
        self.message.work_counts[bucket(nanos)] += 1;
    }

    /// Counts the time from the sending of a frame to its pick-up.
    pub fn count_wake(&mut self, nanos: u64) {
        self.message.wake_counts[bucket(nanos)] += 1;
    }

    /// Counts a joint estimate of keyframes.
    pub fn count_adjustment(&mut self, record: &AdjustmentRecord) {
        self.message.adjustment_counts[bucket(record.nanos)] += 1;
        match record.fate {
            Fate::Entered | Fate::Merged => self.message.adjustments += 1,
            Fate::Dropped => self.message.adjustments_dropped += 1,
        }
        self.message.adjustments_merged += u64::from(record.fate == Fate::Merged);
    }

    /// Counts a search for loops; one that proposes a loop continues.
    pub fn count_search(&mut self, fate: &SearchOutcome) {
        let of = &mut self.message;
        let count = match fate {
            SearchOutcome::Proposed => return,
            SearchOutcome::Closed => &mut of.loops_closed,
            SearchOutcome::AlreadyConsistent => &mut of.loops_held,
            SearchOutcome::Joined => &mut of.epochs_joined,
            SearchOutcome::Refused(_) => &mut of.loops_refused,
            SearchOutcome::AgainstDrift(_) => &mut of.loops_against_drift,
            SearchOutcome::Unconfirmed => &mut of.loops_unconfirmed,
            SearchOutcome::Inconsistent => &mut of.loops_inconsistent,
        };
        *count += 1;
        of.loop_searches += 1;
    }

    /// Reports what the process does without from now on.
    pub fn warn(&mut self, warning: &str) {
        (self.message.warning, self.message.warning_bytes) = text_bytes(warning);
        self.changed = true;
        self.report();
    }

    /// Reports the scheduling in force for the calling thread, and the first refusal as text.
    pub fn report_scheduling(&mut self, refusals: &[Refusal]) {
        let active_scheduling = active_scheduling();
        self.message.scheduling = scheduling_code(active_scheduling.policy);
        self.message.priority = active_scheduling.priority;
        self.message.memory_locked = u32::from(active_scheduling.memory_locked);
        self.warn(&refusals.first().map(Refusal::to_string).unwrap_or_default());
    }

    /// Enters a state and reports it at once.
    pub fn enter(&mut self, state: ProcessState, cause: &str) {
        let (cause, cause_bytes) = text_bytes(cause);
        self.restore_state((state.code(), cause, cause_bytes));
    }

    /// Reports how the process ended: in order, for this cause, or with an error.
    pub fn end(&mut self, outcome: &Result<(), impl std::fmt::Display>, cause: &str) {
        match outcome {
            Ok(()) => self.enter(ProcessState::Finished, cause),
            Err(error) => self.enter(ProcessState::Failed, &error.to_string()),
        }
    }

    /// The state that was entered last.
    pub fn current_state(&self) -> StateAndCause {
        let HealthMessage { state, cause, cause_bytes, .. } = self.message;
        (state, cause, cause_bytes)
    }

    /// Enters a state obtained from [`Health::current_state`].
    pub fn restore_state(&mut self, wanted: StateAndCause) {
        if wanted == self.current_state() {
            return;
        }
        (self.message.state, self.message.cause, self.message.cause_bytes) = wanted;
        self.changed = true;
        self.report();
    }

    /// Tells the service manager that everything is open and read and that the process now does its work.
    pub fn notify_ready(&mut self) {
        self.notice.ready();
    }

    /// Reports how much of the preparation is done.
    pub fn progress(&mut self, done: usize, total: usize) {
        (self.message.progress_done, self.message.progress_total) = (done as u64, total as u64);
        let due = now_nanos() - self.message.published_nanos >= PROGRESS_PERIOD_NANOS;
        self.changed |= due || done == total;
        if due {
            self.notice.extend_start();
        }
        self.report();
    }

    /// Publishes when something changed or a second has passed, and serves late subscribers. The frame loop calls it on
    /// every turn, so that it is also the loop's heartbeat.
    pub fn report(&mut self) {
        self.publisher.serve_late_joiners();
        let now = now_nanos();
        self.notice.beat(now);
        let since = now - self.message.published_nanos;
        let events = events(&self.message);
        let is_due = since >= REPORT_PERIOD_NANOS
            || (events != self.told_events && since >= EVENT_PERIOD_NANOS);
        if !self.changed && !is_due {
            return;
        }
        self.told_events = events;
        self.message.published_nanos = now;
        self.message.peak_rss_bytes = peak_rss_bytes().unwrap_or(0);
        self.take_rate(now);
        self.changed = false;
        if let Err(error) = self.publisher.send((), &[self.message]) {
            tracing::warn!("{error}");
        }
        self.notify_status();
    }

    /// Computes the frames per second since the last computation, once that is a second ago.
    fn take_rate(&mut self, now: i64) {
        let (frames, since) = self.rated;
        if now - since >= REPORT_PERIOD_NANOS {
            let secs = (now - since) as f64 * 1e-9;
            self.message.rate_hz = self.message.frames.saturating_sub(frames) as f64 / secs;
            self.rated = (self.message.frames, now);
        }
    }

    /// Sends the state, its cause and the figures to the service manager as one line.
    fn notify_status(&mut self) {
        let state = ProcessState::from_code(self.message.state).unwrap_or(ProcessState::Failed);
        if matches!(state, ProcessState::Finished | ProcessState::Failed) {
            self.notice.stopping();
        }
        let length = (self.message.cause_bytes as usize).min(TEXT_BYTES);
        // Our own text, cut at a character boundary.
        let cause = str::from_utf8(&self.message.cause[..length]).unwrap_or_default();
        let separator = if cause.is_empty() { "" } else { ": " };
        // The rate is unknown until the first second has passed.
        let (name, rate_hz) = (state.name(), self.message.rate_hz.max(0.0));
        let HealthMessage { frames, deadline_misses, refused, .. } = self.message;
        self.notice.status(format_args!(
            "{name}{separator}{cause} ({rate_hz:.1} frames/s, {frames} frames, {deadline_misses} late, {refused} refused)"
        ));
    }
}

/// Sum of the rare events, which must not be lost with a process that is killed.
fn events(message: &HealthMessage) -> u64 {
    let counts = [
        message.dropped,
        message.gaps,
        message.refused,
        message.disordered,
        message.resized,
        message.deadline_misses,
        message.page_faults,
    ];
    counts.iter().fold(0, |sum, count| sum.wrapping_add(*count))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::place::Place;
    use crate::wire::port::{Access, Subscriber};
    use crate::wire::topic::TRACKER_HEALTH;

    #[test]
    fn codes_of_policies_are_those_that_other_programs_know() {
        let codes = [
            (Some(Policy::Other), 0, "other"),
            (Some(Policy::Fifo), 1, "fifo"),
            (Some(Policy::Deadline), 2, "deadline"),
            (Some(Policy::Inherit), 3, "unknown"),
            (None, 3, "unknown"),
        ];
        for (policy, code, name) in codes {
            assert_eq!((scheduling_code(policy), scheduling_name(code)), (code, name));
        }
    }

    #[test]
    fn buckets_are_half_octaves() {
        assert_eq!(bucket(0), 0);
        assert_eq!(bucket(1_000), 0);
        assert_eq!(bucket(2_000), 2);
        assert_eq!(bucket(3_000), 3, "3 µs is above 2^1.5");
        assert_eq!(bucket(1_024_000), 20);
        assert_eq!(bucket(u64::MAX), HISTOGRAM_BUCKETS - 1);
    }

    #[test]
    fn percentiles_lie_within_their_bucket() {
        let mut counts = [0; HISTOGRAM_BUCKETS];
        assert_eq!(percentile_ms(&counts, 0.5), None);
        for micros in 1..=1000_u64 {
            counts[bucket(micros * 1000)] += 1;
        }
        for (share, truth) in [(0.1, 0.1), (0.5, 0.5), (0.6, 0.6), (0.9, 0.9), (1.0, 1.0)] {
            let estimate = percentile_ms(&counts, share).unwrap();
            assert!((estimate / truth - 1.0).abs() < 0.03, "{share}: {estimate}");
        }
        let one = std::array::from_fn(|i| u64::from(i == 20));
        assert_eq!(
            percentile_ms(&one, 0.5),
            Some(bucket_end_ms(20)),
            "one latency is not below itself"
        );
        assert!(percentile_ms(&[u64::MAX; HISTOGRAM_BUCKETS], 0.5).is_some());
    }

    #[test]
    fn a_rare_event_is_reported_before_the_next_second() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let hub = Hub::join(&place, "tracker", Access::Member).unwrap();
        let heard: Subscriber<HealthMessage, ()> = hub.subscriber(&TRACKER_HEALTH).unwrap();
        let mut health = Health::open(&hub, &TRACKER_HEALTH).unwrap();
        while heard.receive().unwrap().is_some() {}
        health.counters().deadline_misses += 1;
        health.message.published_nanos = now_nanos() - 2 * EVENT_PERIOD_NANOS;
        health.report();
        let report = heard.receive().unwrap().map(|message| message.payload()[0]);
        assert_eq!(report.map(|report| report.deadline_misses), Some(1));
    }

    #[test]
    fn searches_for_loops_are_counted_by_their_fate() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let hub = Hub::join(&place, "tracker", Access::Member).unwrap();
        let mut health = Health::open(&hub, &TRACKER_HEALTH).unwrap();
        let fates = [
            SearchOutcome::Proposed,
            SearchOutcome::Closed,
            SearchOutcome::AlreadyConsistent,
            SearchOutcome::AlreadyConsistent,
            SearchOutcome::AgainstDrift(99.0),
        ];
        fates.iter().for_each(|fate| health.count_search(fate));
        let of = &health.message;
        let counts = [of.loop_searches, of.loops_closed, of.loops_held, of.loops_against_drift];
        assert_eq!(counts, [4, 1, 2, 1]);
        assert_eq!((of.epochs_joined, of.loops_refused, of.loops_unconfirmed), (0, 0, 0));
    }

    #[test]
    fn states_have_their_codes() {
        for (state, code, name) in ProcessState::ALL {
            assert_eq!((state.code(), state.name()), (code, name));
            assert_eq!(ProcessState::from_code(code), Some(state));
        }
        assert_eq!(ProcessState::from_code(7), None);
    }
}
