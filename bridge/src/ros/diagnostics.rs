//! Health of a process as ROS diagnostics.

use semidense::service::health::{ProcessState, cause, percentile_ms, source, warning};
use semidense::slam::pose::TrackingState;
use semidense::wire::message::HealthMessage;

use crate::ros::message::{DiagnosticArray, DiagnosticStatus, Header, KeyValue, Time};

const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;
const STALE: u8 = 3;

/// Severity of the tracking status of the last frame, by its code in [`HealthMessage::detail`].
const FRAME_LEVELS: [u8; 4] = [WARN, OK, WARN, ERROR];

/// A report on one part of `instance`: its level and state in words, and figures.
pub fn report(
    instance: &str,
    part: &str,
    stamp: Time,
    (level, message): (u8, String),
    values: Vec<KeyValue>,
) -> DiagnosticArray {
    let name = format!("{instance}: {part}");
    let status =
        DiagnosticStatus { level, name, message, hardware_id: instance.to_owned(), values };
    DiagnosticArray { header: Header::new(stamp, ""), status: vec![status] }
}

/// A key and value of a report.
pub fn figure(key: &str, value: impl ToString) -> KeyValue {
    KeyValue { key: key.to_owned(), value: value.to_string() }
}

/// The health of the process `owner` (capture, tracker or mapper) of `instance`.
pub fn diagnostics(
    instance: &str,
    owner: &str,
    health: &HealthMessage,
    stamp: Time,
) -> DiagnosticArray {
    report(instance, owner, stamp, verdict(owner, health), figures(owner, health))
}

/// Severity and state in a few words.
fn verdict(owner: &str, health: &HealthMessage) -> (u8, String) {
    let state = ProcessState::from_code(health.state);
    let (mut level, mut words) = match state {
        Some(state @ ProcessState::Failed) => (ERROR, state.name().to_owned()),
        Some(state @ ProcessState::Stale) => (STALE, state.name().to_owned()),
        Some(state) => (OK, state.name().to_owned()),
        None => (ERROR, format!("unknown state {}", health.state)),
    };
    let last_frame = health.detail as usize;
    if let (Some(ProcessState::Running), "tracker", Some(frame_level)) =
        (state, owner, FRAME_LEVELS.get(last_frame))
    {
        (level, words) = (*frame_level, TrackingState::NAMES[last_frame].to_owned());
    }
    let warned = warning(health);
    if level == OK && !warned.is_empty() {
        level = WARN;
    }
    for more in [cause(health), warned].into_iter().filter(|more| !more.is_empty()) {
        words = format!("{words}: {more}");
    }
    (level, words)
}

/// The figures of a process; NaN and unknown values are left out.
fn figures(owner: &str, health: &HealthMessage) -> Vec<KeyValue> {
    let counts = [
        ("frames", health.frames),
        ("dropped", health.dropped),
        ("gaps", health.gaps),
        ("refused", health.refused),
        ("disordered", health.disordered),
        ("resized", health.resized),
        ("deadline_misses", health.deadline_misses),
        ("page_faults", health.page_faults),
        ("peak_rss_bytes", health.peak_rss_bytes),
        ("process_id", u64::from(health.process_id)),
    ];
    let total = if owner == "mapper" { "keyframes" } else { "frames_total" };
    let latency = |share| percentile_ms(&health.latency_counts, share);
    let numbers = [
        ("rate_hz", Some(health.rate_hz)),
        ("latency_p50_ms", latency(0.5)),
        ("latency_p99_ms", latency(0.99)),
    ];
    let mut values: Vec<KeyValue> = counts.iter().map(|(key, count)| figure(key, count)).collect();
    values.push(figure(total, health.total));
    let known = numbers.into_iter().filter_map(|(key, number)| Some((key, number?)));
    let finite = known.filter(|(_, number)| number.is_finite());
    values.extend(finite.map(|(key, number)| figure(key, format!("{number:.3}"))));
    let from = source(health);
    if !from.is_empty() {
        values.push(figure("source", from));
    }
    values
}
