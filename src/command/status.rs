//! `semidense status`: shows what is running, and how well.

use std::error::Error;
use std::io::IsTerminal;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use serde_json::{Value, json};

use crate::command::CommandResult;
use crate::command::ending::print_unfinished;
use crate::command::print::print;
use crate::command::status_text::{legend, status_text};
use crate::service::checkpoint::read_checkpoint;
use crate::service::clock::now_nanos;
use crate::service::config::Config;
use crate::service::health::{cause, percentile_ms, scheduling_name, source, warning};
use crate::service::journal::folder::unfinished;
use crate::service::liveness::{Liveness, age};
use crate::service::peers::Peer;
use crate::service::shutdown::Shutdown;
use crate::slam::pose::TrackingState;
use crate::wire::conversion::state_from_codes;
use crate::wire::message::{HealthMessage, PoseMessage};
use crate::wire::place::Place;
use crate::wire::port::{Access, Hub, OpenError, Subscriber, wait};
use crate::wire::topic::{HEALTH_TOPICS, MAPPER_HEALTH, POSE, Topic};

/// Update period.
const PERIOD: Duration = Duration::from_secs(1);
/// The same before the first: processes answer a new subscriber within their next frame.
const FIRST_PERIOD: Duration = Duration::from_millis(50);
/// Looks after which the first update shows what it has: a process that hangs or ends does not answer. Three seconds.
const MAX_LOOKS: usize = 60;
/// A process that has not reported for longer is stale.
const STALE_NANOS: i64 = 3_000_000_000;

/// Name that the process of `semidense run` claims.
const SUPERVISOR: &str = "supervisor";

/// Width of a terminal that does not report its own, columns.
const USUAL_WIDTH: usize = 80;

/// Clears the terminal and moves the cursor to its top left.
const CLEAR_SCREEN: &str = "\x1b[2J\x1b[H";

/// Show states, rates and latencies of the running processes
#[derive(Debug, Args)]
#[command(after_help = legend())]
pub struct StatusArguments {
    /// Show the status once and exit
    #[arg(long)]
    once: bool,
    /// Refresh once a second until Ctrl-C, even if nothing runs yet or a run has ended
    #[arg(long, conflicts_with = "once")]
    watch: bool,
    /// Print one JSON object per update, each on its own line; the pose's position is null while no pose is claimed
    #[arg(long)]
    json: bool,
}

/// Prints the status.
pub fn run(config: &Config, arguments: StatusArguments) -> CommandResult {
    let place = Place::new(&config.instance, &config.root)?;
    print_unfinished(&unfinished(Some(&place), Path::new(".")));
    let shutdown = Shutdown::install()?;
    loop {
        match follow(&place, &arguments, &shutdown) {
            Err(error) if arguments.watch && is_absence(error.as_ref()) => {
                let look = format!("{}\n", not_running_json(&place.instance));
                let text = format!("{}{error}\n", clear(&arguments));
                print(if arguments.json { &look } else { &text })?;
            }
            shown => shown?,
        }
        if !arguments.watch || shutdown.is_requested() {
            return Ok(ExitCode::SUCCESS);
        }
        wait(&[], Some(shutdown.descriptor()), PERIOD)?;
    }
}

/// Whether nothing runs, as far as can be seen from this process.
fn is_absence(error: &(dyn Error + 'static)) -> bool {
    error.downcast_ref().is_some_and(OpenError::is_absence)
}

/// Prefix of an update: on a terminal it replaces the previous one.
fn clear(arguments: &StatusArguments) -> &'static str {
    let is_live = std::io::stdout().is_terminal() && !arguments.once && !arguments.json;
    if is_live { CLEAR_SCREEN } else { "" }
}

/// Shows the running instance until it ends, or once.
fn follow(
    place: &Place,
    arguments: &StatusArguments,
    shutdown: &Shutdown,
) -> Result<(), Box<dyn Error>> {
    let hub = Hub::join(place, "status", Access::Observer)?;
    let mut watch = Watch::open(&hub, place)?;
    let mut is_shown = false;
    for looks in 1.. {
        let period = if is_shown { PERIOD } else { FIRST_PERIOD };
        wait(&[], Some(shutdown.descriptor()), period)?;
        if shutdown.is_requested() {
            break;
        }
        let look = watch.snapshot(&hub)?;
        let has_ended = look["ended"] == true;
        if !(is_shown || has_ended || looks >= MAX_LOOKS || watch.is_complete(&look)) {
            continue;
        }
        is_shown = true;
        let text = match arguments.json {
            true => format!("{look}\n"),
            false => status_text(&look, terminal_width()),
        };
        print(&format!("{}{text}", clear(arguments)))?;
        if has_ended && !arguments.json {
            print("the run has ended\n")?;
        }
        if arguments.once || has_ended {
            break;
        }
    }
    Ok(())
}

