//! `/metrics`: health and poses as OpenMetrics text, for Prometheus.

use std::fmt::Write;

use semidense::service::clock::now_nanos;
use semidense::service::health::{ProcessState, bucket_end_ms, source};
use semidense::slam::pose::TrackingState;
use semidense::wire::message::{HISTOGRAM_BUCKETS, HealthMessage};

use crate::web::scene::State;

/// Content type of the text.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Number of process states.
const PROCESS_STATES: u32 = 7;

/// A counter or gauge of a process: name, description, value.
type Figure = (&'static str, &'static str, fn(&HealthMessage) -> f64);

const COUNTERS: [Figure; 8] = [
    ("frames", "Frames sent (capture), tracked (tracker) or mapped (mapper)", |h| h.frames as f64),
    ("frames_dropped", "Frames that arrived too late to be handled", |h| h.dropped as f64),
    ("frame_gaps", "Frames that the source lost", |h| h.gaps as f64),
    ("messages_refused", "Invalid messages or images that were left out", |h| h.refused as f64),
    (
        "frames_disordered",
        "Frames whose sequence or stamp is not later than the previous one",
        |h| h.disordered as f64,
    ),
    ("image_size_changes", "Changes of the image size or the intrinsics", |h| h.resized as f64),
    ("deadline_misses", "Frames that took longer than the deadline", |h| h.deadline_misses as f64),
    ("page_faults", "Page faults of the frame loop since its first hundred frames", |h| {
        h.page_faults as f64
    }),
];

const GAUGES: [Figure; 4] = [
    ("frame_rate_hertz", "Frames a second over about the last second", |h| h.rate_hz),
    ("uptime_seconds", "Time since the process started", |h| secs_since(h.started_nanos)),
    ("report_age_seconds", "Time since the process last reported", |h| {
        secs_since(h.published_nanos)
    }),
    ("peak_resident_bytes", "Largest resident memory so far", |h| h.peak_rss_bytes as f64),
];

const MAPPER_COUNTERS: [Figure; 7] = [
    ("joint_estimates", "Joint estimates of keyframes that entered the map", |h| {
        h.adjustments as f64
    }),
    ("joint_estimates_merged", "Of them those that entered a map with newer keyframes", |h| {
        h.adjustments_merged as f64
    }),
    (
        "joint_estimates_dropped",
        "Joint estimates that were dropped because the map had changed",
        |h| h.adjustments_dropped as f64,
    ),
    ("loop_searches", "Keyframes that were searched for in older ones", |h| h.loop_searches as f64),
    ("loops_closed", "Loops that corrected the map", |h| h.loops_closed as f64),
    ("loops_held", "Loops that the map already satisfied", |h| h.loops_held as f64),
    ("epochs_joined", "Epochs that were joined to others", |h| h.epochs_joined as f64),
];

/// A histogram of a process: name, description, counts.
type Histogram = (&'static str, &'static str, fn(&HealthMessage) -> &[u64; HISTOGRAM_BUCKETS]);

const HISTOGRAMS: [Histogram; 3] = [
    ("latency_seconds", "From the frame's stamp to the output of the process", |h| {
        &h.latency_counts
    }),
    ("work_seconds", "Time that the work on a frame took", |h| &h.work_counts),
    ("wake_seconds", "From the sending of a frame until the process looks at it", |h| {
        &h.wake_counts
    }),
];

fn secs_since(nanos: i64) -> f64 {
    now_nanos().saturating_sub(nanos).max(0) as f64 * 1e-9
}

/// The OpenMetrics text; `pages` and `lost` are those of the server itself.
pub fn metrics(state: &State, instance: &str, pages: usize, lost: u64) -> String {
    let mut text = Text::default();
    text.describe("info", "semidense", "The instance and where its frames come from");
    let from = state.health.get("capture").map(source).unwrap_or_default();
    let labels = [("name", instance), ("version", env!("CARGO_PKG_VERSION")), ("source", &from)];
    text.line("semidense_info", &labels, 1.0);
    let is_up = f64::from(state.is_joined);
    text.family("gauge", "up", "1 while the instance runs", [([], is_up)]);
    of_processes(&mut text, state);
    of_mapper(&mut text, state);
    of_poses(&mut text, state);
    text.family("gauge", "view_pages", "Pages that are open", [([], pages as f64)]);
    let help = "Events that this server's own readers lost because they were slow";
    text.family("counter", "view_events_lost", help, [([], lost as f64)]);
    text.0 + "# EOF\n"
}

fn of_processes(text: &mut Text, state: &State) {
    let states = state.health.iter().flat_map(|(process, health)| {
        (0..PROCESS_STATES).filter_map(ProcessState::from_code).map(move |of| {
            let is_it = of.code() == health.state;
            ([("process", *process), ("state", of.name())], f64::from(is_it))
        })
    });
    text.family("gauge", "process_state", "1 for the state that the process is in", states);
    for (kind, figures) in [("counter", &COUNTERS[..]), ("gauge", &GAUGES)] {
        for (name, help, value) in figures {
            let processes = state.health.iter();
            let values =
                processes.map(|(process, health)| ([("process", *process)], value(health)));
            text.family(kind, name, help, values);
        }
    }
    for (name, help, counts) in HISTOGRAMS {
        let name = format!("semidense_{name}");
        text.describe("histogram", &name, help);
        for (process, health) in &state.health {
            text.histogram(&name, process, counts(health));
        }
    }
}

