//! An instance on a second machine: in network namespaces, which to the network are separate machines.
#![cfg(feature = "zenoh")]

mod support;

use std::process::Command;
use std::time::{Duration, Instant};

use semidense::service::clock::now_nanos;
use semidense::service::health::{ProcessState, cause};
use semidense::wire::keyframe_inbox::KeyframeInbox;
use semidense::wire::message::{
    FrameHeader, GraphHeader, HealthMessage, KeyframePoseMessage, PoseMessage,
};
use semidense::wire::port::{Hub, Subscriber, wait};
use semidense::wire::topic::{FRAME, GRAPH, POSE, TRACKER_HEALTH};
use support::machines::{Root, Running, bridge, percentiles_ms};
use support::network::{Network, robot_address};
use support::robot::{Robot, graph, image, points};
use support::until;

const SECOND_NANOS: i64 = 1_000_000_000;

fn send(mut command: Command, root: &Root, arguments: &[&str]) -> Running {
    command.args(["--log", "info", "--instance", &root.place().instance, "zenoh", "send"]);
    command.args(arguments);
    Running::start(command, root.path())
}

fn receive(mut command: Command, root: &Root, from: &str, arguments: &[&str]) -> Running {
    let local = root.place().instance;
    command.args(["--log", "info", "zenoh", "receive", "--from", from, "--as", &local]);
    command.args(arguments);
    Running::start(command, root.path())
}

/// Poses at the other end, with the time at which each was seen.
struct Probe {
    poses: Subscriber<PoseMessage, ()>,
    health: Subscriber<HealthMessage, ()>,
    last_health: Option<HealthMessage>,
    hub: Hub,
}

impl Probe {
    fn open(root: &Root) -> Self {
        let hub = root.observe();
        // Its topics appear one after another.
        let poses = until("poses", || hub.subscriber(&POSE).ok());
        let health = until("health", || hub.subscriber(&TRACKER_HEALTH).ok());
        Self { poses, health, last_health: None, hub }
    }

    fn take(&self) -> Vec<(PoseMessage, i64)> {
        let receive = || self.poses.receive().unwrap().map(|m| (m.payload()[0], now_nanos()));
        std::iter::from_fn(receive).collect()
    }

    /// Waits for `count` poses after `sequence`.
    fn wait_for(&self, count: usize, sequence: u64) -> Vec<(PoseMessage, i64)> {
        let mut taken = Vec::new();
        until("poses at the other end", || {
            // Awake when a pose arrives: the latency of transport is measured, not of this loop.
            let end = Instant::now() + Duration::from_secs(1);
            while taken.len() < count && Instant::now() < end {
                wait(&[self.poses.events()], None, Duration::from_millis(100)).unwrap();
                taken.extend(self.take().into_iter().filter(|(pose, _)| pose.sequence > sequence));
            }
            (taken.len() >= count).then_some(())
        });
        taken
    }

    /// Waits for a state of the tracker's health; returns its cause.
    fn wait_for_state(&mut self, state: ProcessState) -> String {
        until(&format!("health to be {}", state.name()), || {
            while let Some(message) = self.health.receive().unwrap() {
                self.last_health = Some(message.payload()[0]);
            }
            self.last_health.filter(|h| h.state == state.code()).map(|h| cause(&h))
        })
    }
}

/// Checks that every field equals what was sent, but that stamps of the sender's clock are converted.
fn assert_unchanged(robot: &Robot, arrived: &[(PoseMessage, i64)], shift_nanos: i64) {
    for (pose, _) in arrived {
        let (sent, at) = robot.sent(|sent| sent.poses[&pose.sequence]);
        let apart = (pose.published_nanos - at - shift_nanos).abs();
        assert!(apart < SECOND_NANOS, "pose {} is stamped {apart} ns apart", pose.sequence);
        let compared = PoseMessage { published_nanos: sent.published_nanos, ..*pose };
        assert_eq!(zerocopy::IntoBytes::as_bytes(&compared), zerocopy::IntoBytes::as_bytes(&sent));
    }
}

fn added_ms(robot: &Robot, arrived: &[(PoseMessage, i64)]) -> [f64; 2] {
    let sent_at = |pose: &PoseMessage| robot.sent(|sent| sent.poses[&pose.sequence].1);
    let mut added: Vec<i64> = arrived.iter().map(|(pose, at)| at - sent_at(pose)).collect();
    percentiles_ms(&mut added)
}

