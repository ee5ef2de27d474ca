//! Recordings read by independent readers, bags by independent writers, and what a kill leaves.

mod sample_run;
mod support;

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use sample_run::{
    CAMERA, CAPTURE, HEIGHT, PERIOD, REALTIME, WIDTH, frame, health, pixels, pose, run, script,
};
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source::FrameStamp;
use semidense::capture::source_name::SourceName;
use semidense_bridge::record::queue::queue;
use semidense_bridge::record::recorder::{RecordParams, RecordSummary, Recorder};
use semidense_bridge::ros::encoder::Moment;
use semidense_bridge::ros::images::ImageFormat;
use semidense_bridge::session::Event;
use serde_json::{Value, json};
use support::{has_tool, succeed, tools};

fn params(output: &Path, images: ImageFormat) -> RecordParams {
    RecordParams {
        output: output.to_owned(),
        instance: "left".to_owned(),
        images,
        max_bytes: None,
        max_duration: None,
    }
}

/// Records events.
fn record(params: RecordParams, events: Vec<Event>) -> RecordSummary {
    let recorder = Recorder::create(params).unwrap();
    let (sender, receiver) = queue(1 << 30);
    events.into_iter().for_each(|event| assert!(sender.put(Moment::now(), event)));
    assert_eq!(sender.counts.dropped(), 0);
    drop(sender);
    recorder.run(&receiver).unwrap()
}

/// Runs a script with readers and writers from PyPI (the reference implementation, its decoder for ROS 2, and
/// Ternaris' implementation of both) and returns its output; `None` if they are not installed.
fn run_python(name: &str, argument: &Path) -> Option<String> {
    if !has_tool(&tools().join("python-recordings")) {
        return None;
    }
    let mut command = Command::new(tools().join("venv/bin/python"));
    command.arg(script(name)).arg(argument).stdout(Stdio::piped()).stderr(Stdio::piped());
    Some(succeed(command))
}

/// A frame of a bag and its pixels.
type Frame = (FrameStamp, Vec<u8>);

/// Every frame of a bag.
fn play(path: &Path) -> Vec<Frame> {
    try_to_play(path).unwrap()
}

/// Every frame of a bag, unless it cannot be read, or not yet.
fn try_to_play(path: &Path) -> Result<Vec<Frame>, Box<dyn Error>> {
    let name = SourceName::Mcap { file: path.to_owned(), topic: None };
    let mut source = open(&name, None, &SourceParams::default())?;
    let k = source.intrinsics();
    let mut image = vec![0; k.width * k.height];
    let mut frames = Vec::new();
    while let Some(stamp) = source.next_into(&mut image)? {
        frames.push((stamp, image.clone()));
    }
    Ok(frames)
}

