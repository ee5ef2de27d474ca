//! Processes that are killed at any instant: the others carry on, the one started again goes on, and
//! nothing stays behind. Twenty kills always; two hundred by
//! `cargo test --release --test soak -- --ignored --nocapture`.

#[allow(dead_code, reason = "every test uses its part of what they share")]
mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};
use semidense::service::health::ProcessState;
use semidense::service::peers::{HEALTH_TOPICS, Peer};
use semidense::slam::geometry::se3::SE3;
use semidense::slam::pose::PoseEstimate;
use semidense::wire::conversion::pose_from_message;
use semidense::wire::message::PoseMessage;
use semidense::wire::place::SHARED_MEMORY;
use semidense::wire::port::{Hub, Subscriber};
use semidense::wire::topic::POSE;
use serde_json::Value;
use support::{Rig, end, signal, until};

/// Kills that every run of the tests makes.
const FEW_KILLS: usize = 20;
/// Kills of the long run.
const MANY_KILLS: usize = 200;
/// The camera moves slowly to and fro: within the second that a restart may take it goes far less than this
/// between two poses, in units of the map (about a room's depth).
const LARGEST_STEP: f64 = 0.5;
/// Who dies sooner after its start is started again later and later.
const HASTY: Duration = Duration::from_secs(2);
/// Memory that a process may take more than at the beginning: pages of other code, a fuller map.
const MEMORY_SLACK: f64 = 1.5;

/// Numbers that are the same on every run (xorshift64).
struct Dice(u64);

impl Dice {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % bound
    }
}

/// Poses as an observer sees them, and what must hold of each.
struct Watch {
    poses: Subscriber<PoseMessage, ()>,
    last: Option<PoseEstimate>,
    last_tracked: Option<PoseEstimate>,
    count: usize,
    epochs: BTreeSet<u32>,
}

impl Watch {
    fn new(hub: &Hub) -> Self {
        let poses = until("poses", || hub.subscriber(&POSE).ok());
        Self { poses, last: None, last_tracked: None, count: 0, epochs: BTreeSet::new() }
    }

    fn look(&mut self) {
        while let Some(message) = self.poses.receive().unwrap() {
            let pose = pose_from_message(&message.payload()[0]).unwrap();
            self.take(pose);
        }
    }

    fn take(&mut self, pose: PoseEstimate) {
        if let Some(last) = &self.last {
            // A pose that a dead tracker has sent may come with the history of its successor again.
            assert!(pose.sequence >= last.sequence, "{} after {}", pose.sequence, last.sequence);
        }
        if pose.state.is_tracked() {
            self.count += 1;
            self.epochs.insert(pose.epoch);
            if let Some(last) = self.last_tracked.filter(|last| last.epoch == pose.epoch) {
                let step = distance(&last.world_from_camera, &pose.world_from_camera);
                assert!(step < LARGEST_STEP, "a jump of {step} at frame {}", pose.sequence);
            }
            self.last_tracked = Some(pose);
        }
        self.last = Some(pose);
    }

    /// Until a pose is claimed of a frame that is newer than all so far.
    fn until_resumed(&mut self, what: &str) -> Duration {
        let start = Instant::now();
        let before = self.count;
        until(what, || {
            self.look();
            (self.count > before + 2).then_some(())
        });
        start.elapsed()
    }
}

fn distance(one: &SE3, other: &SE3) -> f64 {
    (one.translation - other.translation).norm()
}

/// How many files of each kind this instance has in shared memory and in its folder: the names themselves
/// differ with every process.
fn files(rig: &Rig) -> BTreeMap<String, usize> {
    let prefix = rig.place().prefix;
    let names = |folder: &Path| {
        let entries = fs::read_dir(folder).unwrap().flatten();
        entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect::<Vec<_>>()
    };
    let shared = names(Path::new(SHARED_MEMORY)).into_iter().filter(|n| n.starts_with(&prefix));
    let mut counts = BTreeMap::new();
    for name in shared.chain(names(&rig.root())) {
        let kind = name.rsplit('.').next().unwrap_or_default().to_owned();
        *counts.entry(kind).or_default() += 1;
    }
    counts
}

/// Resident memory of a process, bytes.
fn resident(pid: u32) -> Option<f64> {
    let statm = fs::read_to_string(format!("/proc/{pid}/statm")).ok()?;
    let pages: f64 = statm.split_whitespace().nth(1)?.parse().ok()?;
    Some(pages * rustix::param::page_size() as f64)
}

fn pid_of(peer: &mut Peer) -> u32 {
    until("a process id", || peer.update().unwrap().map(|health| health.process_id))
}

/// Kills a process and looks that poses resume; how long they were missing.
fn kill(watch: &mut Watch, peer: &mut Peer) -> Duration {
    let pid = pid_of(peer);
    rustix::process::kill_process(Pid::from_raw(pid as i32).unwrap(), Signal::KILL).unwrap();
    let begin = Instant::now();
    until("the process that takes its place", || {
        watch.look();
        (peer.update().unwrap()?.process_id != pid).then_some(())
    });
    watch.until_resumed(&format!("poses after a kill of {}", peer.name()));
    begin.elapsed()
}