/// The status when nothing runs.
fn not_running_json(instance: &str) -> Value {
    json!({
        "instance": instance, "source": null, "uptime_secs": null, "keyframes": null, "capture": null, "tracker": null,
        "mapper": null, "pose": null, "ended": true,
    })
}

/// Columns of the terminal; [`USUAL_WIDTH`] if standard output is not one.
fn terminal_width() -> usize {
    let size = rustix::termios::tcgetwinsize(std::io::stdout());
    size.map_or(USUAL_WIDTH, |size| usize::from(size.ws_col)).max(1)
}

/// The subscriptions of a status display.
struct Watch<'a> {
    place: &'a Place,
    peers: Vec<Option<Peer>>,
    poses: Option<Subscriber<PoseMessage, ()>>,
    last_pose: Option<PoseMessage>,
}

impl<'a> Watch<'a> {
    fn open(hub: &Hub, place: &'a Place) -> Result<Self, OpenError> {
        let listen = |topic| unless_absent(Peer::open(hub, topic));
        let peers = HEALTH_TOPICS.iter().map(listen).collect::<Result<Vec<_>, _>>()?;
        if peers.iter().all(Option::is_none) {
            // Its error reports that nothing runs, unless that has just changed.
            Peer::open(hub, &HEALTH_TOPICS[0])?;
        }
        Ok(Self { place, peers, poses: None, last_pose: None })
    }

    /// Whether every running process has reported its health, and the tracker its pose.
    fn is_complete(&self, look: &Value) -> bool {
        let is_heard = |topic: &Topic| {
            let id = self.place.claimant(topic.owner);
            let is_there = id.is_some_and(|id| Liveness::of(id) != Liveness::Gone);
            !is_there || !look[topic.owner].is_null()
        };
        let counts_frames = look["tracker"]["frames"].as_u64().is_some_and(|frames| frames > 0);
        HEALTH_TOPICS.iter().all(is_heard) && (!counts_frames || !look["pose"].is_null())
    }

    /// One update.
    fn snapshot(&mut self, hub: &Hub) -> Result<Value, Box<dyn Error>> {
        let mut look = json!({ "instance": self.place.instance, "source": null, "uptime_secs": null, "keyframes": null });
        let now = now_nanos();
        let (mut heard, mut ended) = (0, 0);
        for (topic, peer) in HEALTH_TOPICS.iter().zip(&mut self.peers) {
            if peer.is_none() {
                // It may have started since the last update.
                *peer = unless_absent(Peer::open(hub, topic))?;
            }
            if let Some(peer) = peer {
                peer.update()?;
            }
            let said = peer.as_ref().and_then(|peer| Some((peer.state(), peer.last()?)));
            let Some((reported, health)) = said else {
                // A stopped process cannot deliver its last report to a new subscriber.
                let id = self.place.claimant(topic.owner);
                let stopped = id.filter(|&id| Liveness::of(id) == Liveness::Stopped);
                look[topic.owner] = stopped
                    .map_or(Value::Null, |id| json!({ "state": "stopped", "process_id": id }));
                heard += usize::from(stopped.is_some());
                continue;
            };
            let state = state_of(health, reported.map(|state| state.name()), now);
            heard += 1;
            ended += usize::from(state == NOT_RUNNING);
            look[topic.owner] = row(topic, health, state, now);
            match topic.owner {
                "capture" => look["source"] = json!(source(health)),
                "mapper" => look["keyframes"] = json!(health.total),
                _ => {}
            }
            let known = look["uptime_secs"].as_f64().unwrap_or_default();
            let own = look[topic.owner]["uptime_secs"].as_f64().unwrap_or_default();
            // Without a supervisor the oldest process is the best estimate: a restarted one is younger than the run.
            look["uptime_secs"] = json!(known.max(own));
        }
        if let Some(age) = self.place.claimant(SUPERVISOR).and_then(age) {
            look["uptime_secs"] = json!(age.as_secs_f64());
        }
        if look["keyframes"].is_null() {
            look["keyframes"] = json!(self.keyframes_of_checkpoint());
        }
        self.receive_poses(hub)?;
        look["pose"] = self.last_pose.as_ref().map_or(Value::Null, |pose| pose_row(pose, now));
        look["ended"] = json!(heard > 0 && ended == heard);
        Ok(look)
    }

    /// Keyframes in the newest checkpoint of a mapper that does not report: a stopped or a dead one.
    fn keyframes_of_checkpoint(&self) -> Option<usize> {
        let map = read_checkpoint(&self.place.checkpoint_path()).ok()??;
        Some(map.keyframes.len())
    }

