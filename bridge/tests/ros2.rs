//! ROS 2 against another DDS implementation, Eclipse Cyclone, in Python: it reads what shared memory contains, and
//! what it publishes is tracked. Nothing leaves the machine: as root, all of it runs in a separate network namespace.
#![cfg(feature = "ros2")]

mod support;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source_name::SourceName;
use semidense::service::health::ProcessState;
use semidense::slam::geometry::se3::SE3;
use semidense_bridge::session::{Event, Session, Wants};
use serde_json::Value;

use support::machines::{Root, Running, bridge};
use support::network::Network;
use support::robot::{POINTS, Robot, SIZE, image, points};
use support::{has_tool, semidense, tools, until};

/// Cyclone DDS finds its peers by address: loopback has no multicast.
const CYCLONE: &str = "<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>\
    <AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>\
    <MaxAutoParticipantIndex>20</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>";

/// Poses that the reader waits for.
const NUM_POSES: usize = 40;

/// Environment of a test: a network namespace, where that is allowed, and a domain.
struct Dds {
    network: Option<Network>,
    domain: String,
}

impl Dds {
    /// `None` if the other implementation is not installed, which is printed; in CI it must be installed.
    fn new(domain: u16) -> Option<Self> {
        if !has_tool(&python()) || !has_tool(&python().with_file_name("cyclonedds")) {
            return None;
        }
        Some(Self { network: Network::new(0), domain: domain.to_string() })
    }

    fn command(&self, program: &Path) -> Command {
        let program = program.to_str().unwrap();
        let mut command = match &self.network {
            Some(network) => network.on_host(program),
            None => Command::new(program),
        };
        command.env("CYCLONEDDS_URI", CYCLONE).env("ROS_DOMAIN_ID", &self.domain);
        for variable in ["ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DISTRO"] {
            command.env_remove(variable);
        }
        command
    }

    fn peer(&self, script: &str, arguments: &[&str]) -> Command {
        let mut command = self.command(&python());
        command.arg(scripts().join(script)).args(arguments);
        command
    }
}

fn scripts() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ros2")
}

fn python() -> PathBuf {
    tools().join("venv/bin/python")
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

fn transform(value: &Value) -> SE3 {
    let n = numbers(value);
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(n[6], n[3], n[4], n[5]));
    SE3 { rotation, translation: Vector3::new(n[0], n[1], n[2]) }
}

fn assert_near(found: &SE3, expected: &SE3) {
    let moved = (found.translation - expected.translation).norm();
    let turned = found.rotation.angle_to(&expected.rotation);
    assert!(moved < 1e-9 && turned < 1e-7, "{found:?} is not {expected:?}");
}

/// A camera at `position` in our axes, without rotation, in ROS's: x forward, y left, z up.
fn in_ros(position: &[f64]) -> SE3 {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(0.5, -0.5, 0.5, -0.5));
    SE3 { rotation, translation: Vector3::new(position[2], -position[0], -position[1]) }
}

#[test]
fn another_implementation_reads_what_shared_memory_contains() {
    let Some(dds) = Dds::new(71) else { return };
    let root = Root::new("front");
    let robot = Robot::start(&root.place(), 5);
    let mut publisher = dds.command(Path::new(bridge()));
    publisher.args(["--instance", "front", "ros2"]);
    let mut publisher = Running::start(publisher, root.path());
    publisher
        .wait_for("publishing front on ROS 2, topics below /front, domain 71, this machine only");
    // Late, as rviz: earlier one-off messages must still arrive.
    until("poses", || (robot.last_sequence() > 60).then_some(()));
    let folder = root.path().to_str().unwrap();
    let mut peer = Running::start(
        dds.peer("listen.py", &["71", "/front", folder, &NUM_POSES.to_string()]),
        root.path(),
    );
    assert!(peer.end(), "{}", peer.said());
    let text = std::fs::read_to_string(root.path().join("poses.json")).unwrap();
    let came: Value = serde_json::from_str(&text).unwrap();
    println!("{}", came["counts"]);

    check_poses(&came, &robot);
    check_transforms(&came);
    check_bytes(&came, root.path());
    // The names by which ROS lists it; best-effort and reliable subscribers of poses are both served.
    let nodes = came["nodes"].as_array().unwrap();
    assert!(
        nodes.iter().any(|node| node[0] == "/front"
            && node[1] == "semidense"
            && node[2].as_u64() > Some(8))
    );
    assert!(came["odometry_best_effort"].as_array().unwrap().len() > NUM_POSES / 2);
    // Clouds are best effort: a subscriber that requires reliability receives none, and is reported.
    assert_eq!(came["counts"]["cloud_reliable"], 0);
    publisher.wait_for("/front/points requests reliable delivery");
    let reports: Vec<&str> = came["diagnostics"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|report| report["name"].as_str())
        .collect();
    for name in ["front: capture", "front: tracker", "front: mapper", "front: ros2"] {
        assert!(reports.contains(&name), "{name} of {reports:?}");
    }
    assert!(publisher.interrupt(), "{}", publisher.said());
}

