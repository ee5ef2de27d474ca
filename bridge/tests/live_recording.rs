//! A live run is recorded and replayed from the recording: the poses equal those computed from the recorded frames.

mod support;

use std::path::Path;
use std::process::{Command, Stdio};

use semidense::capture::image_file::write_gray_png;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source_name::SourceName;
use support::{Process, Rig, semidense, succeed, until};

/// Frames of the run, and their rate: slow enough for a busy machine and an unoptimised build.
const FRAMES: usize = 40;
const RATE_HZ: usize = 4;

/// Writes the frames of a recording to a folder of images; returns their number.
fn write_images(recording: &Path, folder: &Path) -> usize {
    let name = SourceName::Mcap { file: recording.to_owned(), topic: None };
    let mut source = open(&name, None, &SourceParams::default()).unwrap();
    let k = source.intrinsics();
    std::fs::create_dir_all(folder).unwrap();
    let camera = format!("{} {} {} {} {} {}\n", k.fx, k.fy, k.cx, k.cy, k.width, k.height);
    std::fs::write(folder.join("camera.txt"), camera).unwrap();
    let mut pixels = vec![0; k.width * k.height];
    let (mut times, mut count) = (String::new(), 0);
    while let Some(stamp) = source.next_into(&mut pixels).unwrap() {
        assert_eq!(stamp.sequence, count as u64, "a frame was lost in recording");
        let path = folder.join(format!("{count:06}.png"));
        write_gray_png(&path, k.width, k.height, &pixels).unwrap();
        let nanos = stamp.capture_nanos;
        times += &format!("{}.{:09}\n", nanos / 1_000_000_000, nanos % 1_000_000_000);
        count += 1;
    }
    std::fs::write(folder.join("times.txt"), times).unwrap();
    count
}

fn replay(source: &str, output: &Path) -> [Vec<u8>; 2] {
    let mut replay = Command::new(semidense());
    replay.args(["replay", source, "--output"]).arg(output);
    succeed({
        replay.stdout(Stdio::piped()).stderr(Stdio::piped());
        replay
    });
    ["trajectory.txt", "keyframes.txt"].map(|name| std::fs::read(output.join(name)).unwrap())
}

#[test]
fn replaying_a_recorded_live_run_gives_the_poses_of_its_frames() {
    let rig = Rig::new();
    let at = |name: &str| rig.folder().join(name);
    let recording = at("run.mcap");
    let mut recorder = Process::start(rig.bridge(&["record", "--output", "run.mcap"]));
    let source = format!("loop:{FRAMES}:{RATE_HZ}:sim");
    succeed(rig.run(FRAMES, &["--live", &source]));
    until("the end of the recording", || (!recorder.is_running()).then_some(()));

    let count = write_images(&recording, &at("images"));
    assert!(count > FRAMES / 2, "{count} frames were recorded");
    let recorded = format!("mcap:{}", recording.display());
    let first = replay(&recorded, &at("a"));
    assert!(!first[0].is_empty(), "nothing was tracked");
    assert!(first == replay(&recorded, &at("b")), "two replays differ");
    let images = format!("images:{}", at("images").display());
    assert!(first == replay(&images, &at("c")), "the recording and its images differ");
}
