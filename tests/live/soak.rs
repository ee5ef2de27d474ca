//! Processes killed at any instant, alone, in pairs and all three, on two rigs side by side: the others carry on,
//! restarted ones continue, and nothing is left behind. A few kills in every run; a thousand with `cargo test
//! --release --test live soak -- --ignored --nocapture`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crate::support::{Rig, end, signal, small_camera, until};
use rustix::process::{Pid, Signal, kill_process};
use semidense::service::health::ProcessState;
use semidense::service::peers::Peer;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::pose::PoseEstimate;
use semidense::wire::conversion::pose_from_message;
use semidense::wire::folders::SHARED_MEMORY;
use semidense::wire::message::PoseMessage;
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, Subscriber};
use semidense::wire::topic::{HEALTH_TOPICS, POSE};
use serde_json::Value;

/// Kills on each rig in every run of the tests.
const FEW_KILLS: usize = 10;
/// Kills on each rig of the long run.
const MANY_KILLS: usize = 500;
/// In the long run: share of the kills of processes that had all lived long enough after which poses resume in time.
const IN_TIME_RATIO: f64 = 0.99;
/// Upper limit for a gap in the poses that counts as in time.
const WITHOUT_POSES: Duration = Duration::from_secs(1);
/// Upper limit for the bytes that the supervisor may keep of a frame until the end: times. Its pose is in the journal.
const BYTES_OF_A_FRAME: f64 = 100.0;
/// The camera moves slowly back and forth: within the second that a restart may take it moves less than this between
/// two poses, in map units (about a room's depth).
const LARGEST_STEP: f64 = 0.5;
/// A process that dies sooner after its start is restarted with a growing delay.
const HASTY: Duration = Duration::from_secs(2);
/// Files are counted once unchanged for this long.
const SETTLED: Duration = Duration::from_secs(2);
/// Keyframes that a mapper keeps for its successor, plus one while it writes.
const MAX_KEPT_KEYFRAMES: usize = 21;
/// Factor on the initial memory of a process that it may reach: pages of other code, a fuller map.
const MEMORY_SLACK: f64 = 1.5;

/// Pseudo-random numbers, the same on every run (xorshift64).
struct Dice(u64);

impl Dice {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % bound
    }
}

/// Poses as seen by an observer, and the checks of each.
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
            // A pose sent by a dead tracker may be repeated with the history of its successor.
            assert!(pose.sequence >= last.sequence, "{} after {}", pose.sequence, last.sequence);
            let (stamp, before) = (pose.capture_nanos, last.capture_nanos);
            assert!(stamp > before || pose.sequence == last.sequence, "{stamp} after {before}");
        }
        if pose.state.is_tracked() {
            self.count += 1;
            self.epochs.insert(pose.epoch);
            if let Some(last) = self.last_tracked.filter(|last| last.epoch == pose.epoch) {
                let step = distance(&last.world_from_camera, &pose.world_from_camera);
                // After a longer gap the camera may have moved farther.
                let secs = (pose.capture_nanos - last.capture_nanos) as f64 * 1e-9;
                assert!(
                    step < LARGEST_STEP * secs.max(1.0),
                    "a jump of {step} from {} to {}",
                    described(&last),
                    described(&pose)
                );
            }
            self.last_tracked = Some(pose);
        }
        self.last = Some(pose);
    }

    /// Waits for three more claimed poses; returns how long that took.
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

/// The properties of a pose that explain its value.
fn described(pose: &PoseEstimate) -> String {
    let (quality, place) = (&pose.quality, pose.world_from_camera.translation);
    format!(
        "frame {}, epoch {}, {:?} on keyframe {} revision {} at {place:.3?}, in view {:.2}, inliers {:.2}, whitened \
         residual {:.2}",
        pose.sequence,
        pose.epoch,
        pose.state,
        pose.keyframe_id,
        pose.revision,
        quality.in_view_ratio,
        quality.inlier_ratio,
        quality.whitened_rmse
    )
}

fn distance(one: &SE3, other: &SE3) -> f64 {
    (one.translation - other.translation).norm()
}

