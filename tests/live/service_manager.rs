//! Notifications of the three processes to the service manager: READY, STATUS, and WATCHDOG from the frame loop
//! itself. The manager is a socket of the test.

use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::process::Child;

use crate::support::{Rig, WATCH_DOG, finish, signal, small_camera, until};
use rustix::process::Signal;
use semidense::wire::command::{Command, CommandClient};
use semidense::wire::message::{GraphHeader, KeyframePoseMessage};
use semidense::wire::port::Subscriber;
use semidense::wire::topic::GRAPH;

/// Time that the manager allows between two heartbeats: loops wake ten times a second.
const WATCHDOG_US: &str = "800000";
/// Number of heartbeats to wait for.
const BEATS: usize = 5;

/// The manager of one process, and the messages it has received.
struct Manager {
    socket: UnixDatagram,
    heard: Vec<String>,
    child: Child,
}

impl Manager {
    /// Starts a process as a service manager would.
    fn start(rig: &Rig, arguments: &[&str]) -> Self {
        let path = rig.folder().join(format!("{}.notify", arguments[0]));
        // Of the one before it.
        drop(std::fs::remove_file(&path));
        let socket = UnixDatagram::bind(&path).unwrap();
        socket.set_nonblocking(true).unwrap();
        let mut command = rig.command(arguments);
        for setting in small_camera(40) {
            command.args(["--set", &format!("simulator.{setting}")]);
        }
        command.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", WATCHDOG_US);
        Self { socket, heard: Vec::new(), child: command.spawn().unwrap() }
    }

    fn listen(&mut self) {
        let mut bytes = [0; 4096];
        loop {
            match self.socket.recv(&mut bytes) {
                Ok(length) => self.heard.push(String::from_utf8(bytes[..length].to_vec()).unwrap()),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                Err(error) => panic!("{error}"),
            }
        }
    }

    /// Waits until a message received from the index `from` on satisfies `is`.
    fn until_heard(&mut self, from: usize, what: &str, is: impl Fn(&str) -> bool) {
        until(what, || {
            self.listen();
            self.heard[from..].iter().any(|message| is(message)).then_some(())
        });
    }

    fn until_beats(&mut self, count: usize) {
        let before = self.beats();
        until("heartbeats", || {
            self.listen();
            (self.beats() >= before + count).then_some(())
        });
    }

    fn beats(&self) -> usize {
        self.heard.iter().filter(|message| *message == "WATCHDOG=1").count()
    }

    fn says(&self, message: &str) -> bool {
        self.heard.iter().any(|heard| heard == message)
    }

    /// Ends the process, and listens until it has ended: a socket holds few messages.
    fn stop(mut self) -> Vec<String> {
        self.listen();
        signal(&self.child, Signal::TERM);
        until("its end", || {
            self.listen();
            self.child.try_wait().unwrap()
        });
        self.listen();
        std::mem::take(&mut self.heard)
    }
}

