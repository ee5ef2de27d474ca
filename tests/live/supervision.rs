//! How a supervised run deals with processes that die together, hang, or lose their memory, and with signals to
//! itself.

use std::collections::BTreeMap;
use std::fs;
use std::io::{PipeReader, PipeWriter, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::process::Child;
use std::thread::JoinHandle;
use std::time::Duration;

use crate::support::{
    Ended, Rig, WATCH_DOG, end, finish, journal_of, signal, small_camera, until, with_mount,
};
use rustix::fs::{Mode, OFlags, fcntl_getfl, fcntl_setfl};
use rustix::process::{Pid, Signal, kill_process};
use semidense::service::peers::Peer;
use semidense::wire::command::{Command, CommandClient};
use semidense::wire::message::{GraphHeader, KeyframePoseMessage, SimilarityMessage};
use semidense::wire::port::{Hub, Subscriber};
use semidense::wire::topic::GRAPH;
use semidense::wire::topic::HEALTH_TOPICS;
use serde_json::Value;

const CAPTURE: usize = 0;
const TRACKER: usize = 1;
const MAPPER: usize = 2;

/// A live run of ten seconds and its processes as seen by an observer.
struct Live {
    rig: Rig,
    run: Child,
    peers: Vec<Peer>,
    hub: Hub,
}

/// Frames of the source: ten seconds at 30 Hz.
const FRAMES: u64 = 300;

impl Live {
    fn start(arguments: &[&str]) -> Self {
        Self::start_in(Rig::new(), arguments)
    }

    fn start_in(rig: Rig, arguments: &[&str]) -> Self {
        let source = format!("loop:{FRAMES}:30:sim");
        let mut command = rig.run(40, &["--live", "--source", &source]);
        let run = command.args(arguments).spawn().unwrap();
        Self::watch(rig, run)
    }

    fn watch(rig: Rig, run: Child) -> Self {
        let hub = rig.observe();
        let open = |topic| until("a process", || Peer::open(&hub, topic).ok());
        let peers = HEALTH_TOPICS.iter().map(open).collect();
        Self { rig, run, peers, hub }
    }

    fn until_frames(&mut self, process: usize, frames: u64) {
        until("frames", || (self.peers[process].update().unwrap()?.frames >= frames).then_some(()));
    }

    fn pid(&mut self, process: usize) -> Pid {
        let id = until("a process", || self.peers[process].update().unwrap().map(|h| h.process_id));
        Pid::from_raw(id as i32).unwrap()
    }

    fn send(&mut self, processes: &[usize], signal: Signal) {
        let pids: Vec<Pid> = processes.iter().map(|&process| self.pid(process)).collect();
        pids.iter().for_each(|&pid| kill_process(pid, signal).unwrap());
    }

    fn until_replaced(&mut self, process: usize, before: Pid) {
        until("the process that takes its place", || {
            let id = self.peers[process].update().unwrap()?.process_id;
            (Pid::from_raw(id as i32) != Some(before)).then_some(())
        });
    }

    /// Waits for the end; returns exit code, standard error and the summary.
    fn end(self) -> (Option<i32>, String, Value, Rig) {
        drop((self.peers, self.hub));
        let ended = end(self.run);
        let text = fs::read_to_string(self.rig.output().join("summary.json")).unwrap_or_default();
        let summary = serde_json::from_str(&text).unwrap_or(Value::Null);
        assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
        assert_eq!(self.rig.leftovers(), Vec::<String>::new());
        (ended.status.code(), ended.stderr, summary, self.rig)
    }
}

/// Stamps of the poses as published, in the order of the file.
fn stamps(rig: &Rig) -> Vec<f64> {
    let text = fs::read_to_string(rig.output().join("trajectory_online.txt")).unwrap();
    let poses = text.lines().filter(|line| !line.starts_with('#'));
    poses.map(|line| line.split_whitespace().next().unwrap().parse().unwrap()).collect()
}

/// Whichever processes die, the source continues from its position: no frame is repeated and no stamp decreases.
fn kills_do_not_rewind(processes: &[usize]) {
    let mut live = Live::start(&[]);
    live.until_frames(TRACKER, 90);
    live.send(processes, Signal::KILL);
    let (code, stderr, summary, rig) = live.end();
    assert_eq!(code, Some(0), "{stderr}");
    let stamps = stamps(&rig);
    assert!(stamps.is_sorted_by(|one, next| one < next), "{stamps:?}");
    // The first of the loop has the stamp of one period.
    assert!(stamps.last().unwrap() <= &(FRAMES as f64 / 30.0 + 1e-3), "{stamps:?}");
    assert_eq!(summary["restarts"], processes.len(), "{summary}");
    for &process in processes {
        assert_eq!(summary["restarts_by_process"][HEALTH_TOPICS[process].owner], 1, "{summary}");
    }
    assert!(summary["restart_causes"][0]["cause"].as_str().unwrap().contains("SIGKILL"));
    // All were sent, except for those that a dying process was handling.
    let frames_in = summary["frames_in"].as_u64().unwrap();
    assert!((FRAMES - 2..=FRAMES).contains(&frames_in), "{summary}");
}

/// Such runs mostly wait: several together take no longer than one.
fn at_once(scenarios: &[(&str, &(dyn Fn() + Sync))]) {
    std::thread::scope(|scope| {
        for (name, run) in scenarios {
            // A panic prints the name of its thread.
            let thread = std::thread::Builder::new().name((*name).to_owned());
            thread.spawn_scoped(scope, run).unwrap();
        }
    });
}

#[test]
fn dead_processes_are_restarted() {
    at_once(&[
        ("capture and tracker", &|| kills_do_not_rewind(&[CAPTURE, TRACKER])),
        ("all three", &|| kills_do_not_rewind(&[CAPTURE, TRACKER, MAPPER])),
        ("estimate", &a_mapper_that_dies_during_an_estimate_leaves_a_map_as_it_was_published),
        ("numbers", &a_mapper_that_dies_before_it_numbers_anything_leaves_the_first_numbers),
        ("status", &status_knows_the_age_of_the_run_and_its_keyframes_whoever_died_or_is_stopped),
    ]);
}

#[test]
fn hanging_processes_are_restarted_and_reported() {
    at_once(&[
        ("capture", &|| a_hanging_process_is_started_again(CAPTURE)),
        ("tracker", &|| a_hanging_process_is_started_again(TRACKER)),
        ("mapper", &|| a_hanging_process_is_started_again(MAPPER)),
        ("lockstep", &a_process_that_hangs_in_lockstep_ends_the_run_with_its_name),
        ("end", &a_mapper_that_hangs_at_the_end_does_not_hold_up_the_results),
        ("slow disk", &a_mapper_that_writes_its_map_to_a_slow_disk_is_let_alone),
    ]);
}

#[test]
fn outside_interference_does_not_affect_a_run() {
    at_once(&[
        ("closed terminal", &a_closed_terminal_ends_a_run_with_its_results),
        ("unread standard error", &a_standard_error_that_nobody_reads_holds_nothing_up),
        ("replaced file", &a_run_whose_program_was_replaced_starts_it_again),
        ("full shared memory", &shared_memory_that_others_fill_costs_a_run_nothing),
    ]);
}

fn a_closed_terminal_ends_a_run_with_its_results() {
    let mut live = Live::start(&[]);
    live.until_frames(TRACKER, 60);
    signal(&live.run, Signal::HUP);
    let (code, stderr, summary, rig) = live.end();
    assert_eq!(code, Some(130), "{stderr}");
    assert!(summary["frames_in"].as_u64().unwrap() >= 60, "{summary}");
    assert!(rig.output().join("map.ply").exists());
}

#[test]
fn a_replay_ended_by_any_signal_keeps_its_results() {
    at_once(&[
        ("interrupted", &|| ends_with_results(Signal::INT)),
        ("terminated", &|| ends_with_results(Signal::TERM)),
        ("hung up", &|| ends_with_results(Signal::HUP)),
    ]);
}

fn ends_with_results(ending: Signal) {
    let rig = Rig::new();
    let output = rig.output();
    let arguments = ["replay", "loop:1000000:30:sim", "--output", output.to_str().unwrap()];
    let mut command = rig.command(&arguments);
    for setting in small_camera(20) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    let replay = command.spawn().unwrap();
    // A signal before the first pose ends it without results and by another code path.
    journal_of(&output, 60);
    signal(&replay, ending);
    let ended = end(replay);
    assert_eq!(ended.status.code(), Some(130), "{ending:?}: {}", ended.stderr);
    let poses = fs::read_to_string(output.join("trajectory.txt")).unwrap();
    assert!(poses.lines().filter(|line| !line.starts_with('#')).count() > 20, "{ending:?}");
}

/// A full pipe, and its reader, which does not read.
fn full_pipe() -> (PipeReader, PipeWriter) {
    let (reader, mut writer) = std::io::pipe().unwrap();
    let blocking = fcntl_getfl(&writer).unwrap();
    fcntl_setfl(&writer, blocking | OFlags::NONBLOCK).unwrap();
    while writer.write(b"x").is_ok() {}
    fcntl_setfl(&writer, blocking).unwrap();
    (reader, writer)
}

fn a_standard_error_that_nobody_reads_holds_nothing_up() {
    let (unread, full) = full_pipe();
    let rig = Rig::new();
    let mut command = rig.run(40, &["--live", "--source", "loop:1000000:30:sim"]);
    let run = command.stderr(full).spawn().unwrap();
    drop(command);
    let mut live = Live::watch(rig, run);
    live.until_frames(TRACKER, 90);
    let before = live.pid(TRACKER);
    live.send(&[TRACKER], Signal::KILL);
    live.until_replaced(TRACKER, before);
    live.until_frames(TRACKER, 30);
    signal(&live.run, Signal::INT);
    let (code, _, summary, _rig) = live.end();
    drop(unread);
    assert_eq!(code, Some(130));
    assert_eq!(summary["restarts_by_process"]["tracker"], 1, "{summary}");
}

/// Checks that a hanging process is killed and restarted, and that the summary gives the reason.
fn a_hanging_process_is_started_again(process: usize) {
    let mut live = Live::start(&["--set", "supervisor.watchdog_s=2"]);
    live.until_frames(TRACKER, 45);
    let stopped = live.pid(process);
    live.send(&[process], Signal::STOP);
    live.until_replaced(process, stopped);
    let (code, stderr, summary, rig) = live.end();
    assert_eq!(code, Some(0), "{stderr}");
    let cause = summary["restart_causes"][0]["cause"].as_str().unwrap_or_default();
    assert!(cause.contains("was stopped"), "{summary}");
    assert!(cause.starts_with(HEALTH_TOPICS[process].owner), "{summary}");
    assert!(stamps(&rig).is_sorted_by(|one, next| one < next));
}

fn a_process_that_hangs_in_lockstep_ends_the_run_with_its_name() {
    let rig = Rig::new();
    let watchdog = ["--set", "supervisor.watchdog_s=2"];
    let mut command = rig.run(40, &["--lockstep", "--source", "loop:1000000:30:sim"]);
    let mut run = command.args(watchdog).spawn().unwrap();
    let hub = rig.observe();
    let mut tracker = until("the tracker", || Peer::open(&hub, &HEALTH_TOPICS[TRACKER]).ok());
    let id = until("frames", || {
        let is_over = run.try_wait().unwrap().is_some();
        let health = tracker.update().unwrap().filter(|health| health.frames > 5);
        (is_over || health.is_some()).then(|| health.map(|health| health.process_id))
    });
    let Some(id) = id else { panic!("the run has ended before: {}", end(run).stderr) };
    kill_process(Pid::from_raw(id as i32).unwrap(), Signal::STOP).unwrap();
    drop((tracker, hub));
    let ended = end(run);
    assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
    assert!(ended.stderr.contains("error: tracker was stopped"), "{}", ended.stderr);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

fn a_mapper_that_hangs_at_the_end_does_not_hold_up_the_results() {
    let mut live = Live::start(&[]);
    let begun = until("a keyframe", || {
        let health = live.peers[MAPPER].update().unwrap()?;
        (health.total > 0).then_some(health.frames)
    });
    live.until_frames(MAPPER, begun + 60);
    // More than a second of mapping: there is a checkpoint.
    live.send(&[MAPPER], Signal::STOP);
    signal(&live.run, Signal::INT);
    let (code, stderr, summary, _rig) = live.end();
    assert_eq!(code, Some(130), "{stderr}");
    assert!(summary["keyframes"].as_u64().unwrap() > 0, "the checkpoint serves: {summary}");
}

/// A disk that accepts a few kilobytes per second: a pipe in place of the file that the mapper writes.
fn slow_disk(path: &Path) -> JoinHandle<usize> {
    rustix::fs::mkfifoat(rustix::fs::CWD, path, Mode::RUSR | Mode::WUSR).unwrap();
    let mut options = fs::OpenOptions::new();
    options.read(true).write(true).custom_flags(OFlags::NONBLOCK.bits() as i32);
    let mut pipe = options.open(path).unwrap();
    let name = path.to_owned();
    std::thread::spawn(move || {
        let (mut taken, mut bytes) = (0, [0; 2048]);
        // Renamed once it is complete.
        while name.exists() {
            // No data yet, or no more.
            taken += pipe.read(&mut bytes).unwrap_or(0);
            std::thread::sleep(Duration::from_millis(40));
        }
        taken
    })
}

fn a_mapper_that_writes_its_map_to_a_slow_disk_is_let_alone() {
    let mut live = Live::start(&["--set", "supervisor.watchdog_s=2"]);
    live.until_frames(MAPPER, 90);
    let mapper = live.pid(MAPPER).as_raw_nonzero();
    let map = live.rig.folder().join("map.bin");
    let disk = slow_disk(&live.rig.folder().join(format!(".map.bin.{mapper}.tmp")));
    let commands = CommandClient::open(&live.hub).unwrap();
    commands.ask(&Command::SaveMap(map), WATCH_DOG, || true).unwrap();
    drop(commands);
    // Twice as much as it accepts within the watchdog's time.
    let taken = disk.join().unwrap();
    assert!(taken > 200_000, "{taken} bytes");
    let (code, stderr, summary, _rig) = live.end();
    assert_eq!(code, Some(0), "{stderr}");
    assert_eq!(summary["restarts"], 0, "{summary}");
}

fn a_mapper_that_dies_before_it_numbers_anything_leaves_the_first_numbers() {
    let mut live = Live::start(&[]);
    let before = live.pid(MAPPER);
    live.send(&[MAPPER], Signal::KILL);
    live.until_replaced(MAPPER, before);
    let (code, stderr, summary, rig) = live.end();
    assert_eq!(code, Some(0), "{stderr}");
    assert_eq!(summary["restarts"], 1, "{summary}");
    assert_eq!(summary["epoch"], 0, "{summary}");
    let keyframes = fs::read_to_string(rig.output().join("keyframes.txt")).unwrap();
    let first = keyframes.lines().find(|line| !line.starts_with('#')).unwrap();
    const KEYFRAME_ID: usize = 9;
    assert_eq!(first.split_whitespace().nth(KEYFRAME_ID), Some("0"), "{first}");
}

/// Poses of the keyframes of an epoch, by id.
type Places = BTreeMap<u64, SimilarityMessage>;

/// Every graph published since the last call.
fn graphs(graph: &Subscriber<KeyframePoseMessage, GraphHeader>) -> Vec<(GraphHeader, Places)> {
    let next = || graph.receive().unwrap();
    let received = std::iter::from_fn(next).map(|message| {
        let places = message.payload().iter().map(|of| (of.keyframe_id, of.map_from_keyframe));
        (*message.header(), places.collect())
    });
    received.collect()
}

fn a_mapper_that_dies_during_an_estimate_leaves_a_map_as_it_was_published() {
    // Slow estimates, so that each death falls into one.
    let slow = ["--live", "--set", "mapping.window.max_first_iterations=200"];
    let rig = Rig::new();
    let run = rig.run(450, &slow).spawn().unwrap();
    let mut live = Live::watch(rig, run);
    let graph = until("the graph", || live.hub.subscriber(&GRAPH).ok());
    let mut published: Vec<(GraphHeader, Places)> = Vec::new();
    for least in [3, 4] {
        // An estimate starts once its keyframe has been published; the map is at most one keyframe older, and the
        // graph of that has been seen too.
        let (mut known, mut new_ones) = (0, 0);
        until("two new keyframes", || {
            let new = graphs(&graph);
            let largest = new.iter().map(|(_, places)| places.len()).max().unwrap_or(0);
            new_ones += u32::from(known > 0 && largest > known);
            known = known.max(largest);
            published.extend(new);
            (new_ones >= 2 && known >= least).then_some(())
        });
        let before = live.pid(MAPPER);
        // Messages it has sent are lost with it, so they are read first.
        live.send(&[MAPPER], Signal::STOP);
        std::thread::sleep(Duration::from_millis(50));
        published.extend(graphs(&graph));
        live.send(&[MAPPER], Signal::KILL);
        live.until_replaced(MAPPER, before);
        let newest = published.iter().map(|(header, _)| header.revision).max().unwrap();
        // The successor skips numbers.
        let successor = until("the successor's graph", || {
            let new = graphs(&graph);
            let first = new.iter().find(|(header, _)| header.revision > newest + 1000).cloned();
            published.extend(new.into_iter().filter(|(header, _)| header.revision <= newest));
            first
        });
        let (header, places) = &successor;
        assert_eq!(header.epoch, published.last().unwrap().0.epoch);
        assert!(places.len() + 1 >= least, "at most the newest is lost: {places:?}");
        // The unit of a keyframe follows its depth between two graphs, its pose does not.
        let pose = |place: &SimilarityMessage| [0, 1, 2, 3, 4, 5, 6].map(|k| place[k]);
        let is_like = |(_, of): &(GraphHeader, Places)| {
            places.iter().all(|(id, place)| of.get(id).map(pose) == Some(pose(place)))
        };
        assert!(published.iter().any(is_like), "{places:?} were never published so");
        published.push(successor);
    }
    drop(graph);
    let (code, stderr, summary, _rig) = live.end();
    assert_eq!(code, Some(0), "{stderr}");
    assert_eq!((&summary["restarts"], &summary["epoch"]), (&Value::from(2), &Value::from(0)));
}

/// Runs `script` in a shell with a separate /dev/shm of `megabytes`.
fn with_shared_memory(rig: &Rig, megabytes: u32, script: &str) -> Option<Ended> {
    let mount = format!("mount -t tmpfs -o size={megabytes}m tmpfs /dev/shm");
    with_mount(rig, &mount, script)
}

/// Options of a small live run, for a shell.
const SMALL: &str = "--live --source loop:300:30:sim --output $OUTPUT --set simulator.frames=40 \
     --set simulator.width=160 --set simulator.height=120 --set simulator.focal_px=131.0";

fn shared_memory_that_others_fill_costs_a_run_nothing() {
    let rig = Rig::new();
    // Another process takes whatever is left once frames arrive.
    let script = format!(
        "$SEMIDENSE run {SMALL} & run=$!; \
         until $SEMIDENSE status --once --json 2>/dev/null | grep -q '\"mapping\"' || ! kill -0 $run; \
         do sleep 0.2; done; \
         dd if=/dev/zero of=/dev/shm/foreign bs=64k 2>/dev/null; \
         $SEMIDENSE status --once >&2; echo status $? >&2; wait $run"
    );
    let Some(ended) = with_shared_memory(&rig, 64, &script) else { return };
    assert_eq!(ended.status.code(), Some(0), "{}", ended.stderr);
    assert!(!ended.stderr.contains("SIGBUS"), "{}", ended.stderr);
    // There is no room for a new process, which is reported.
    assert!(ended.stderr.contains("status 1"), "{}", ended.stderr);
    assert!(ended.stderr.contains("error: /dev/shm has only 0 MB free"), "{}", ended.stderr);
    let summary = fs::read_to_string(rig.output().join("summary.json")).unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["restarts"], 0, "{summary}");
    assert_eq!(summary["frames_in"], 300, "{summary}");
}

#[test]
fn shared_memory_that_is_too_small_is_reported_in_one_line_at_the_start() {
    let rig = Rig::new();
    for megabytes in [1, 10, 24] {
        let script = format!("$SEMIDENSE run {SMALL}");
        let Some(ended) = with_shared_memory(&rig, megabytes, &script) else { return };
        assert_eq!(ended.status.code(), Some(1), "{megabytes} MB: {}", ended.stderr);
        let errors: Vec<_> = ended.stderr.lines().filter(|l| l.starts_with("error: ")).collect();
        assert_eq!(errors.len(), 1, "{}", ended.stderr);
        assert!(errors[0].contains("/dev/shm"), "{}", ended.stderr);
    }
}

/// One output of `status` for a live run.
fn status(rig: &Rig) -> Value {
    let ended = finish(rig.command(&["status", "--once", "--json"]));
    assert!(ended.status.success(), "{}", ended.stderr);
    serde_json::from_str(&ended.stdout).unwrap()
}

fn status_knows_the_age_of_the_run_and_its_keyframes_whoever_died_or_is_stopped() {
    let mut live = Live::start(&[]);
    live.until_frames(MAPPER, 60);
    let all = [CAPTURE, TRACKER, MAPPER];
    let before = all.map(|process| live.pid(process));
    live.send(&all, Signal::KILL);
    all.iter().for_each(|&process| live.until_replaced(process, before[process]));
    live.until_frames(MAPPER, 30);
    live.send(&[MAPPER], Signal::STOP);
    let status = status(&live.rig);
    live.send(&[MAPPER], Signal::CONT);
    assert_eq!(status["mapper"]["state"], "stopped", "{status}");
    assert!(status["keyframes"].as_u64().is_some_and(|keyframes| keyframes > 0), "{status}");
    let up = |value: &Value| value["uptime_secs"].as_f64().unwrap();
    // They were killed at least two seconds after the start.
    assert!(up(&status) > up(&status["capture"]) + 1.0, "{status}");
    let sent = &status["capture"]["latency_ms"];
    assert!(sent["p50"].as_f64() <= sent["p99"].as_f64() && sent["p50"].is_number(), "{status}");
    let (code, stderr, summary, _) = live.end();
    assert_eq!(code, Some(0), "{stderr}");
    assert!(summary["send_ms"]["p99"].as_f64().unwrap() > 0.0, "{summary}");
}

fn a_run_whose_program_was_replaced_starts_it_again() {
    let rig = Rig::new();
    let source = format!("loop:{FRAMES}:30:sim");
    let command = rig.run(40, &["--live", "--source", &source]);
    let copy = rig.folder().join("semidense");
    fs::copy(command.get_program(), &copy).unwrap();
    let mut of_copy = std::process::Command::new(&copy);
    of_copy.args(command.get_args()).env("SEMIDENSE_ROOT", rig.root());
    let piped = std::process::Stdio::piped;
    let run = of_copy.stdin(std::process::Stdio::null()).stdout(piped()).stderr(piped());
    let mut live = Live::watch(rig, run.spawn().unwrap());
    live.until_frames(TRACKER, 30);
    fs::remove_file(&copy).unwrap();
    let before = live.pid(TRACKER);
    live.send(&[TRACKER], Signal::KILL);
    live.until_replaced(TRACKER, before);
    let (code, stderr, summary, _rig) = live.end();
    assert_eq!(code, Some(0), "{stderr}");
    assert_eq!(summary["restarts"], 1, "{summary}");
}