/// Number of files of each kind in shared memory and in the folder: the names themselves differ with every process.
fn files(rig: &Rig) -> BTreeMap<String, usize> {
    let prefix = rig.place().prefix;
    let names = |folder: &Path| {
        let entries = fs::read_dir(folder).unwrap().flatten();
        entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect::<Vec<_>>()
    };
    let shared = names(Path::new(SHARED_MEMORY)).into_iter().filter(|n| n.starts_with(&prefix));
    let mut counts = BTreeMap::new();
    let mut keyframes = 0;
    for name in shared.chain(names(&rig.root())) {
        let kind = name.rsplit('.').next().unwrap_or_default().to_owned();
        // The keyframes before the active one that a mapper keeps, `NAME.checkpoint.ID`.
        match kind.parse::<u64>() {
            Ok(_) => keyframes += 1,
            Err(_) => *counts.entry(kind).or_default() += 1,
        }
    }
    assert!(keyframes <= 2 * MAX_KEPT_KEYFRAMES, "{keyframes} keyframes are kept of two rigs");
    counts
}

/// The files once nothing changes any more: a process that has just started still creates some, and the remains of
/// dead ones are removed a little later.
fn settled_files(rig: &Rig, watch: &mut Watch) -> BTreeMap<String, usize> {
    let mut last = files(rig);
    let mut since = Instant::now();
    until("files that stay", || {
        watch.look();
        let now = files(rig);
        if now != last {
            (last, since) = (now, Instant::now());
        }
        (since.elapsed() > SETTLED).then(|| last.clone())
    })
}

/// Whether there are no more files of any kind than before.
fn has_no_more(now: &BTreeMap<String, usize>, before: &BTreeMap<String, usize>) -> bool {
    now.iter().all(|(kind, count)| before.get(kind).is_some_and(|most| count <= most))
}