#[test]
fn messages_arrive_unchanged_and_resume_after_a_cut_and_behind_a_slow_subscriber() {
    let Some(network) = Network::new(1) else { return };
    let (near, far) = (Root::new("rig"), Root::new("far"));
    let port = format!("tcp/{}:7447", robot_address(0));
    // In reverse of the usual order: each waits for the one before.
    let mut receiver = receive(network.on_host(bridge()), &far, "rig", &["--connect", &port]);
    let mut probe = Probe::open(&far);
    let waiting = probe.wait_for_state(ProcessState::Stale);
    assert!(waiting.contains("no messages of `rig`") && waiting.contains(&port), "{waiting}");
    let options = ["--listen", &port, "--frames", "--frame-rate", "100", "--jpeg-quality", "95"];
    let mut sender = send(network.on_robot(0, bridge()), &near, &options);
    until("the sender to be seen", || {
        probe.wait_for_state(ProcessState::Stale).contains("is not running").then_some(())
    });
    let robot = Robot::start(&near.place(), 1);
    let first = probe.wait_for(1, 0)[0].0.sequence;

    let arrived = probe.wait_for(150, first);
    assert_unchanged(&robot, &arrived, 0);
    let last = arrived.last().unwrap().0.sequence;
    let lost =
        last - first - arrived.iter().filter(|(pose, _)| pose.sequence <= last).count() as u64;
    let [p50, p99] = added_ms(&robot, &arrived);
    eprintln!(
        "poses at 30 Hz with frames: {lost} of {} lost, added {p50:.2} ms median, {p99:.2} ms p99",
        last - first
    );
    assert_eq!(probe.wait_for_state(ProcessState::Running), "tracking");
    assert_eq!(probe.last_health.map(|h| h.process_id == 1), Some(false), "the receiver's id");
    assert_map_and_frames_arrive(&probe.hub, &robot);

    behind_a_stopped_subscriber(&network, &far, &probe, &robot);
    over_a_cut(&network, &mut probe, &robot);

    assert!(sender.interrupt(), "{}", sender.said());
    assert!(probe.wait_for_state(ProcessState::Stale).contains("no messages"));
    assert!(receiver.interrupt(), "{}", receiver.said());
}

fn assert_map_and_frames_arrive(hub: &Hub, robot: &Robot) {
    let mut keyframes = KeyframeInbox::open(hub).unwrap();
    let keyframe = until("a keyframe", || keyframes.newest().unwrap());
    assert_eq!((keyframe.keyframe_id, keyframe.revision), (1, 3));
    assert!(keyframe.image[..] == image(1) && keyframe.points == points(1));
    let graphs: Subscriber<KeyframePoseMessage, GraphHeader> = hub.subscriber(&GRAPH).unwrap();
    let arrived = until("the graph", || graphs.newest().unwrap());
    assert_eq!((arrived.header().revision, arrived.payload()), (3, &graph(1)[..]));
    let frames: Subscriber<u8, FrameHeader> = hub.subscriber(&FRAME).unwrap();
    let frame = until("a frame", || frames.newest().unwrap());
    let header = *frame.header();
    let sent = robot.sent(|sent| sent.frames[&header.sequence]);
    let FrameHeader { clock_nanos, sent_nanos, .. } = header;
    assert!((clock_nanos - sent.clock_nanos).abs() < SECOND_NANOS);
    assert_eq!(header, FrameHeader { clock_nanos, sent_nanos, ..sent });
    let truth = image(header.sequence);
    let worst = frame.payload().iter().zip(&truth).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst.is_some_and(|worst| worst < 16), "a JPEG that is {worst:?} grey levels off");
}

/// A stopped subscriber at the other end that subscribes to all topics.
fn behind_a_stopped_subscriber(network: &Network, far: &Root, probe: &Probe, robot: &Robot) {
    let slow =
        send(network.on_host(bridge()), far, &["--listen", "tcp/127.0.0.1:7448", "--frames"]);
    slow.wait_for("joined");
    slow.signal("STOP");
    let now = robot.last_sequence();
    let arrived = probe.wait_for(90, now);
    assert_unchanged(robot, &arrived, 0);
    let [p50, p99] = added_ms(robot, &arrived);
    eprintln!("beside a stopped subscriber: added {p50:.2} ms median, {p99:.2} ms p99");
    slow.signal("CONT");
}

