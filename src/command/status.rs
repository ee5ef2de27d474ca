//! `semidense status`: what is running, and how well.

use std::io::IsTerminal;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use serde_json::{Value, json};

use crate::command::CommandResult;
use crate::command::ending::note_unfinished;
use crate::command::print::print;
use crate::service::clock::now_nanos;
use crate::service::config::Config;
use crate::service::health::{cause, percentile_ms, scheduling_name, warning};
use crate::service::journal::folder::unfinished;
use crate::service::peers::{HEALTH_TOPICS, Peer};
use crate::service::shutdown::Shutdown;
use crate::wire::message::HealthMessage;
use crate::wire::place::Place;
use crate::wire::port::{Access, Hub, OpenError, wait};
use crate::wire::topic::Topic;

/// Time between two looks: rates are taken over it.
const PERIOD: Duration = Duration::from_secs(1);
/// Looks after which `--once` shows what it has: two reports are a second apart, a process that
/// starts or ends may give only one.
const MAX_LOOKS: usize = 4;
/// A process that has said nothing for so long is not there any more.
const STALE_NANOS: i64 = 3_000_000_000;

/// Terminals clear the screen and go to its first place.
const CLEAR_SCREEN: &str = "\x1b[2J\x1b[H";

/// Show states, rates and latencies of the running processes
#[derive(Debug, Args)]
pub struct StatusArguments {
    /// Show it once and end
    #[arg(long)]
    once: bool,
    /// One JSON object for each look
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(config: &Config, arguments: StatusArguments) -> CommandResult {
    let place = Place::new(&config.instance, &config.root)?;
    note_unfinished(&unfinished(Some(&place), Path::new(".")));
    let hub = Hub::join(&place, "status", Access::Observer)?;
    let mut peers = Vec::new();
    for topic in &HEALTH_TOPICS {
        peers.push(listen(&hub, topic)?);
    }
    if peers.iter().all(Option::is_none) {
        // Its error says that nothing runs, unless this has changed just now.
        Peer::open(&hub, &HEALTH_TOPICS[0])?;
    }
    let shutdown = Shutdown::install()?;
    let is_live = std::io::stdout().is_terminal() && !arguments.once && !arguments.json;
    let mut before: Vec<Option<HealthMessage>> = vec![None; peers.len()];
    let mut looks = 0;
    loop {
        looks += 1;
        wait(&[], Some(shutdown.descriptor()), PERIOD)?;
        if shutdown.is_requested() {
            return Ok(ExitCode::SUCCESS);
        }
        let mut rows = Vec::new();
        for ((topic, peer), before) in HEALTH_TOPICS.iter().zip(&mut peers).zip(&mut before) {
            if peer.is_none() {
                // It may have come up since the last look.
                *peer = listen(&hub, topic)?;
            }
            let Some(peer) = peer else {
                rows.push((topic.owner, Value::Null));
                continue;
            };
            peer.update()?;
            rows.push((peer.name(), row(peer, before.as_ref())));
            // One look takes its rates since the first report, to be done soonest.
            if !(arguments.once && before.is_some()) {
                *before = peer.last().copied();
            }
        }
        // A rate takes two reports of a process; one that is alone or silent has none.
        let is_measured = |(_, row): &(_, Value)| row.is_null() || !row["rate_hz"].is_null();
        if arguments.once && looks < MAX_LOOKS && !rows.iter().all(is_measured) {
            continue;
        }
        let clear = if is_live { CLEAR_SCREEN } else { "" };
        print(&format!("{clear}{}", text_of(&rows, arguments.json)))?;
        if arguments.once {
            return Ok(ExitCode::SUCCESS);
        }
    }
}

/// The process that speaks on `topic`; `None` where it does not run.
fn listen(hub: &Hub, topic: &Topic) -> Result<Option<Peer>, OpenError> {
    match Peer::open(hub, topic) {
        Ok(peer) => Ok(Some(peer)),
        Err(OpenError::NotRunning { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

/// One process as JSON; null where it has never spoken.
fn row(peer: &Peer, before: Option<&HealthMessage>) -> Value {
    let Some(health) = peer.last() else { return Value::Null };
    let is_stale = now_nanos() - health.published_nanos > STALE_NANOS;
    let state = peer.state().map_or("unknown", |state| state.name());
    let rate_hz = before.and_then(|before| {
        let nanos = health.published_nanos - before.published_nanos;
        let frames = health.frames.checked_sub(before.frames)?;
        (nanos > 0).then(|| frames as f64 * 1e9 / nanos as f64)
    });
    json!({
        "state": if is_stale { "silent" } else { state },
        "cause": cause(health),
        "process_id": health.process_id,
        "frames": health.frames,
        "rate_hz": rate_hz,
        "dropped": health.dropped,
        "gaps": health.gaps,
        "refused": health.refused,
        "disordered": health.disordered,
        "resized": health.resized,
        "deadline_misses": health.deadline_misses,
        "page_faults": health.page_faults,
        "scheduling": scheduling_name(health.scheduling),
        "priority": health.priority,
        "memory_locked": health.memory_locked != 0,
        "warning": warning(health),
        "peak_rss_mb": health.peak_rss_bytes as f64 / f64::from(1 << 20),
        "latency_ms": {
            "p50": percentile_ms(&health.latency_counts, 0.5),
            "p99": percentile_ms(&health.latency_counts, 0.99),
            "max": percentile_ms(&health.latency_counts, 1.0),
        },
        "wake_ms": {
            "p50": percentile_ms(&health.wake_counts, 0.5),
            "p99": percentile_ms(&health.wake_counts, 0.99),
            "max": percentile_ms(&health.wake_counts, 1.0),
        },
    })
}

/// The rows as JSON or as a table.
fn text_of(rows: &[(&str, Value)], json: bool) -> String {
    if json {
        let object: serde_json::Map<_, _> =
            rows.iter().map(|(name, row)| ((*name).to_owned(), row.clone())).collect();
        return format!("{}\n", Value::Object(object));
    }
    let mut lines =
        vec!["process  state      frames   rate/s  dropped  late  p50 ms  p99 ms  MB".to_owned()];
    for (name, row) in rows {
        let number = |value: &Value, digits: usize| {
            value.as_f64().map_or("-".to_owned(), |x| format!("{x:.digits$}"))
        };
        if row.is_null() {
            lines.push(format!("{name:8} not running"));
            continue;
        }
        lines.push(format!(
            "{name:8} {:9} {:>7} {:>8} {:>8} {:>5} {:>7} {:>7} {:>3} {}",
            row["state"].as_str().unwrap_or(""),
            number(&row["frames"], 0),
            number(&row["rate_hz"], 1),
            number(&row["dropped"], 0),
            number(&row["deadline_misses"], 0),
            number(&row["latency_ms"]["p50"], 2),
            number(&row["latency_ms"]["p99"], 2),
            number(&row["peak_rss_mb"], 0),
            row["cause"].as_str().unwrap_or(""),
        ));
        if let Some(warning) = row["warning"].as_str().filter(|warning| !warning.is_empty()) {
            lines.push(format!("         warning: {warning}"));
        }
    }
    lines.join("\n") + "\n"
}