#[test]
fn independent_readers_find_what_was_recorded() {
    const FRAMES: u64 = 45;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let summary = record(params(&path, ImageFormat::Png), run(FRAMES));
    assert_eq!(summary.messages["image_rect/compressed"], FRAMES);

    let Some(found) = run_python("read_recording.py", &path) else { return };
    let found: Value = serde_json::from_str(&found).unwrap();
    assert_eq!(found["profile"], "ros2");
    for (topic, count) in [
        ("/left/image_rect/compressed", FRAMES),
        ("/left/camera_info", FRAMES),
        ("/left/details/frame", FRAMES),
        ("/left/pose", FRAMES),
        ("/left/odom", FRAMES),
        ("/tf", FRAMES),
        ("/left/details/pose", FRAMES),
        ("/left/points", 1),
        ("/left/details/keyframe", 1),
        ("/left/keyframes", 1),
        ("/left/details/graph", 1),
        // Three processes, and with each report of capture one of the recording itself.
        ("/diagnostics", 2 * 4),
    ] {
        assert_eq!(found["counts"][topic], count, "{topic}");
    }
    let last = FRAMES as i64 - 1;
    let stamp = REALTIME + last * PERIOD;
    assert_eq!(found["stamp"], json!([stamp / 1_000_000_000, stamp % 1_000_000_000]));
    assert_eq!(found["frames"], json!(["odom", "left_optical_frame", "left_optical_frame"]));
    // 1 to the right and some ahead, in x forward, y left, z up; the camera's z is ROS's x.
    let number = |key: &str, at: usize| found[key][at].as_f64().unwrap();
    let is_near = |key: &str, expected: &[f64]| {
        let worst = expected.iter().enumerate().map(|(i, x)| (number(key, i) - x).abs());
        assert!(worst.fold(0.0, f64::max) < 1e-9, "{key}: {}", found[key]);
    };
    is_near("position", &[0.01 * last as f64, -1.0, 0.0]);
    is_near("orientation", &[-0.5, 0.5, -0.5, 0.5]);
    // Its variance is along the camera's x, which is ROS's -y.
    let mut covariance = [0.0; 36];
    covariance[7] = 0.25;
    is_near("covariance", &covariance);
    assert_eq!(found["twist_covariance"], 1e6);
    assert_eq!(found["transforms"], json!([["map", "odom"], ["odom", "left_optical_frame"]]));
    assert_eq!(found["fields"], json!(["x", "y", "z", "intensity", "sigma"]));
    assert_eq!((&found["points"], &found["cloud_bytes"]), (&json!(500), &json!(500 * 20)));
    is_near("k", &[CAMERA.fx, 0.0, CAMERA.cx, 0.0, CAMERA.fy, CAMERA.cy, 0.0, 0.0, 1.0]);
    assert_eq!(found["image_format"], "png");
    assert_eq!(found["image_begin"], json!([0x89, 0x50, 0x4e, 0x47]));
    assert_eq!(found["frame"], json!([last, CAPTURE + last * PERIOD, 4_000_000]));
    assert_eq!(found["keyframe_ids"], json!([3, 3]));
    assert_eq!(found["reliability"]["/tf"], "RELIABLE");
    assert_eq!(found["reliability"]["/left/points"], "BEST_EFFORT");
}

#[test]
fn a_recording_replays_the_same_frames() {
    let folder = tempfile::tempdir().unwrap();
    for (images, is_exact) in
        [(ImageFormat::Png, true), (ImageFormat::Raw, true), (ImageFormat::Jpeg, false)]
    {
        let path = folder.path().join(format!("{images:?}.mcap"));
        record(params(&path, images), run(20));
        let frames = play(&path);
        assert_eq!(frames.len(), 20, "{images:?}");
        for (i, (stamp, image)) in frames.iter().enumerate() {
            let expected = FrameStamp {
                sequence: i as u64,
                capture_nanos: CAPTURE + i as i64 * PERIOD,
                exposure_nanos: 4_000_000,
                gain: 0.0,
                clocks: None,
            };
            assert_eq!(*stamp, expected, "{images:?}");
            let original = pixels(i as u64);
            let worst = image.iter().zip(&original).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(if is_exact { worst == 0 } else { worst < 60 }, "{images:?}: {worst}");
        }
    }
}

#[test]
fn bags_of_independent_writers_are_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let Some(_) = run_python("write_bag.py", folder.path()) else { return };
    let rosbags = std::fs::read_dir(folder.path().join("rosbags")).unwrap();
    let rosbags = rosbags.map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> =
        rosbags.filter(|path| path.extension().is_some_and(|e| e == "mcap")).collect();
    assert_eq!(files.len(), 1);
    files.extend(["none", "lz4", "zstd"].map(|c| folder.path().join(format!("mcap-{c}.mcap"))));
    for path in &files {
        let frames = play(path);
        assert_eq!(frames.len(), 12, "{}", path.display());
        for (i, (stamp, image)) in frames.iter().enumerate() {
            assert_eq!(stamp.capture_nanos, (100 + i as i64) * 1_000_000_000 + 500);
            assert_eq!(image.len(), WIDTH * HEIGHT);
            // Luma of red 10 i, green one more, blue two more.
            let expected = 10 * i as u8 + 1;
            assert!(image.iter().all(|grey| *grey == expected), "{} {i}", path.display());
        }
    }
}