fn over_a_cut(network: &Network, probe: &mut Probe, robot: &Robot) {
    const CUT: Duration = Duration::from_secs(5);
    network.connect(0, false);
    let cut = Instant::now();
    let cause = probe.wait_for_state(ProcessState::Stale);
    assert!(cause.contains("the link is down"), "{cause}");
    std::thread::sleep(CUT.saturating_sub(cut.elapsed()));
    network.connect(0, true);
    let (restored, instant) = (robot.last_sequence(), now_nanos());
    let mut arrived = probe.take();
    arrived.extend(probe.wait_for(60, 0));
    until("poses that were sent after the cut", || {
        arrived.extend(probe.take());
        (arrived.last().unwrap().0.sequence > restored + 30).then_some(())
    });
    assert_unchanged(robot, &arrived, 0);
    // A stale pose is recognised by its stamp, without knowledge of the cut.
    let age = |(pose, at): &(PoseMessage, i64)| at - pose.published_nanos;
    let stale = arrived.iter().filter(|(pose, at)| pose.sequence <= restored && *at > instant);
    let [oldest, count] = [stale.clone().map(age).max().unwrap_or(0), stale.count() as i64];
    let fresh = arrived.iter().find(|(pose, _)| pose.sequence > restored).unwrap();
    eprintln!(
        "after a cut of 5 s: {count} stale poses came, up to {:.1} s old; the first fresh one {:.1} s after the cut",
        oldest as f64 * 1e-9,
        (fresh.1 - instant) as f64 * 1e-9
    );
    assert_eq!(probe.wait_for_state(ProcessState::Running), "tracking");
}

#[test]
fn four_robots_send_to_one_host() {
    let Some(network) = Network::new(4) else { return };
    let near: Vec<Root> = (0..4).map(|_| Root::new("semidense")).collect();
    let far: Vec<Root> = (0..4).map(|robot| Root::new(&format!("robot{robot}"))).collect();
    let robots: Vec<Robot> =
        (0..4).map(|robot| Robot::start(&near[robot].place(), robot as u64)).collect();
    let port = |robot| format!("tcp/{}:7447", robot_address(robot));
    let _programs: Vec<[Running; 2]> = (0..4)
        .map(|robot| {
            let sender =
                send(network.on_robot(robot, bridge()), &near[robot], &["--listen", &port(robot)]);
            let options = ["--connect", &port(robot)];
            [sender, receive(network.on_host(bridge()), &far[robot], "semidense", &options)]
        })
        .collect();
    let probes: Vec<Probe> = far.iter().map(Probe::open).collect();
    for (number, (probe, robot)) in probes.iter().zip(&robots).enumerate() {
        let arrived = probe.wait_for(90, robot.last_sequence());
        assert!(arrived.iter().all(|(pose, _)| pose.keyframe_id == number as u64));
        assert_unchanged(robot, &arrived, 0);
        let [p50, p99] = added_ms(robot, &arrived);
        eprintln!("robot {number} of 4: added {p50:.2} ms median, {p99:.2} ms p99");
    }
    // No other receiver can publish as one of them.
    let options = ["--connect", &port(1)];
    let mut second = receive(network.on_host(bridge()), &far[0], "semidense", &options);
    assert!(!second.end());
    let said = second.said();
    assert!(said.contains("instance `robot0` is already running (process"), "{said}");
    assert!(far[0].place().claim("tracker").is_err(), "a pipeline of this machine");
}

#[test]
fn stamps_are_converted_to_a_clock_that_started_at_another_time() {
    /// How far the receiver's clock is ahead of the robot's, seconds: more than a day.
    const AHEAD_SECS: i64 = 100_000;
    let Some(network) = Network::new(1) else { return };
    let (near, far) = (Root::new("rig"), Root::new("far"));
    let robot = Robot::start(&near.place(), 1);
    let port = format!("tcp/{}:7447", robot_address(0));
    let _sender = send(network.on_robot(0, bridge()), &near, &["--listen", &port]);
    let mut command = network.on_host("unshare");
    let ahead = AHEAD_SECS.to_string();
    command.args(["--time", "--monotonic", &ahead, "--fork", "--kill-child", bridge()]);
    let _receiver = receive(command, &far, "rig", &["--connect", &port]);
    let probe = Probe::open(&far);
    let arrived = probe.wait_for(60, 0);
    assert_unchanged(&robot, &arrived, AHEAD_SECS * SECOND_NANOS);
}