fn of_mapper(text: &mut Text, state: &State) {
    let Some(health) = state.health.get("mapper") else { return };
    for (name, help, value) in MAPPER_COUNTERS {
        text.family("counter", name, help, [([], value(health))]);
    }
    let cpu = "semidense_joint_estimate_cpu_seconds";
    text.describe("histogram", cpu, "CPU time of joint estimates");
    text.histogram(cpu, "mapper", &health.adjustment_counts);
    text.family("gauge", "keyframes", "Keyframes of the map", [([], health.total as f64)]);
}

fn of_poses(text: &mut Text, state: &State) {
    let counts = TrackingState::NAMES.iter().zip(state.poses_by_state);
    let counts = counts.map(|(name, count)| ([("state", *name)], count as f64));
    let help = "Poses by the state that they were in, since this server joined the run";
    text.family("counter", "poses", help, counts);
    let Some((_, pose)) = &state.pose else { return };
    let pose = &pose.message;
    let states = TrackingState::NAMES.iter().enumerate();
    let states =
        states.map(|(code, name)| ([("state", *name)], f64::from(code == pose.state as usize)));
    text.family("gauge", "tracking_state", "1 for the state of the newest pose", states);
    let age = secs_since(pose.published_nanos);
    let gauges = [
        ("pose_age_seconds", "Time since the newest pose was published", age),
        ("pose_in_view_ratio", "Share of the keyframe's points in view", pose.in_view_ratio),
        ("pose_inlier_ratio", "Share of the compared points that are explained", pose.inlier_ratio),
        ("epoch", "Epoch of the map", f64::from(pose.epoch)),
        ("map_revision", "How often the map had been corrected", pose.map_revision as f64),
    ];
    for (name, help, value) in gauges {
        text.family("gauge", name, help, [([], value)]);
    }
}

/// The text under construction.
#[derive(Debug, Default)]
struct Text(String);

impl Text {
    /// Adds a family of counters or gauges: each value with its labels.
    fn family<'a, const N: usize>(
        &mut self,
        kind: &str,
        name: &str,
        help: &str,
        values: impl IntoIterator<Item = ([(&'a str, &'a str); N], f64)>,
    ) {
        let name = format!("semidense_{name}");
        self.describe(kind, &name, help);
        let line = if kind == "counter" { format!("{name}_total") } else { name };
        values.into_iter().for_each(|(labels, value)| self.line(&line, &labels, value));
    }

    fn describe(&mut self, kind: &str, name: &str, help: &str) {
        let _ = write!(self.0, "# TYPE {name} {kind}\n# HELP {name} {help}.\n");
    }

    fn line(&mut self, name: &str, labels: &[(&str, &str)], value: f64) {
        self.0.push_str(name);
        for (i, (label, text)) in labels.iter().enumerate() {
            let begin = if i == 0 { '{' } else { ',' };
            let escaped = text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
            let _ = write!(self.0, "{begin}{label}=\"{escaped}\"");
        }
        if !labels.is_empty() {
            self.0.push('}');
        }
        let _ = writeln!(self.0, " {value}");
    }

    /// Adds Prometheus buckets, each of which includes all below it. Times are counted by half octaves and
    /// not summed: the sum takes each to be at the middle of its bucket, accurate to a few per cent.
    fn histogram(&mut self, name: &str, process: &str, counts: &[u64; HISTOGRAM_BUCKETS]) {
        let (mut below, mut sum) = (0_u64, 0.0);
        for (index, count) in counts.iter().enumerate() {
            below = below.saturating_add(*count);
            let end = bucket_end_ms(index) * 1e-3;
            let begin = if index == 0 { 0.0 } else { bucket_end_ms(index - 1) * 1e-3 };
            sum += *count as f64 * 0.5 * (begin + end);
            // The last bucket is open-ended.
            let le = if index + 1 == HISTOGRAM_BUCKETS {
                "+Inf".to_owned()
            } else {
                format!("{end:.9}")
            };
            let labels = [("process", process), ("le", &le)];
            self.line(&format!("{name}_bucket"), &labels, below as f64);
        }
        self.line(&format!("{name}_count"), &[("process", process)], below as f64);
        self.line(&format!("{name}_sum"), &[("process", process)], sum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_are_cumulative() {
        let mut counts = [0; HISTOGRAM_BUCKETS];
        (counts[0], counts[20], counts[HISTOGRAM_BUCKETS - 1]) = (2, 3, 5);
        let mut text = Text::default();
        text.histogram("t_seconds", "p", &counts);
        let value = |of: &str| {
            text.0
                .lines()
                .find(|line| line.contains(of))
                .unwrap()
                .rsplit_once(' ')
                .unwrap()
                .1
                .to_owned()
        };
        assert_eq!(
            [value("le=\"0.000001414\""), value("le=\"+Inf\""), value("_count")],
            ["2", "10", "10"]
        );
        let le: Vec<f64> = text
            .0
            .lines()
            .filter_map(|line| line.split("le=\"").nth(1)?.split('"').next()?.parse().ok())
            .collect();
        assert!(le.is_sorted() && le.len() == HISTOGRAM_BUCKETS);
    }

    #[test]
    fn labels_are_escaped() {
        let mut text = Text::default();
        text.line("a", &[("b", "x\"y\\z\n")], f64::NAN);
        assert_eq!(text.0, "a{b=\"x\\\"y\\\\z\\n\"} NaN\n");
    }
}
