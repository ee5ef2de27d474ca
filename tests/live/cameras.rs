//! The real binary with cameras that are missing, are not cameras, or are requested wrongly. Existing cameras are
//! tested in `deploy/robot-test`.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::support::{Ended, Rig, end, finish, signal, until};
use rustix::process::Signal;
use semidense::capture::stream::format::{StreamClock, StreamHeader};
use serde_json::Value;

const WEBCAM: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/config/rigs/webcam.toml");

fn assert_refused(ended: &Ended, words: &[&str]) {
    assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
    let errors: Vec<_> = ended.stderr.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{}", ended.stderr);
    for word in words {
        assert!(errors[0].contains(word), "`{word}` is not in: {}", errors[0]);
    }
}

/// `run` and `capture` on a camera.
fn start(rig: &Rig, command: &str, source: &str, more: &[&str]) -> std::process::Command {
    let mut command = rig.command(&[command, "--source", source]);
    if command.get_args().next().is_some_and(|name| name == "run") {
        command.arg("--output").arg(rig.output());
    }
    command.args(more);
    command
}

#[test]
fn a_camera_needs_a_rig_and_does_not_wait() {
    let rig = Rig::new();
    for command in ["run", "capture"] {
        let ended = finish(start(&rig, command, "v4l:0", &[]));
        assert_refused(&ended, &["v4l:0: a camera needs a rig file", "--rig FILE"]);
        let ended = finish(start(&rig, command, "v4l:0", &["--rig", WEBCAM, "--lockstep"]));
        assert_refused(&ended, &["leave out --lockstep"]);
    }
    let ended = finish(rig.command(&["replay", "v4l:0", "--output", "/nowhere/output"]));
    assert_refused(&ended, &["v4l:0: a camera cannot be replayed"]);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn a_device_that_is_not_a_camera_ends_the_run() {
    let rig = Rig::new();
    for command in ["run", "capture"] {
        let ended = finish(start(&rig, command, "v4l:/dev/null", &["--rig", WEBCAM]));
        assert_refused(&ended, &["/dev/null: is not a usable camera", "it is not a video device"]);
    }
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn a_missing_camera_is_a_state() {
    let rig = Rig::new();
    let camera = "v4l:usb-nobody-has-this";
    let child = start(&rig, "capture", camera, &["--rig", WEBCAM]).spawn().unwrap();
    let capture = until("a state", || {
        let status = finish(rig.command(&["status", "--once", "--json"]));
        let status: Value = serde_json::from_str(&status.stdout).ok()?;
        (status["capture"]["state"] == "stale").then(|| status["capture"].clone())
    });
    let cause = capture["cause"].as_str().unwrap();
    assert!(cause.starts_with("there is no camera usb-nobody-has-this; plug it in"), "{cause}");
    assert_eq!(capture["frames"], 0);
    signal(&child, Signal::INT);
    let ended = end(child);
    assert_eq!(ended.status.code(), Some(130), "{}", ended.stderr);
    // Printed once, however often it is tried.
    assert_eq!(ended.stderr.matches("there is no camera").count(), 1, "{}", ended.stderr);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn the_first_frames_of_a_stream_cause_no_warning() {
    let rig = Rig::new();
    let socket = rig.folder().join("frames");
    let source = format!("stream:{}", socket.display());
    let arguments = ["--rig", WEBCAM, "--log", "info"];
    let child = start(&rig, "capture", &source, &arguments).spawn().unwrap();
    let is_in = |state: &str| {
        let status = finish(rig.command(&["status", "--once", "--json"]));
        let status: Value = serde_json::from_str(&status.stdout).ok()?;
        (status["capture"]["state"] == state).then_some(())
    };
    until("that it waits", || is_in("stale"));
    let mut sender = UnixStream::connect(&socket).unwrap();
    let header = StreamHeader::gray((640, 480), StreamClock::Other, 1_000_000, 0);
    sender.write_all(&header.to_bytes()).unwrap();
    sender.write_all(&vec![90; 640 * 480]).unwrap();
    until("that it runs", || is_in("running"));
    signal(&child, Signal::INT);
    let ended = end(child);
    let line = ended.stderr.lines().find(|line| line.contains("frames are arriving"));
    assert!(line.is_some_and(|line| line.contains(" INFO ")), "{}", ended.stderr);
}

#[test]
fn a_stream_of_damaged_pictures_is_a_state_with_its_reason() {
    const PERIOD: Duration = Duration::from_millis(20);
    /// Five minutes: longer than what is waited for.
    const MAX_FRAMES: u64 = 15_000;
    let rig = Rig::new();
    let socket = rig.folder().join("frames");
    let source = format!("stream:{}", socket.display());
    let arguments = ["--rig", WEBCAM, "--set", "capture.camera.stall_s=1"];
    let child = start(&rig, "capture", &source, &arguments).spawn().unwrap();
    let capture_in = |state: &str| {
        let status = finish(rig.command(&["status", "--once", "--json"]));
        let status: Value = serde_json::from_str(&status.stdout).ok()?;
        (status["capture"]["state"] == state).then(|| status["capture"].clone())
    };
    until("that it waits", || capture_in("stale"));
    let mut sender = UnixStream::connect(&socket).unwrap();
    let mut send = |sequence: u64, is_damaged: bool| {
        let stamp_nanos = 1_000_000 * sequence as i64;
        let header = StreamHeader::gray((640, 480), StreamClock::Other, stamp_nanos, sequence);
        let mut header = header.to_bytes();
        if is_damaged {
            // A JPEG, which has no rows: grey pixels are not one.
            header[16..20].fill(0);
            header[20..24].copy_from_slice(b"MJPG");
        }
        sender.write_all(&header).and_then(|()| sender.write_all(&vec![90; 640 * 480]))
    };
    let is_damaged = AtomicBool::new(true);
    let found = std::thread::scope(|scope| {
        let is_damaged = &is_damaged;
        // Until capture ends.
        scope.spawn(move || {
            for sequence in 0..MAX_FRAMES {
                if send(sequence, is_damaged.load(Ordering::Relaxed)).is_err() {
                    break;
                }
                std::thread::sleep(PERIOD);
            }
        });
        let found = until("the damage", || {
            let found = capture_in("stale")?;
            found["cause"].as_str()?.starts_with("every frame is damaged: ").then_some(found)
        });
        is_damaged.store(false, Ordering::Relaxed);
        until("that it runs", || capture_in("running"));
        signal(&child, Signal::INT);
        found
    });
    assert!(found["refused"].as_u64() > Some(1), "{found}");
    let ended = end(child);
    // Once, or again where the machine was busy for a second.
    let told = ended.stderr.matches("every frame is damaged").count();
    assert!((1..=3).contains(&told), "{}", ended.stderr);
}

#[test]
fn a_run_prints_once_that_it_waits_for_a_camera() {
    let rig = Rig::new();
    for more in [&[][..], &["--json"]] {
        let arguments = [&["--rig", WEBCAM], more].concat();
        let mut child = start(&rig, "run", "v4l:usb-nobody-has-this", &arguments).spawn().unwrap();
        let mut said = std::io::BufReader::new(child.stderr.take().unwrap());
        let mut lines = String::new();
        while !lines.contains("there is no camera") {
            assert!(std::io::BufRead::read_line(&mut said, &mut lines).unwrap() > 0, "{lines}");
        }
        assert!(lines.contains("waiting: there is no camera"), "{lines}");
        // Time for a second line to appear.
        std::thread::sleep(Duration::from_millis(500));
        signal(&child, Signal::INT);
        std::io::Read::read_to_string(&mut said, &mut lines).unwrap();
        assert_eq!(end(child).status.code(), Some(130), "{lines}");
        assert_eq!(lines.matches("there is no camera").count(), 1, "{lines}");
    }
}

#[test]
fn cameras_are_listed() {
    let rig = Rig::new();
    let ended = finish(rig.command(&["cameras", "--json"]));
    assert!(ended.status.success(), "{}", ended.stderr);
    let list: Value = serde_json::from_str(&ended.stdout).unwrap();
    for camera in list.as_array().unwrap() {
        assert!(camera["path"].as_str().unwrap().starts_with("/dev/video"), "{camera}");
    }
    let ended = finish(rig.command(&["cameras"]));
    assert!(ended.status.success() && !ended.stdout.is_empty(), "{}", ended.stderr);
}