#[test]
fn a_recording_is_split_into_complete_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let max_bytes = Some(50_000);
    let params = RecordParams { max_bytes, ..params(&path, ImageFormat::Raw) };
    // Left by an earlier recording.
    let earlier = folder.path().join("run_2.mcap");
    std::fs::write(&earlier, "mine").unwrap();
    let summary = record(params, run(60));
    assert!(summary.files.len() >= 3, "{:?}", summary.files);
    assert_eq!(std::fs::read(&earlier).unwrap(), b"mine");
    let frames: Vec<_> = summary.files.iter().flat_map(|file| play(file)).collect();
    assert_eq!(frames.len(), 60);
    let names = ["run.mcap", "run_1.mcap", "run_3.mcap"].map(|name| folder.path().join(name));
    assert_eq!(summary.files[..3], names);
}

#[test]
fn an_existing_file_is_left_untouched() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    std::fs::write(&path, "mine").unwrap();
    let error = Recorder::create(params(&path, ImageFormat::Png)).err().unwrap().to_string();
    assert!(error.contains("run.mcap") && error.contains("--output"), "{error}");
    assert_eq!(std::fs::read(&path).unwrap(), b"mine");
}

/// Environment variable with the file that [`writes_until_it_is_killed`] writes.
const KILLED_FILE: &str = "SEMIDENSE_TEST_KILLED_FILE";

#[test]
#[ignore = "run by the test of what a kill leaves, which kills it"]
fn writes_until_it_is_killed() {
    let path = PathBuf::from(std::env::var_os(KILLED_FILE).unwrap());
    let recorder = Recorder::create(params(&path, ImageFormat::Png)).unwrap();
    let (sender, receiver) = queue(1 << 30);
    std::thread::spawn(move || {
        for sequence in 0.. {
            sender.put(Moment::now(), frame(sequence));
            sender.put(Moment::now(), pose(sequence));
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    recorder.run(&receiver).unwrap();
}

#[test]
fn a_kill_leaves_all_but_the_last_second() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "writes_until_it_is_killed", "--ignored"])
        .env(KILLED_FILE, &path)
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    // Until two chunks are complete: each adds its frames at once.
    let (began, mut last, mut chunks) = (Instant::now(), 0, 0);
    while chunks < 2 {
        assert!(began.elapsed() < Duration::from_secs(60), "nothing is written");
        std::thread::sleep(Duration::from_millis(20));
        let now = try_to_play(&path).map_or(0, |frames| frames.len());
        chunks += usize::from(now > last);
        last = now;
    }
    child.kill().unwrap();
    child.wait().unwrap();

    let ours = play(&path).len();
    assert!(ours > 20, "{ours} frames");
    if let Some(theirs) = run_python("read_truncated.py", &path) {
        assert_eq!(theirs.trim(), ours.to_string());
    }
    // Cut within its last chunk, it can still be read up to the previous one.
    let bytes = std::fs::read(&path).unwrap();
    let cut = folder.path().join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() / 10 * 9]).unwrap();
    let left = play(&cut).len();
    assert!(left > 0 && left < ours, "{left} of {ours}");
}

#[test]
fn a_full_queue_drops_and_counts_without_waiting() {
    let (sender, receiver) = queue(10 * (WIDTH * HEIGHT) as u64);
    (0..50).for_each(|sequence| assert!(sender.put(Moment::now(), frame(sequence))));
    let counts = sender.counts.clone();
    assert_eq!(counts.dropped_images.load(std::sync::atomic::Ordering::Relaxed), 40);
    sender.put(Moment::now(), health("capture"));
    assert_eq!(counts.dropped(), 41, "there is no room for small ones either");
    // There is room again once something is taken.
    assert!(receiver.take().is_some());
    sender.put(Moment::now(), frame(50));
    assert_eq!(counts.dropped(), 41);
    drop(receiver);
    assert!(!sender.put(Moment::now(), Event::Left), "nobody is there any more");
}