/// Checks that each received pose is one that was sent, except for its last two digits.
fn check_poses(came: &Value, robot: &Robot) {
    let odometry = came["odometry"].as_array().unwrap();
    assert!(odometry.len() >= NUM_POSES);
    let (mut stamps, mut matched) = (Vec::new(), 0);
    for message in odometry {
        assert_eq!(
            (message["frame"].as_str(), message["child"].as_str()),
            (Some("odom"), Some("front_optical_frame"))
        );
        let found = transform(&message["pose"]);
        let is_it = |sent: &semidense::wire::message::PoseMessage| {
            (in_ros(&sent.world_from_camera[4..]).translation - found.translation).norm() < 1e-12
        };
        let sent = robot.sent(|sent| sent.poses.values().map(|(pose, _)| *pose).find(is_it));
        let sent = sent.unwrap_or_else(|| panic!("{message} was never sent"));
        assert_near(&found, &in_ros(&sent.world_from_camera[4..]));
        // The first covariance entry is along x forward, our z.
        let covariance = numbers(&message["covariance"]);
        assert!((covariance[0] - sent.covariance[11]).abs() < 1e-9, "{covariance:?}");
        // Velocities are in the child's axes, which are the camera's own.
        let is_near = |one: f64, other: f64| (one - other).abs() < 1e-12;
        let twist = numbers(&message["twist"]);
        let sent_twist = [sent.linear_velocity, sent.angular_velocity].concat();
        assert!(twist.iter().zip(&sent_twist).all(|(a, b)| is_near(*a, *b)), "{twist:?}");
        let covariance = numbers(&message["twist_covariance"]);
        for (at, in_triangle) in [(0, 0), (1, 1), (35, 20)] {
            assert!(is_near(covariance[at], sent.velocity_covariance[in_triangle]), "{at}");
        }
        stamps.push(message["stamp"].as_i64().unwrap());
        let stamp = stamps[stamps.len() - 1];
        let of_pose = came["pose"].as_array().unwrap().iter().find(|pose| pose["stamp"] == stamp);
        if let Some(pose) = of_pose {
            matched += 1;
            assert_eq!(pose["frame"], "map");
            assert_near(&transform(&pose["pose"]), &in_ros(&sent.map_from_camera[4..]));
        }
    }
    assert!(matched > NUM_POSES / 2, "{matched} poses in the map have a stamp of odometry");
    assert!(stamps.windows(2).all(|pair| pair[0] < pair[1]), "in order, none twice");
}

/// Checks that map → odom → camera is the pose in the map, and that the camera's body is in its optical frame.
fn check_transforms(came: &Value) {
    let mut matched = 0;
    for message in came["tf"].as_array().unwrap() {
        let [map_odom, odom_camera] = &message.as_array().unwrap()[..] else { panic!("{message}") };
        assert_eq!(
            (map_odom["frame"].as_str(), map_odom["child"].as_str()),
            (Some("map"), Some("odom"))
        );
        assert_eq!(
            (odom_camera["frame"].as_str(), odom_camera["child"].as_str()),
            (Some("odom"), Some("front_optical_frame"))
        );
        let composed = transform(&map_odom["transform"]) * transform(&odom_camera["transform"]);
        let of_pose =
            came["pose"].as_array().unwrap().iter().find(|pose| pose["stamp"] == map_odom["stamp"]);
        if let Some(pose) = of_pose {
            matched += 1;
            assert_near(&composed, &transform(&pose["pose"]));
        }
    }
    assert!(matched > NUM_POSES / 2, "{matched} transforms have a pose");
    let fixed = came["tf_static"].as_array().unwrap();
    assert_eq!(fixed.len(), 1, "once, though the subscriber came late");
    assert_eq!(
        (fixed[0][0]["frame"].as_str(), fixed[0][0]["child"].as_str()),
        (Some("front_optical_frame"), Some("front_link"))
    );
    // Forward of the body is forward of the camera.
    let forward = transform(&fixed[0][0]["transform"]).rotation * Vector3::x();
    assert!((forward - Vector3::z()).norm() < 1e-12);
}

/// Compares cloud, image and camera byte by byte.
fn check_bytes(came: &Value, folder: &Path) {
    let cloud = std::fs::read(folder.join("cloud.bin")).unwrap();
    assert!(cloud.len() >= 960_000 && cloud.len() == POINTS * 20, "{} bytes", cloud.len());
    assert_eq!(came["cloud"]["fields"][0], serde_json::json!(["x", 0, 7, 1]));
    assert_eq!(came["cloud"]["frame"], "map");
    for (bytes, point) in cloud.chunks_exact(20).zip(points(5)) {
        let found: Vec<f32> = bytes
            .chunks_exact(4)
            .map(|four| f32::from_le_bytes(four.try_into().unwrap()))
            .collect();
        let depth = 1.0 / f64::from(point.inverse_depth);
        let across = (f64::from(point.u) - 159.5) / 300.0 * depth;
        let down = (f64::from(point.v) - 119.5) / 300.0 * depth;
        assert_eq!(found[..3], [depth as f32, -across as f32, -down as f32], "{point:?}");
        assert_eq!(found[3], point.intensity);
    }
    let pixels = std::fs::read(folder.join("image.bin")).unwrap();
    assert_eq!(
        (came["image"]["encoding"].as_str(), came["image"]["width"].as_u64()),
        (Some("mono8"), Some(SIZE[0] as u64))
    );
    assert!((0..16).any(|sequence| image(sequence) == pixels), "an image that was sent");
    assert_eq!(
        numbers(&came["camera_info"]["k"]),
        [300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0]
    );
}