/// Kills as often at random instants, and looks after each that all goes on.
fn soak(kills: usize, seed: u64) {
    let rig = Rig::new();
    let source = "loop:1000000:20:sim";
    // The dice kill the same process again within two seconds of its start, six times in a row if they are
    // thrown often enough: no reason to give up here.
    let patient = ["--set", "supervisor.max_restarts=1000"];
    let mut command = rig.run(60, &["--live", "--source", source]);
    let child = command.args(patient).spawn().unwrap();
    let hub = rig.observe();
    let mut watch = Watch::new(&hub);
    watch.until_resumed("the first pose");
    let open = |topic| until("a process", || Peer::open(&hub, topic).ok());
    let mut peers: Vec<Peer> = HEALTH_TOPICS.iter().map(open).collect();
    let memory = |peers: &mut Vec<Peer>| -> Option<f64> {
        peers.iter_mut().map(|peer| resident(pid_of(peer))).sum()
    };
    // Who is connected to whom depends on who started last: each once in a known order, then and at the end.
    for peer in &mut peers {
        kill(&mut watch, peer);
    }
    let (files_before, memory_before) = (files(&rig), memory(&mut peers).unwrap());
    let mut dice = Dice(seed);
    let mut pauses = Vec::new();
    let mut began = [Instant::now(); 3];
    for _ in 0..kills {
        let instant = Duration::from_millis(dice.below(400));
        let begin = Instant::now();
        while begin.elapsed() < instant {
            watch.look();
            std::thread::sleep(Duration::from_millis(2));
        }
        let index = dice.below(3) as usize;
        let has_lived = began[index].elapsed() > HASTY;
        let (name, missing) = (peers[index].name(), kill(&mut watch, &mut peers[index]));
        began[index] = Instant::now();
        pauses.push(Pause { name, missing, has_lived });
    }
    for peer in &mut peers {
        kill(&mut watch, peer);
    }
    report(&pauses);
    assert_eq!(watch.epochs.len(), 1, "the map began anew: {:?}", watch.epochs);
    until("the leftovers of the dead to be gone", || {
        watch.look();
        let files = files(&rig);
        let is_same = files == files_before;
        if !is_same {
            std::thread::sleep(Duration::from_millis(200));
        }
        is_same.then_some(())
    });
    let memory_after = memory(&mut peers).unwrap();
    assert!(memory_after < MEMORY_SLACK * memory_before, "{memory_before} → {memory_after}");
    drop((peers, watch, hub));
    signal(&child, Signal::INT);
    let ended = end(child);
    assert_eq!(ended.status.code(), Some(130), "{}", ended.stderr);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
    // What dead processes have counted counts too.
    let summary = fs::read_to_string(rig.output().join("summary.json")).unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    let of = |name: &str| summary[name].as_u64().unwrap();
    assert!(of("frames_in") >= of("frames_tracked") + of("frames_initializing"), "{summary}");
}

/// How long poses were missing after a kill.
struct Pause {
    name: &'static str,
    missing: Duration,
    /// Whether who was killed had lived long enough to be started again at once.
    has_lived: bool,
}

/// Says how long poses were missing; the runner swallows `println!`.
fn report(pauses: &[Pause]) {
    let times = |name, has_lived| {
        let of_kind = pauses.iter().filter(|p| p.name == name && p.has_lived == has_lived);
        let mut times: Vec<f64> = of_kind.map(|pause| pause.missing.as_secs_f64()).collect();
        times.sort_by(f64::total_cmp);
        times
    };
    for (name, has_lived) in
        ["capture", "tracker", "mapper"].into_iter().flat_map(|name| [(name, true), (name, false)])
    {
        let times = times(name, has_lived);
        if let (Some(median), Some(longest)) = (times.get(times.len() / 2), times.last()) {
            let start = if has_lived { "at once" } else { "with back-off" };
            let line = format!(
                "{name}, started again {start}: {} kills, poses back after {median:.2} s (median), \
                 {longest:.2} s (longest)",
                times.len()
            );
            // A closed standard error must not fail a test.
            let _ = writeln!(std::io::stderr(), "{line}");
        }
    }
}

#[test]
fn a_source_that_stalls_is_said_and_recovers_alone() {
    let rig = Rig::new();
    let child = rig.run(60, &["--live", "--source", "loop:1000000:20:sim"]).spawn().unwrap();
    let hub = rig.observe();
    let mut watch = Watch::new(&hub);
    watch.until_resumed("the first pose");
    let open = |topic| until("a process", || Peer::open(&hub, topic).ok());
    let [mut capture, mut tracker, _] = HEALTH_TOPICS.each_ref().map(open);
    let pid = Pid::from_raw(pid_of(&mut capture) as i32).unwrap();
    let mut until_state = |wanted: ProcessState| {
        until(wanted.name(), || {
            tracker.update().unwrap();
            (tracker.state() == Some(wanted)).then_some(())
        });
    };
    rustix::process::kill_process(pid, Signal::STOP).unwrap();
    until_state(ProcessState::Stale);
    rustix::process::kill_process(pid, Signal::CONT).unwrap();
    until_state(ProcessState::Running);
    watch.until_resumed("poses after the stall");
    drop((capture, tracker, watch, hub));
    signal(&child, Signal::INT);
    assert_eq!(end(child).status.code(), Some(130));
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn twenty_kills_change_nothing() {
    soak(FEW_KILLS, 0x5eed_0001);
}

#[test]
#[ignore = "takes minutes"]
fn two_hundred_kills_change_nothing() {
    soak(MANY_KILLS, 0x5eed_0002);
}
