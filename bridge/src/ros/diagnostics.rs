//! Health of a process as ROS's diagnostics.

use semidense::service::health::{ProcessState, cause, percentile_ms, source, warning};
use semidense::slam::pose::TrackingState;
use semidense::wire::message::HealthMessage;

use crate::ros::message::{DiagnosticArray, DiagnosticStatus, Header, KeyValue};

const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;
const STALE: u8 = 3;

/// How bad the states are that a last frame came to, by their codes in [`HealthMessage::detail`].
const FRAME_LEVELS: [u8; 4] = [WARN, OK, WARN, ERROR];

/// The health of the process `owner` (capture, tracker or mapper) of `instance`.
pub fn diagnostics(
    instance: &str,
    owner: &str,
    health: &HealthMessage,
    header: Header,
) -> DiagnosticArray {
    let (level, message) = verdict(owner, health);
    let status = DiagnosticStatus {
        level,
        name: format!("{instance}: {owner}"),
        message,
        hardware_id: instance.to_owned(),
        values: figures(owner, health),
    };
    DiagnosticArray { header, status: vec![status] }
}

/// How bad it is, and what it is, in a few words.
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

/// The figures of a process; NaN and what is unknown are left out.
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
    let value = |key: &str, value: String| KeyValue { key: key.to_owned(), value };
    let mut values: Vec<KeyValue> =
        counts.iter().map(|(key, count)| value(key, count.to_string())).collect();
    values.push(value(total, health.total.to_string()));
    let known = numbers.iter().filter_map(|(key, number)| Some((key, (*number)?)));
    values.extend(
        known
            .filter(|(_, number)| number.is_finite())
            .map(|(key, number)| value(key, format!("{number:.3}"))),
    );
    let from = source(health);
    if !from.is_empty() {
        values.push(value("source", from));
    }
    values
}
