//! `semidense status`: what is running, and how well.

use std::error::Error;
use std::io::IsTerminal;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use serde_json::{Value, json};

use crate::command::CommandResult;
use crate::command::ending::note_unfinished;
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

/// Time between two looks.
const PERIOD: Duration = Duration::from_secs(1);
/// The same where one look is all: processes answer whoever joins within their next frame.
const ONCE_PERIOD: Duration = Duration::from_millis(50);
/// Looks after which `--once` shows what it has: a process that hangs or ends answers no more. Three seconds.
const MAX_LOOKS: usize = 60;
/// A process that has said nothing for so long is not there any more.
const STALE_NANOS: i64 = 3_000_000_000;

/// What the process of `semidense run` claims to be.
const SUPERVISOR: &str = "supervisor";

/// Width of a terminal that does not tell its own, columns.
const USUAL_WIDTH: usize = 80;

/// Terminals clear the screen and go to its first place.
const CLEAR_SCREEN: &str = "\x1b[2J\x1b[H";

/// Show states, rates and latencies of the running processes
#[derive(Debug, Args)]
#[command(after_help = legend())]
pub struct StatusArguments {
    /// Show the status once and exit
    #[arg(long)]
    once: bool,
    /// Refresh once a second until Ctrl-C, also where nothing runs yet and where a run has ended
    #[arg(long, conflicts_with = "once")]
    watch: bool,
    /// Print one JSON object per update, each on a line; the position of the pose is null while none is claimed
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(config: &Config, arguments: StatusArguments) -> CommandResult {
    let place = Place::new(&config.instance, &config.root)?;
    note_unfinished(&unfinished(Some(&place), Path::new(".")));
    let shutdown = Shutdown::install()?;
    loop {
        match follow(&place, &arguments, &shutdown) {
            Err(error) if arguments.watch && is_absence(error.as_ref()) => {
                let look = format!("{}\n", nothing_runs(&place.instance));
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

/// Whether nothing runs there, as far as can be seen from here.
fn is_absence(error: &(dyn Error + 'static)) -> bool {
    error.downcast_ref().is_some_and(OpenError::is_absence)
}

/// What goes in front of an update: on a terminal it takes the place of the one before.
fn clear(arguments: &StatusArguments) -> &'static str {
    let is_live = std::io::stdout().is_terminal() && !arguments.once && !arguments.json;
    if is_live { CLEAR_SCREEN } else { "" }
}

/// Shows the run that is on until it ends, or once.
fn follow(
    place: &Place,
    arguments: &StatusArguments,
    shutdown: &Shutdown,
) -> Result<(), Box<dyn Error>> {
    let hub = Hub::join(place, "status", Access::Observer)?;
    let mut watch = Watch::open(&hub, place)?;
    let period = if arguments.once { ONCE_PERIOD } else { PERIOD };
    for looks in 1.. {
        wait(&[], Some(shutdown.descriptor()), period)?;
        if shutdown.is_requested() {
            break;
        }
        let look = watch.look(&hub)?;
        let has_ended = look["ended"] == true;
        if arguments.once && looks < MAX_LOOKS && !watch.is_complete(&look) {
            continue;
        }
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

/// A look where there is nothing to see.
fn nothing_runs(instance: &str) -> Value {
    json!({
        "instance": instance, "source": null, "uptime_secs": null, "keyframes": null, "capture": null, "tracker": null,
        "mapper": null, "pose": null, "ended": true,
    })
}

/// Columns of the terminal; the usual ones where standard output is none.
fn terminal_width() -> usize {
    let size = rustix::termios::tcgetwinsize(std::io::stdout());
    size.map_or(USUAL_WIDTH, |size| usize::from(size.ws_col)).max(1)
}

/// What is listened to.
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
            // Its error says that nothing runs, unless this has changed just now.
            Peer::open(hub, &HEALTH_TOPICS[0])?;
        }
        Ok(Self { place, peers, poses: None, last_pose: None })
    }

    /// Whether every process that is there has said how it is, and the tracker its pose.
    fn is_complete(&self, look: &Value) -> bool {
        let is_heard = |topic: &Topic| {
            let id = self.place.claimant(topic.owner);
            let is_there = id.is_some_and(|id| Liveness::of(id) != Liveness::Gone);
            !is_there || !look[topic.owner].is_null()
        };
        let counts_frames = look["tracker"]["frames"].as_u64().is_some_and(|frames| frames > 0);
        HEALTH_TOPICS.iter().all(is_heard) && (!counts_frames || !look["pose"].is_null())
    }

    /// One look.
    fn look(&mut self, hub: &Hub) -> Result<Value, Box<dyn Error>> {
        let mut look = json!({ "instance": self.place.instance, "source": null, "uptime_secs": null, "keyframes": null });
        let now = now_nanos();
        let (mut heard, mut ended) = (0, 0);
        for (topic, peer) in HEALTH_TOPICS.iter().zip(&mut self.peers) {
            if peer.is_none() {
                // It may have come up since the last look.
                *peer = unless_absent(Peer::open(hub, topic))?;
            }
            if let Some(peer) = peer {
                peer.update()?;
            }
            let said = peer.as_ref().and_then(|peer| Some((peer.state(), peer.last()?)));
            let Some((reported, health)) = said else {
                // One that is stopped cannot hand its last report to a subscriber that joins.
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
            // Without a supervisor the oldest tells best: one that was restarted is younger than the run.
            look["uptime_secs"] = json!(known.max(own));
        }
        if let Some(age) = self.place.claimant(SUPERVISOR).and_then(age) {
            look["uptime_secs"] = json!(age.as_secs_f64());
        }
        if look["keyframes"].is_null() {
            look["keyframes"] = json!(self.keyframes_of_checkpoint());
        }
        self.hear_poses(hub)?;
        look["pose"] = self.last_pose.as_ref().map_or(Value::Null, |pose| pose_row(pose, now));
        look["ended"] = json!(heard > 0 && ended == heard);
        Ok(look)
    }

    /// Keyframes by the newest checkpoint of a mapper that says nothing: one that is stopped, or has died.
    fn keyframes_of_checkpoint(&self) -> Option<usize> {
        let map = read_checkpoint(&self.place.checkpoint_path()).ok()??;
        Some(map.keyframes.len())
    }

    /// Keeps the newest pose.
    fn hear_poses(&mut self, hub: &Hub) -> Result<(), Box<dyn Error>> {
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

/// What a process is doing: by its own report, unless the kernel knows better. A process in another
/// container has an id that means nothing here; as long as it reports it is believed.
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

/// A pose as JSON. It has a position only while it is claimed: what a lost tracker sends is where it was last.
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

/// What was opened; `None` where its process does not run.
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