    /// Keeps the newest pose.
    fn receive_poses(&mut self, hub: &Hub) -> Result<(), Box<dyn Error>> {
        if self.poses.is_none() {
            self.poses = unless_absent(hub.subscriber(&POSE))?;
        }
        let Some(poses) = &mut self.poses else { return Ok(()) };
        while let Some(message) = poses.receive()? {
            self.last_pose = message.payload().first().copied().or(self.last_pose);
        }
        Ok(())
    }
}

/// The state of a process that has ended.
const NOT_RUNNING: &str = "not running";

/// State of a process: its own report, unless the kernel contradicts it. The id of a process in another
/// container is meaningless here; its reports are believed as long as they arrive.
fn state_of(health: &HealthMessage, reported: Option<&'static str>, now: i64) -> &'static str {
    let is_stale = now - health.published_nanos > STALE_NANOS;
    let has_finished = matches!(reported, Some("finished" | "failed"));
    match Liveness::of(health.process_id) {
        Liveness::Gone if is_stale || has_finished => NOT_RUNNING,
        Liveness::Stopped => "stopped",
        _ if is_stale => "silent",
        _ => reported.unwrap_or("unknown"),
    }
}

/// A pose as JSON. It has a position only while it is claimed: a lost tracker sends its last known position.
fn pose_row(pose: &PoseMessage, now: i64) -> Value {
    let state = state_from_codes(pose.state, pose.reason).ok();
    let [.., x, y, z] = pose.world_from_camera;
    json!({
        "state": state.map_or("unknown", TrackingState::name),
        "sequence": pose.sequence,
        "epoch": pose.epoch,
        "position": state.is_some_and(TrackingState::is_tracked).then_some([x, y, z]),
        "age_secs": (now - pose.published_nanos).max(0) as f64 * 1e-9,
    })
}

/// The opened port; `None` if its process does not run.
fn unless_absent<T>(opened: Result<T, OpenError>) -> Result<Option<T>, OpenError> {
    match opened {
        Ok(opened) => Ok(Some(opened)),
        Err(error) if error.is_absence() => Ok(None),
        Err(error) => Err(error),
    }
}

/// One process as JSON.
fn row(topic: &Topic, health: &HealthMessage, state: &str, now: i64) -> Value {
    let is_running = ["running", "stale"].contains(&state);
    let rate_hz = (is_running && health.rate_hz.is_finite()).then_some(health.rate_hz);
    let times = |counts| {
        let at = |share| percentile_ms(counts, share);
        json!({ "p50": at(0.5), "p99": at(0.99), "max": at(1.0) })
    };
    let mut adjustment_times = times(&health.adjustment_counts);
    adjustment_times["p95"] = json!(percentile_ms(&health.adjustment_counts, 0.95));
    let adjustments = json!({
        "entered": health.adjustments,
        "merged": health.adjustments_merged,
        "dropped": health.adjustments_dropped,
        "cpu_ms": adjustment_times,
    });
    let loops = json!({
        "searched": health.loop_searches,
        "closed": health.loops_closed,
        "held": health.loops_held,
        "joined": health.epochs_joined,
        "other_places": health.loops_refused,
        "against_drift": health.loops_against_drift,
        "unconfirmed": health.loops_unconfirmed,
        "inconsistent": health.loops_inconsistent,
    });
    let is_mapper = topic.owner == MAPPER_HEALTH.owner;
    json!({
        "adjustments": is_mapper.then_some(adjustments),
        "loops": is_mapper.then_some(loops),
        "state": state,
        "cause": cause(health),
        "process_id": health.process_id,
        "uptime_secs": (now - health.started_nanos).max(0) as f64 * 1e-9,
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
        "latency_ms": times(&health.latency_counts),
        "wake_ms": times(&health.wake_counts),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::{DegradedReason, LostReason, PoseEstimate};
    use crate::wire::conversion::{PoseTiming, pose_message};

    #[test]
    fn a_position_is_given_only_while_a_pose_is_claimed() {
        for (state, is_given) in [
            (TrackingState::Initializing, false),
            (TrackingState::Tracking, true),
            (TrackingState::Degraded(DegradedReason::Turning), true),
            (TrackingState::Lost(LostReason::Diverged), false),
        ] {
            let mut estimate = PoseEstimate { state, ..PoseEstimate::unknown_at(7, 0) };
            estimate.world_from_camera.translation = [1.0, 2.0, 3.0].into();
            let row = pose_row(&pose_message(&estimate, &PoseTiming::default()), 0);
            let position = if is_given { json!([1.0, 2.0, 3.0]) } else { Value::Null };
            assert_eq!((&row["state"], &row["position"]), (&json!(state.name()), &position));
        }
        let mut message = pose_message(&PoseEstimate::unknown_at(7, 0), &PoseTiming::default());
        message.state = 99;
        let row = pose_row(&message, 0);
        assert_eq!((&row["state"], &row["position"]), (&json!("unknown"), &Value::Null));
    }
}