impl Drop for Manager {
    fn drop(&mut self) {
        // Of a test that fails.
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

#[test]
fn all_three_report_ready_and_their_state_and_beat_while_a_source_stalls() {
    let rig = Rig::new();
    let mut tracker = Manager::start(&rig, &["tracker", "--live"]);
    let mut mapper = Manager::start(&rig, &["mapper", "--live"]);
    for waiting in [&mut tracker, &mut mapper] {
        waiting.until_heard(0, "READY", |message| message == "READY=1");
        waiting.until_heard(0, "a status", |message| message.starts_with("STATUS=ready"));
        // No process sends a frame.
        waiting.until_beats(BEATS);
    }
    let source = ["capture", "--live", "--source", "loop:1000000:20:sim"];
    let mut capture = Manager::start(&rig, &source);
    for at_work in [&mut capture, &mut tracker, &mut mapper] {
        at_work.until_heard(0, "frames in a second", |message| {
            message.starts_with("STATUS=running") && !message.contains("(0.0 frames/s")
        });
        at_work.until_beats(BEATS);
        assert!(at_work.says("READY=1"));
    }
    let ready = capture.heard.iter().position(|message| message == "READY=1").unwrap();
    let beat = capture.heard.iter().rposition(|message| message == "WATCHDOG=1").unwrap();
    assert!(ready < beat, "{:?}", capture.heard);

    // A stalled source: its readers report it and live on; the hanging process does not beat.
    signal(&capture.child, Signal::STOP);
    for reader in [&mut tracker, &mut mapper] {
        let from = reader.heard.len();
        reader.until_heard(from, "a stale source", |message| message.starts_with("STATUS=stale"));
        capture.listen();
        let stopped = capture.beats();
        reader.until_beats(BEATS);
        capture.listen();
        assert_eq!(capture.beats(), stopped, "a stopped process beats");
    }
    signal(&capture.child, Signal::CONT);
    for reader in [&mut tracker, &mut mapper] {
        let from = reader.heard.len();
        reader.until_heard(from, "recovery", |message| message.starts_with("STATUS=running"));
    }
    for process in [capture, tracker, mapper] {
        let heard = process.stop();
        assert!(heard.iter().any(|message| message == "STOPPING=1"), "{heard:?}");
        assert_eq!(heard.iter().filter(|message| *message == "READY=1").count(), 1);
        assert!(heard.iter().all(|message| message.lines().count() == 1), "{heard:?}");
    }
    assert!(rig.leftovers().is_empty());
}

#[test]
fn the_children_of_a_supervisor_do_not_notify_its_manager() {
    let rig = Rig::new();
    let path = rig.folder().join("run.notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_nonblocking(true).unwrap();
    let mut command = rig.run(20, &[]);
    command.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", WATCHDOG_US);
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    let nothing = socket.recv(&mut [0; 64]).unwrap_err();
    assert_eq!(nothing.kind(), ErrorKind::WouldBlock);
}

#[test]
fn a_mapper_that_has_written_its_map_reports_its_usual_state_again() {
    let rig = Rig::new();
    let mut mapper = Manager::start(&rig, &["mapper", "--live"]);
    mapper.until_heard(0, "a status", |message| message.starts_with("STATUS=ready ("));
    let commands = CommandClient::open(&rig.observe()).unwrap();
    let map = rig.folder().join("map.bin");
    let from = mapper.heard.len();
    commands.ask(&Command::SaveMap(map.clone()), WATCH_DOG, || true).unwrap();
    assert!(map.exists());
    mapper.until_heard(from, "its writing", |message| {
        message.starts_with("STATUS=running: the map is being written")
    });
    mapper.until_heard(from, "what it did before", |message| message.starts_with("STATUS=ready ("));
    drop(commands);
    mapper.stop();
}

/// The newest graph, once it has at least so many keyframes: its epoch and their numbers.
fn graph(graphs: &Subscriber<KeyframePoseMessage, GraphHeader>, least: usize) -> (u32, Vec<u64>) {
    until("a graph", || {
        let newest = graphs.newest().unwrap()?;
        let ids: Vec<u64> = newest.payload().iter().map(|of| of.keyframe_id).collect();
        (ids.len() >= least).then_some((newest.header().epoch, ids))
    })
}

#[test]
fn a_mapper_that_is_restarted_alone_continues_its_map() {
    let rig = Rig::new();
    let tracker = Manager::start(&rig, &["tracker", "--live"]);
    let mut mapper = Manager::start(&rig, &["mapper", "--live"]);
    let capture = Manager::start(&rig, &["capture", "--live", "--source", "loop:1000000:20:sim"]);
    mapper.until_heard(0, "a map", |message| message.starts_with("STATUS=running: mapping"));
    let hub = rig.observe();
    let graphs = hub.subscriber(&GRAPH).unwrap();
    let (epoch, before) = graph(&graphs, 2);
    mapper.stop();
    let mut mapper = Manager::start(&rig, &["mapper", "--live"]);
    mapper.until_heard(0, "its map", |message| message.starts_with("STATUS=running: mapping"));
    let (epoch_after, after) = graph(&graphs, before.len());
    assert_eq!(epoch_after, epoch);
    assert!(before.iter().all(|id| after.contains(id)), "{before:?} {after:?}");
    drop((graphs, hub));
    // The last one to leave removes what the mapper left.
    for process in [mapper, tracker, capture] {
        process.stop();
    }
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}