/// Shared memory in use, bytes.
fn shared_bytes(rig: &Rig) -> f64 {
    let prefix = rig.place().prefix;
    let entries = fs::read_dir(SHARED_MEMORY).unwrap().flatten();
    let ours = entries.filter(|e| e.file_name().to_string_lossy().starts_with(&prefix));
    ours.filter_map(|entry| Some(512.0 * entry.metadata().ok()?.blocks() as f64)).sum()
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

/// Every non-empty subset of the processes, by their indices in [`HEALTH_TOPICS`].
const VICTIMS: [&[usize]; 7] = [&[0], &[1], &[2], &[0, 1], &[0, 2], &[1, 2], &[0, 1, 2]];

/// One of the rigs: its run as seen by an observer.
struct Rigged {
    run: Child,
    output: PathBuf,
    watch: Watch,
    peers: Vec<Peer>,
    began: [Instant; 3],
}

impl Rigged {
    fn start(rig: &Rig, name: &str) -> Self {
        let output = rig.folder().join(name);
        // With enough draws, the same process is killed again within two seconds of its start six times in a row: no
        // reason to give up here.
        let mut command = rig.command(&["run", "--output", output.to_str().unwrap()]);
        for setting in small_camera(60) {
            command.args(["--set", &format!("simulator.{setting}")]);
        }
        command.args(["--live", "--source", "loop:1000000:30:sim", "--instance", name]);
        command.args(["--set", "supervisor.max_restarts=1000"]);
        // A file never fills up as a pipe would: many restarts print a lot.
        command.stderr(File::create(Self::said(&output)).unwrap());
        let run = command.spawn().unwrap();
        let place = Place::new(name, rig.root().to_str().unwrap()).unwrap();
        let hub = until("a run", || Hub::join(&place, "observer", Access::Observer).ok());
        let mut watch = Watch::new(&hub);
        watch.until_resumed("the first pose");
        let open = |topic| until("a process", || Peer::open(&hub, topic).ok());
        let peers = HEALTH_TOPICS.iter().map(open).collect();
        Self { run, output, watch, peers, began: [Instant::now(); 3] }
    }

    /// File with the run's standard error.
    fn said(output: &Path) -> PathBuf {
        output.with_extension("stderr")
    }

    fn name(victims: &[usize]) -> String {
        let names: Vec<_> = victims.iter().map(|&index| HEALTH_TOPICS[index].owner).collect();
        names.join(" + ")
    }

    fn wait(&mut self, period: Duration) {
        let begin = Instant::now();
        while begin.elapsed() < period {
            self.watch.look();
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Kills processes simultaneously and checks that poses resume; returns how long they were missing.
    fn kill(&mut self, victims: &[usize]) -> Pause {
        let has_lived = victims.iter().all(|&index| self.began[index].elapsed() > HASTY);
        let pids: Vec<u32> = victims.iter().map(|&index| pid_of(&mut self.peers[index])).collect();
        for &pid in &pids {
            // A process that its back-off has just replaced has another id by now.
            let _ = kill_process(Pid::from_raw(pid as i32).unwrap(), Signal::KILL);
        }
        let begin = Instant::now();
        let what = Self::name(victims);
        for (&index, pid) in victims.iter().zip(pids) {
            until(&format!("the process that takes the place of {what}"), || {
                self.watch.look();
                (self.peers[index].update().unwrap()?.process_id != pid).then_some(())
            });
            self.began[index] = Instant::now();
        }
        self.watch.until_resumed(&format!("poses after a kill of {what}"));
        Pause { victims: what, missing: begin.elapsed(), has_lived }
    }

    /// Resident memory of the supervisor and of the three processes, bytes.
    fn memory(&mut self) -> [f64; 2] {
        let peers = self.peers.iter_mut().map(|peer| resident(pid_of(peer)).unwrap_or(0.0));
        [resident(self.run.id()).unwrap(), peers.sum()]
    }

    /// Kills at `kills` random instants, and checks after each that everything continues.
    fn soak(&mut self, kills: usize, seed: u64) -> Vec<Pause> {
        let mut dice = Dice(seed);
        let mut pauses = Vec::new();
        for _ in 0..kills {
            // One in four waits until the victims have lived long enough to be restarted at once.
            let millis = dice.below(400) + if dice.below(4) == 0 { 2100 } else { 0 };
            self.wait(Duration::from_millis(millis));
            pauses.push(self.kill(VICTIMS[dice.below(VICTIMS.len() as u64) as usize]));
        }
        pauses
    }

    /// Ends the run; the summary includes the counts of processes that died.
    fn end(self) {
        let (run, output, epochs) = (self.run, self.output, self.watch.epochs.clone());
        drop((self.peers, self.watch));
        signal(&run, Signal::INT);
        let ended = end(run);
        let said = fs::read_to_string(Self::said(&output)).unwrap();
        assert_eq!(ended.status.code(), Some(130), "{said}");
        let summary = fs::read_to_string(output.join("summary.json")).unwrap();
        let summary: Value = serde_json::from_str(&summary).unwrap();
        let of = |name: &str| summary[name].as_u64().unwrap();
        assert!(of("frames_in") >= of("frames_tracked") + of("frames_initializing"), "{summary}");
        // Joined epochs are one at the end: the epochs in the file count.
        let trajectory = fs::read_to_string(output.join("trajectory.txt")).unwrap();
        let marks = trajectory.lines().filter(|line| line.starts_with("# epoch "));
        let written = marks.collect::<BTreeSet<_>>().len().max(1);
        assert_eq!(of("epochs"), written as u64, "epochs are counted: {epochs:?}");
        assert!(written <= epochs.len(), "{epochs:?}");
    }
}

/// Where the two rigs wait for each other; a failed one does not keep the other waiting.
#[derive(Default)]
struct Meeting(AtomicUsize);

impl Meeting {
    const FAILED: usize = 1 << 20;

    fn wait(&self, count: usize, watch: &mut Watch) {
        self.0.fetch_add(1, Ordering::SeqCst);
        while self.0.load(Ordering::SeqCst) < count {
            watch.look();
            std::thread::sleep(Duration::from_millis(2));
        }
        assert!(self.0.load(Ordering::SeqCst) < Self::FAILED, "the other rig failed");
    }
}

struct Leaves<'a>(&'a Meeting);

impl Drop for Leaves<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.0.fetch_add(Meeting::FAILED, Ordering::SeqCst);
        }
    }
}

