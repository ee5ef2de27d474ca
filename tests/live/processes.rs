//! The real binary: three processes over shared memory, from the first frame to the results.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::time::{Duration, UNIX_EPOCH};

use crate::support::{Rig, end, finish, signal, small_camera, until};
use rustix::process::{Pid, Signal};
use semidense::capture::image_file::write_gray_png;
use semidense::capture::opening::open;
use semidense::capture::source_name::SourceName;
use semidense::service::config::Config;
use semidense::service::peers::Peer;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::service::results::record::RecordedPose;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::keyframe::DepthPoint;
use semidense::wire::command::{Command, CommandClient};
use semidense::wire::conversion::{keyframe_from_messages, pose_from_message};
use semidense::wire::keyframe_inbox::KeyframeInbox;
use semidense::wire::message::{
    FrameHeader, GraphHeader, KeyframeHeader, KeyframeImageHeader, KeyframePoseMessage, PoseMessage,
};
use semidense::wire::port::{Hub, Subscriber};
use semidense::wire::topic::{
    EARLIER_KEYFRAME, EARLIER_KEYFRAME_IMAGE, FRAME, GRAPH, HEALTH_TOPICS, POSE, TRACKER_HEALTH,
};
use serde_json::Value;

/// A live run that lasts a minute unless ended.
const SLOW: &[&str] = &["--live", "--set", "simulator.rate_hz=8"];
const SLOW_FRAMES: usize = 480;