/// Writes frames of a simulated camera to a file.
fn write_frames(file: &Path, frames: usize) {
    let params = SimulatorParams {
        frames,
        width: 160,
        height: 120,
        focal_px: 131.0,
        ..SimulatorParams::default()
    };
    let name: SourceName = "sim".parse().unwrap();
    let source = SourceParams { simulator: params, ..SourceParams::default() };
    let mut source = open(&name, None, &source).unwrap();
    source.prepare(&mut |_, _| true).unwrap();
    let mut bytes = Vec::new();
    let mut pixels = vec![0; 160 * 120];
    while source.next_into(&mut pixels).unwrap().is_some() {
        bytes.extend_from_slice(&pixels);
    }
    std::fs::write(file, bytes).unwrap();
}

/// The process whose command line has `word`, other than this one.
fn process_with(word: &str) -> Option<i32> {
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let ids = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    ids.filter(|id| *id != std::process::id() as i32).find(|id| {
        let line = std::fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
        let line = String::from_utf8_lossy(&line);
        line.contains(word) && line.contains("semidense-bridge") && line.contains("ros2-camera")
    })
}

#[test]
fn images_of_another_implementation_are_tracked_and_a_killed_bridge_is_restarted() {
    let Some(dds) = Dds::new(72) else { return };
    let root = Root::new("semidense");
    let file = root.path().join("frames.raw");
    write_frames(&file, 60);
    let topic = format!("/camera_{}/image_raw", std::process::id());
    let numbers = ["160", "120", "131", "131", "79.5", "59.5", "10"];
    let mut camera = dds.peer("camera.py", &["72", &topic, file.to_str().unwrap()]);
    camera.args(numbers).stdin(Stdio::piped());
    let mut camera = Camera(camera.spawn().unwrap());
    // No rig file: the calibration is from the CameraInfo.
    let output = root.path().join("output");
    let mut run = dds.command(&semidense());
    run.args(["run", &format!("ros2:{topic}"), "--output", output.to_str().unwrap()]);
    // A start of the map takes seconds without optimisation.
    run.args(["--set", "supervisor.watchdog_s=0"]);
    let mut run = Running::start(run, root.path());
    let mut session = Session::new(root.place(), "probe", Wants::default());
    let tracked = count_tracked(&mut session, 40);
    // No frame arrives without the bridge; capture reports that, and starts another one.
    let id = until("the bridge", || process_with(&topic));
    let killed = Command::new("kill").args(["-s", "KILL", &id.to_string()]).status().unwrap();
    assert!(killed.success());
    until("stale", || {
        let mut is_stale = false;
        read(&mut session, |event| {
            if let Event::Health("capture", health) = event {
                is_stale |= ProcessState::from_code(health.state) == Some(ProcessState::Stale);
            }
        });
        is_stale.then_some(())
    });
    let again = count_tracked(&mut session, 20);
    assert!(again > tracked, "numbers go on: {again} after {tracked}");
    assert_ne!(process_with(&topic), Some(id));
    // An interrupted run exits with 130; its results tell how it went.
    run.interrupt();
    assert!(camera.0.try_wait().unwrap().is_none(), "the camera has ended early");
    let rig = std::fs::read_to_string(output.join("rig.toml")).unwrap();
    assert!(rig.contains("model = \"pinhole\"") && rig.contains("fx = 131.0"), "{rig}");
    let summary = std::fs::read_to_string(output.join("summary.json")).unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    assert!(IS_SLOW || summary["frames_tracked"].as_u64() >= Some(40), "{summary}");
    assert_eq!(process_with(&topic), None, "it ends with capture");
}

/// A camera that ends with the test.
struct Camera(std::process::Child);

impl Drop for Camera {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn read(session: &mut Session, take: impl FnMut(Event)) {
    session.read(None, std::time::Duration::from_millis(50), take).unwrap();
}

/// Without optimisation the start of a map takes longer than a test may: poses are enough then.
const IS_SLOW: bool = cfg!(debug_assertions);

/// Waits for this many tracked poses; returns the sequence of the last.
fn count_tracked(session: &mut Session, count: usize) -> u64 {
    let (mut tracked, mut last) = (0, 0);
    until("tracked poses", || {
        read(session, |event| {
            if let Event::Pose(pose) = event
                && (IS_SLOW || pose.estimate.state.is_tracked())
            {
                tracked += 1;
                last = pose.message.sequence;
            }
        });
        (tracked >= count).then_some(())
    });
    last
}