/// Two rigs in one folder side by side, `kills` kills on each; returns the pauses of both.
fn soak(kills: usize, seed: u64) -> Vec<Pause> {
    let rig = Rig::new();
    let meeting = Meeting::default();
    let soak_one = |name: &str, seed: u64| {
        let _leaves = Leaves(&meeting);
        let mut rigged = Rigged::start(&rig, name);
        // Connections depend on which process started last: kill each once in a known order, now and at the end.
        let in_order = |rigged: &mut Rigged| (0..3).for_each(|index| drop(rigged.kill(&[index])));
        in_order(&mut rigged);
        meeting.wait(2, &mut rigged.watch);
        let files_before = settled_files(&rig, &mut rigged.watch);
        let shared_before = shared_bytes(&rig);
        let memory_before = rigged.memory();
        meeting.wait(4, &mut rigged.watch);
        let pauses = rigged.soak(kills, seed);
        in_order(&mut rigged);
        meeting.wait(6, &mut rigged.watch);
        until("the leftovers of the dead to be gone", || {
            rigged.watch.look();
            let is_gone = has_no_more(&files(&rig), &files_before);
            if !is_gone {
                std::thread::sleep(Duration::from_millis(200));
            }
            is_gone.then_some(())
        });
        let (memory, shared) = (rigged.memory(), shared_bytes(&rig));
        let poses = rigged.watch.count as f64;
        say(&format!(
            "{name}: {poses} poses, {} epochs; MB before and after: supervisor {:.1} {:.1}, processes {:.1} {:.1}, \
             shared memory of both rigs {:.1} {:.1}",
            rigged.watch.epochs.len(),
            memory_before[0] / 1e6,
            memory[0] / 1e6,
            memory_before[1] / 1e6,
            memory[1] / 1e6,
            shared_before / 1e6,
            shared / 1e6
        ));
        let kept = MEMORY_SLACK * memory_before[0] + BYTES_OF_A_FRAME * poses;
        assert!(memory[0] < kept, "the supervisor grows: {memory_before:?} → {memory:?}");
        assert!(memory[1] < MEMORY_SLACK * memory_before[1], "{memory_before:?} → {memory:?}");
        assert!(shared < MEMORY_SLACK * shared_before, "{shared_before} → {shared}");
        meeting.wait(8, &mut rigged.watch);
        rigged.end();
        pauses
    };
    let mut pauses = std::thread::scope(|scope| {
        let other = scope.spawn(|| soak_one("left", seed));
        let mut pauses = soak_one("right", seed.rotate_left(17));
        pauses.extend(other.join().unwrap());
        pauses
    });
    assert_eq!(rig.leftovers(), Vec::<String>::new());
    pauses.sort_by_key(|pause| pause.missing);
    report(&pauses);
    pauses
}

/// Gap in the poses after a kill.
struct Pause {
    victims: String,
    missing: Duration,
    /// Whether all victims had lived long enough to be restarted at once.
    has_lived: bool,
}

/// The runner swallows `println!`; a closed standard error must not fail a test.
fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Prints how long poses were missing, in the order of the pauses.
fn report(pauses: &[Pause]) {
    let figures = |what: &str, chosen: &dyn Fn(&&Pause) -> bool| {
        let times: Vec<f64> =
            pauses.iter().filter(chosen).map(|pause| pause.missing.as_secs_f64()).collect();
        let Some(longest) = times.last() else { return };
        let at = |share: f64| times[((times.len() - 1) as f64 * share).round() as usize];
        let (median, p99, kills) = (at(0.5), at(0.99), times.len());
        say(&format!(
            "{what}: {kills} kills, poses back after {median:.2} s median, {p99:.2} p99, {longest:.2} max"
        ));
    };
    for has_lived in [true, false] {
        let start = if has_lived { "at once" } else { "with back-off" };
        for victims in VICTIMS.map(Rigged::name) {
            figures(&format!("{victims}, started again {start}"), &|pause| {
                pause.victims == victims && pause.has_lived == has_lived
            });
        }
        figures(&format!("all started again {start}"), &|pause| pause.has_lived == has_lived);
    }
    figures("all", &|_| true);
}

#[test]
fn a_stalled_source_is_reported_and_recovers_on_its_own() {
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
#[ignore = "takes a quarter of an hour and a machine of its own: it asserts times"]
fn a_thousand_kills_change_nothing() {
    let pauses = soak(MANY_KILLS, 0x5eed_0002);
    let lived: Vec<&Pause> = pauses.iter().filter(|pause| pause.has_lived).collect();
    let in_time = lived.iter().filter(|pause| pause.missing < WITHOUT_POSES).count();
    let ratio = in_time as f64 / lived.len() as f64;
    assert!(ratio >= IN_TIME_RATIO, "{in_time} of {} in time", lived.len());
}