fn summary(rig: &Rig) -> Value {
    let text = fs::read_to_string(rig.output().join("summary.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

/// Frames of the runs that are compared bit for bit.
const FRAMES: usize = 25;

/// Runs in lockstep and returns every pose seen by an observer, without the times.
fn observed_poses(rig: &Rig, arguments: &[&str]) -> BTreeMap<u64, String> {
    let child = rig.run(FRAMES, arguments).spawn().unwrap();
    let hub = rig.observe();
    let poses: Subscriber<PoseMessage, ()> = until("poses", || hub.subscriber(&POSE).ok());
    let mut seen = BTreeMap::new();
    until("the last frame", || {
        while let Some(message) = poses.receive().unwrap() {
            let pose = pose_from_message(&message.payload()[0]).unwrap();
            // Floating-point numbers print in their shortest exact form: equal texts are equal bits.
            seen.insert(pose.sequence, format!("{pose:?}"));
        }
        seen.contains_key(&(FRAMES as u64 - 1)).then_some(())
    });
    drop((poses, hub));
    let ended = end(child);
    assert!(ended.status.success(), "{}", ended.stderr);
    seen
}

#[test]
fn a_run_ends_on_its_own_writes_its_results_and_leaves_nothing_behind() {
    let rig = Rig::new();
    let ended = finish(rig.run(20, &[]));
    assert!(ended.status.success(), "{}", ended.stderr);
    for file in ["trajectory.txt", "keyframes.txt", "map.ply", "report.html"] {
        assert!(rig.output().join(file).exists(), "{file}");
    }
    let hidden = fs::read_dir(rig.output()).unwrap().flatten();
    assert!(hidden.into_iter().all(|f| !f.file_name().to_string_lossy().starts_with('.')));
    let summary = summary(&rig);
    assert_eq!(summary["mode"], "lockstep");
    assert_eq!(summary["frames_in"], 20);
    assert_eq!(summary["frames_dropped"], 0);
    assert!(summary["track_ms"]["p50"].is_number() && summary["map_ms"]["p50"].is_number());
    // Two are part of the start.
    let has_changed = summary["keyframes"].as_u64().unwrap() > 2;
    for time in ["keyframe_ms", "keyframe_step_ms"] {
        assert_eq!(summary[time]["p50"].is_number(), has_changed, "{time}");
    }
    assert!(ended.stdout.starts_with("frames"), "{}", ended.stdout);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

/// The same frames through `replay`, in this process.
fn replayed_poses() -> BTreeMap<u64, String> {
    let settings: Vec<String> =
        small_camera(FRAMES).iter().map(|s| format!("simulator.{s}")).collect();
    let config = Config::load(None, &settings).unwrap();
    let name: SourceName = "sim".parse().unwrap();
    let mut source = open(&name, None, &config.source_params()).unwrap();
    let replayed = ReplayConfig {
        tracker: config.tracking,
        mapper: config.mapping,
        ..ReplayConfig::default()
    };
    let record = replay(source.as_mut(), "sim", &replayed, &mut |_| true).unwrap();
    let pose = |pose: &RecordedPose| (pose.estimate.sequence, format!("{:?}", pose.estimate));
    record.poses.iter().map(pose).collect()
}

#[test]
fn lockstep_gives_the_same_bits_as_replay_with_any_number_of_threads() {
    let (one, other) = (Rig::new(), Rig::new());
    let first = observed_poses(&one, &["--set", "mapper.threads=1"]);
    let second = observed_poses(&other, &["--set", "mapper.threads=3"]);
    assert_eq!(first, second);
    assert_eq!(first, replayed_poses());
    for file in ["trajectory.txt", "trajectory_online.txt", "keyframes.txt", "map.ply"] {
        let read = |rig: &Rig| fs::read(rig.output().join(file)).unwrap();
        assert!(read(&one) == read(&other), "{file} differs");
    }
}

/// A recording of the small camera with a fifth of its light.
fn dim_recording(folder: &Path) {
    let settings = small_camera(FRAMES).map(|setting| format!("simulator.{setting}"));
    let config = Config::load(None, &settings).unwrap();
    let mut source = open(&"sim".parse().unwrap(), None, &config.source_params()).unwrap();
    let camera = source.intrinsics();
    let (width, height) = (camera.width, camera.height);
    fs::create_dir(folder).unwrap();
    let mut pixels = vec![0; width * height];
    let mut list = String::new();
    while let Some(stamp) = source.next_into(&mut pixels).unwrap() {
        pixels.iter_mut().for_each(|grey| *grey /= 5);
        let name = format!("{}.png", stamp.sequence);
        write_gray_png(&folder.join(&name), width, height, &pixels).unwrap();
        list += &format!("{:.9} {name}\n", stamp.capture_nanos as f64 * 1e-9);
    }
    fs::write(folder.join("rgb.txt"), list).unwrap();
    let Intrinsics { fx, fy, cx, cy, .. } = camera;
    let text = format!("{fx} {fy} {cx} {cy} {width} {height}\n");
    fs::write(folder.join("camera.txt"), text).unwrap();
}

#[test]
fn dim_frames_are_brightened_alike_by_a_run_and_a_replay() {
    let rig = Rig::new();
    let at = |name: &str| rig.folder().join(name).display().to_string();
    dim_recording(Path::new(&at("dim")));
    let source = format!("tum:{}", at("dim"));
    let online = |command: &str, arguments: &[&str]| {
        let output = at(command);
        let arguments = [&[command, &source, "--output", &output], arguments].concat();
        let ended = finish(rig.command(&arguments));
        assert!(ended.status.success(), "{}", ended.stderr);
        assert!(ended.stderr.contains("the images are dim"), "{}", ended.stderr);
        let told = "images      dim: their grey levels were multiplied by up to 4\n";
        assert!(ended.stdout.contains(told), "{}", ended.stdout);
        fs::read_to_string(Path::new(&output).join("trajectory_online.txt")).unwrap()
    };
    let replayed = online("replay", &[]);
    assert!(replayed.lines().count() > FRAMES / 2, "{replayed}");
    assert_eq!(replayed, online("run", &["--lockstep"]));
}

#[test]
fn the_last_lines_say_what_the_map_folder_holds() {
    let rig = Rig::new();
    let map = rig.folder().join("map").display().to_string();
    for (more, end) in [(None, "in 1 epoch"), (Some("--read-only"), "in 1 epoch, unchanged")] {
        let mut command = rig.command(&["replay", "sim", "--map", &map]);
        command.arg("--output").arg(rig.output()).args(more);
        for setting in small_camera(FRAMES) {
            command.args(["--set", &format!("simulator.{setting}")]);
        }
        let ended = finish(command);
        let told = ended.stdout.lines().find(|line| line.starts_with("map in "));
        let told = told.unwrap_or_else(|| panic!("{} {}", ended.stdout, ended.stderr));
        assert!(told.starts_with(&format!("map in {map}: ")) && told.ends_with(end), "{told}");
    }
}

#[test]
fn a_pose_carries_the_real_time_of_its_frame() {
    let rig = Rig::new();
    let since_1970 = || UNIX_EPOCH.elapsed().unwrap().as_nanos() as i64;
    let begin = since_1970();
    let child = rig.run(SLOW_FRAMES, SLOW).spawn().unwrap();
    let hub = rig.observe();
    let frames: Subscriber<u8, FrameHeader> = until("frames", || hub.subscriber(&FRAME).ok());
    let poses: Subscriber<PoseMessage, ()> = until("poses", || hub.subscriber(&POSE).ok());
    let mut sent = BTreeMap::new();
    let (mut compared, mut before) = (0, None);
    until("ten poses of frames that were seen", || {
        while let Some(frame) = frames.receive().unwrap() {
            let header = *frame.header();
            sent.insert(header.sequence, header);
        }
        while let Some(message) = poses.receive().unwrap() {
            let pose = message.payload()[0];
            let Some(header) = sent.get(&pose.sequence) else { continue };
            assert_eq!(pose.realtime_nanos, header.realtime_nanos);
            assert!((begin..=since_1970()).contains(&pose.realtime_nanos));
            // Both clocks advance alike, except for the slewing of the system clock.
            let offset = header.realtime_nanos - header.clock_nanos;
            let drift = before.replace(offset).map_or(0, |before: i64| (before - offset).abs());
            assert!(drift < 5_000_000, "{drift} ns");
            compared += 1;
        }
        (compared >= 10).then_some(())
    });
    signal(&child, Signal::INT);
    drop((frames, poses, hub));
    end(child);
}

#[test]
fn a_late_subscriber_receives_the_keyframe_and_status_shows_all_three_processes() {
    let rig = Rig::new();
    let child = rig.run(SLOW_FRAMES, SLOW).spawn().unwrap();
    let hub = rig.observe();
    let mut tracker = until("the tracker", || Peer::open(&hub, &TRACKER_HEALTH).ok());
    until("ten frames", || {
        let health = tracker.update().unwrap();
        health.is_some_and(|health| health.frames >= 10).then_some(())
    });
    let late = rig.observe();
    let mut inbox = KeyframeInbox::open(&late).unwrap();
    let keyframe = until("the keyframe", || inbox.newest().unwrap());
    assert_eq!(keyframe.image.len(), 160 * 120);

    // A process reports once a second, so its report may be outdated.
    let status = until("the figures of all three", || {
        let status = finish(rig.command(&["status", "--once", "--json"]));
        assert!(status.status.success(), "{}", status.stderr);
        let status: Value = serde_json::from_str(&status.stdout).unwrap();
        let runs = |process: &str| {
            status[process]["state"] == "running" && status[process]["rate_hz"].as_f64() > Some(0.5)
        };
        let told = ["capture", "tracker", "mapper"].into_iter().all(runs);
        (told && status["keyframes"].as_u64() > Some(0)).then_some(status)
    });
    assert_eq!((&status["instance"], &status["source"]), (&"semidense".into(), &"sim".into()));
    assert_eq!(status["ended"], false, "{status}");
    assert!(status["uptime_secs"].as_f64() > Some(0.5));
    assert!(status["pose"]["state"].is_string() && status["pose"]["position"][2].is_f64());
    assert!(status["pose"]["age_secs"].as_f64() < Some(60.0), "{status}");

    let second = finish(rig.run(20, &[]));
    assert_eq!(second.status.code(), Some(1));
    assert_one_error(&second.stderr, "is in use by semidense, process");
    let elsewhere = rig.folder().join("elsewhere");
    let third = finish(rig.command(&["run", "--output", elsewhere.to_str().unwrap()]));
    assert_eq!(third.status.code(), Some(1));
    assert_one_error(&third.stderr, "instance `semidense` is already running (process ");
    assert!(!elsewhere.exists());

    drop((tracker, inbox, hub, late));
    signal(&child, Signal::INT);
    let ended = end(child);
    assert_eq!(ended.status.code(), Some(130), "{}", ended.stderr);
    let frames = summary(&rig)["frames_in"].as_u64().unwrap();
    assert!((10..SLOW_FRAMES as u64).contains(&frames), "{frames} frames");
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn a_killed_tracker_is_restarted() {
    let rig = Rig::new();
    let child = rig.run(60, SLOW).spawn().unwrap();
    let hub = rig.observe();
    let mut tracker = until("the tracker", || Peer::open(&hub, &TRACKER_HEALTH).ok());
    let victim = until("ten frames", || {
        let health = tracker.update().unwrap();
        health.filter(|health| health.frames >= 10).map(|health| health.process_id)
    });
    let victim = Pid::from_raw(i32::try_from(victim).unwrap()).unwrap();
    rustix::process::kill_process(victim, Signal::KILL).unwrap();
    until("another tracker", || {
        let health = tracker.update().unwrap()?;
        let is_new = health.process_id != victim.as_raw_nonzero().get().cast_unsigned();
        (is_new && health.frames > 0).then_some(())
    });
    drop((tracker, hub));
    let ended = end(child);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert_eq!(summary(&rig)["restarts"], 1);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn nothing_is_left_of_a_process_that_was_killed_while_it_joined() {
    let rig = Rig::new();
    let nodes = rig.root().join("nodes");
    // Joining takes some tens of milliseconds.
    for delay_ms in (0..60).step_by(3) {
        let tracker = rig.command(&["tracker"]).spawn().unwrap();
        until("a node", || nodes.read_dir().ok()?.next().map(drop));
        std::thread::sleep(Duration::from_millis(delay_ms));
        signal(&tracker, Signal::KILL);
        end(tracker);
        rig.place().tidy();
        assert_eq!(rig.leftovers(), Vec::<String>::new(), "killed after {delay_ms} ms");
    }
}

#[test]
fn nothing_outlives_a_killed_supervisor() {
    let rig = Rig::new();
    let child = rig.run(SLOW_FRAMES, SLOW).spawn().unwrap();
    let hub = rig.observe();
    let pids = process_ids(&hub);
    drop(hub);
    signal(&child, Signal::KILL);
    assert!(!end(child).status.success());
    for pid in pids {
        let pid = Pid::from_raw(i32::try_from(pid).unwrap()).unwrap();
        until("the end of a child", || rustix::process::test_kill_process(pid).err());
    }
    // The last of them cleans up, including its supervisor's claim; what is left points to the journal.
    let leftovers = rig.leftovers();
    assert!(leftovers.len() == 1 && leftovers[0].ends_with(".journal"), "{leftovers:?}");
}

fn process_ids(hub: &Hub) -> Vec<u32> {
    let open = |topic| until("a process", || Peer::open(hub, topic).ok());
    let mut peers: Vec<Peer> = HEALTH_TOPICS.iter().map(open).collect();
    let mut ids = Vec::new();
    for peer in &mut peers {
        ids.push(until("its health", || peer.update().unwrap().map(|health| health.process_id)));
    }
    ids
}

/// Checks that exactly one line describes the error, and nothing panicked.
fn assert_one_error(stderr: &str, expected: &str) {
    let errors: Vec<_> = stderr.lines().filter(|line| line.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{stderr}");
    assert!(errors[0].contains(expected), "{expected} is not in {stderr}");
    assert!(!stderr.contains("panicked"), "{stderr}");
}

#[test]
fn bad_input_gives_one_line_and_leaves_nothing_behind() {
    let rig = Rig::new();
    let file = rig.folder().join("file");
    fs::write(&file, "x").unwrap();
    let broken = broken_recording(&rig);
    let (file, broken) = (file.to_str().unwrap(), broken.as_str());
    let cases: &[(&[&str], &str)] = &[
        (&["--source", "nonsense"], "nonsense"),
        (&["--source", "tum:/nowhere"], "/nowhere"),
        (&["--source", "sim:moon"], "moon"),
        (&["--strict", "--source", broken], "2.png"),
        (&["--output", file], file),
        (&["--output", "/proc/nowhere"], "/proc/nowhere"),
        (&["--config", "/nowhere.toml"], "/nowhere.toml"),
        (&["--config", file], "file:1"),
        (&["--set", "mapper.thread=1"], "mapper.thread=1"),
        (&["--set", "mapper.threads=1000"], "0 to 256"),
        (&["--set", "simulator.frames=0"], "simulator.frames"),
        (&["--instance", "a/b"], "a/b"),
        (&["--log", "=="], "--log"),
    ];
    for (arguments, expected) in cases {
        let output = ["--output", rig.folder().to_str().unwrap()];
        let own_output = arguments.contains(&"--output");
        let mut command = rig.command(&["run"]);
        command.args(*arguments).args(if own_output { &[][..] } else { &output[..] });
        let ended = finish(command);
        assert_eq!(ended.status.code(), Some(1), "{arguments:?}: {}", ended.stderr);
        assert_one_error(&ended.stderr, expected);
        assert_eq!(rig.leftovers(), Vec::<String>::new(), "{arguments:?}");
    }
    let usage = finish(rig.command(&["run", "--nonsense"]));
    assert_eq!(usage.status.code(), Some(2));
    let status = finish(rig.command(&["status", "--once"]));
    assert_one_error(&status.stderr, "nothing is running as instance `semidense`");
}

/// A recording whose second image is cut in half.
fn broken_recording(rig: &Rig) -> String {
    const SIZE: u32 = 64;
    let folder = rig.folder().join("recording");
    fs::create_dir_all(folder.join("rgb")).unwrap();
    fs::write(folder.join("camera.txt"), "60 60 31.5 31.5 64 64\n").unwrap();
    let mut list = String::new();
    for index in 1..=3 {
        let pixels: Vec<u8> = (0..SIZE * SIZE).map(|i| (i * 37 % 251) as u8).collect();
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, SIZE, SIZE);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
        let length = if index == 2 { bytes.len() / 2 } else { bytes.len() };
        fs::write(folder.join(format!("rgb/{index}.png")), &bytes[..length]).unwrap();
        list += &format!("{index}.0 rgb/{index}.png\n");
    }
    fs::write(folder.join("rgb.txt"), list).unwrap();
    format!("tum:{}", folder.display())
}

#[test]
fn status_shows_the_running_processes_without_capture() {
    let rig = Rig::new();
    let tracker = rig.command(&["tracker", "--live"]).spawn().unwrap();
    let status = until("status of a tracker alone", || {
        let ended = finish(rig.command(&["status", "--once", "--json"]));
        let status: Value = serde_json::from_str(&ended.stdout).ok()?;
        status["tracker"].is_object().then_some(status)
    });
    assert!(status["capture"].is_null() && status["mapper"].is_null(), "{status}");

    signal(&tracker, Signal::STOP);
    let stopped = finish(rig.command(&["status", "--once"]));
    assert!(stopped.stdout.contains("\ntracker  stopped"), "{}", stopped.stdout);
    assert!(stopped.stdout.contains("\nmapper   not running"), "{}", stopped.stdout);
    signal(&tracker, Signal::CONT);

    let mut watching = rig.command(&["status"]).spawn().unwrap();
    let mut lines = BufReader::new(watching.stdout.take().unwrap()).lines();
    let heard =
        lines.by_ref().map_while(Result::ok).find(|line| line.starts_with("semidense, up 0:"));
    assert!(heard.is_some(), "the tracker is there");
    signal(&tracker, Signal::INT);
    end(tracker);
    let rest: Vec<String> = lines.map_while(Result::ok).collect();
    assert_eq!(rest.last().map(String::as_str), Some("the run has ended"), "{rest:?}");
    let watched = end(watching);
    assert_eq!(watched.status.code(), Some(0), "{}", watched.stderr);
    let nobody = finish(rig.command(&["status", "--once"]));
    assert_eq!(nobody.status.code(), Some(1), "{}", nobody.stdout);
}

/// A late reader, or one whose keyframe has been corrected since, requests the depth of a keyframe in the graph.
#[test]
fn depth_of_an_earlier_keyframe_is_sent_on_request() {
    let rig = Rig::new();
    let child = rig.run(2000, &["--live"]).spawn().unwrap();
    let hub = rig.observe();
    let graphs: Subscriber<KeyframePoseMessage, GraphHeader> =
        until("the graph", || hub.subscriber(&GRAPH).ok());
    let mut graph = Vec::new();
    until("three keyframes", || {
        if let Some(message) = graphs.newest().unwrap() {
            graph = message.payload().to_vec();
        }
        (graph.len() >= 3).then_some(())
    });
    let depths: Subscriber<DepthPoint, KeyframeHeader> = hub.subscriber(&EARLIER_KEYFRAME).unwrap();
    let images: Subscriber<u8, KeyframeImageHeader> =
        hub.subscriber(&EARLIER_KEYFRAME_IMAGE).unwrap();
    let commands = CommandClient::open(&hub).unwrap();
    for wanted in &graph[..2] {
        let ask = Command::SendKeyframe(wanted.keyframe_id);
        commands.ask(&ask, Duration::from_secs(60), || true).unwrap();
        let (depth, image) =
            until("the keyframe", || Some((depths.newest().unwrap()?, images.newest().unwrap()?)));
        let keyframe = keyframe_from_messages(
            depth.header(),
            depth.payload(),
            image.header(),
            image.payload(),
        )
        .unwrap();
        assert_eq!(keyframe.keyframe_id, wanted.keyframe_id);
        assert!(keyframe.revision >= wanted.revision && keyframe.points.len() > 100);
    }
    let unknown = Command::SendKeyframe(123_456);
    let refused = commands.ask(&unknown, Duration::from_secs(60), || true).unwrap_err();
    assert!(refused.to_string().contains("no keyframe 123456"), "{refused}");
    drop((graphs, depths, images, commands, hub));
    signal(&child, Signal::INT);
    assert_eq!(end(child).status.code(), Some(130));
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}
