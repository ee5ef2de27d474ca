//! A recording with unusable images: they are skipped, counted and reported; all valid ones are tracked, with the same
//! result in one process and in three.

use std::fs;
use std::path::{Path, PathBuf};

use crate::rendered::rendered;
use crate::support::{Ended, Rig, finish};
use serde_json::Value;

const FRAMES: usize = 40;
/// Exit code of a run that tracked nothing.
const NOTHING_TRACKED: i32 = 3;

/// The image of a frame.
fn image(folder: &Path, frame: usize) -> PathBuf {
    let list = fs::read_to_string(folder.join("rgb.txt")).unwrap();
    let line = list.lines().filter(|line| !line.starts_with('#')).nth(frame).unwrap();
    folder.join(line.split_whitespace().nth(1).unwrap())
}

fn cut(path: &Path) {
    let bytes = fs::read(path).unwrap();
    fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
}

fn give_other_size(path: &Path) {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, 20, 20);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.write_header().unwrap().write_image_data(&[9; 400]).unwrap();
    fs::write(path, bytes).unwrap();
}

/// Damages images in every possible way; returns the frames that are lost.
fn break_some(folder: &Path) -> [usize; 7] {
    cut(&image(folder, 0));
    fs::remove_file(image(folder, 5)).unwrap();
    fs::write(image(folder, 6), "").unwrap();
    give_other_size(&image(folder, 13));
    fs::write(image(folder, 20), [0xff, 0xd8, 0xff, 0xe0, 0, 9]).unwrap();
    fs::remove_file(image(folder, 27)).unwrap();
    fs::create_dir(image(folder, 27)).unwrap();
    fs::remove_file(image(folder, 39)).unwrap();
    let made = std::process::Command::new("mkfifo").arg(image(folder, 39)).status().unwrap();
    assert!(made.success());
    [0, 5, 6, 13, 20, 27, 39]
}

fn play(rig: &Rig, arguments: &[&str], folder: &Path, output: &str) -> (Ended, PathBuf) {
    let output = rig.folder().join(output);
    let mut command = rig.command(arguments);
    command.arg(folder).arg("--output").arg(&output);
    (finish(command), output)
}

fn summary(output: &Path) -> Value {
    serde_json::from_slice(&fs::read(output.join("summary.json")).unwrap()).unwrap()
}

#[test]
fn damaged_images_are_skipped_and_the_rest_is_tracked_identically() {
    let rig = Rig::new();
    let folder = rendered(&rig, FRAMES);
    let lost = break_some(&folder);
    let mut trajectories = Vec::new();
    for (arguments, name) in
        [(&["replay"][..], "replay"), (&["run"], "lockstep"), (&["run", "--live"], "live")]
    {
        let (ended, output) = play(&rig, arguments, &folder, name);
        // Live, a busy machine may have no time for a start.
        let has_started = ended.status.code() != Some(NOTHING_TRACKED);
        assert!(ended.status.success() || name == "live" && !has_started, "{}", ended.stderr);
        let summary = summary(&output);
        assert_eq!(summary["frames_refused"], lost.len(), "{name}: {}", ended.stderr);
        assert_eq!(summary["frames_in"], FRAMES - lost.len(), "{name}");
        assert_eq!(summary["gaps"], 0, "{name}");
        let first = summary["refused"].as_str().unwrap();
        assert!(first.starts_with("7 left out, the first: "), "{name}: {first}");
        assert!(first.contains(image(&folder, 0).to_str().unwrap()), "{name}: {first}");
        for frame in lost {
            let path = image(&folder, frame).display().to_string();
            assert!(ended.stderr.contains(&path), "{name}: {path} is not in {}", ended.stderr);
        }
        assert!(ended.stderr.contains("it is a named pipe"), "{}", ended.stderr);
        let last = ended.stdout.lines().last().unwrap_or_default();
        assert!(
            !has_started || last.contains("7 of 40 images could not be used"),
            "{name}: {last}"
        );
        trajectories.push(fs::read(output.join("trajectory_online.txt")).unwrap());
        assert_eq!(rig.leftovers(), Vec::<String>::new());
    }
    assert!(trajectories[0].len() > 1000, "something was tracked");
    assert!(trajectories[0] == trajectories[1], "replay and lockstep give the same poses");
}

#[test]
fn a_strict_run_ends_at_the_first_damaged_image() {
    let rig = Rig::new();
    let folder = rendered(&rig, FRAMES);
    cut(&image(&folder, 9));
    for arguments in [&["replay", "--strict"][..], &["run", "--strict"]] {
        let (ended, _) = play(&rig, arguments, &folder, "strict");
        assert_eq!(ended.status.code(), Some(1), "{arguments:?}: {}", ended.stderr);
        let error = ended.stderr.lines().find(|line| line.starts_with("error: ")).unwrap();
        assert!(error.contains(image(&folder, 9).to_str().unwrap()), "{error}");
        assert!(error.contains("damaged PNG"), "{error}");
        assert!(error.ends_with("the results cover the 9 frames before it"), "{error}");
    }
}

#[test]
fn a_recording_without_a_valid_image_is_an_error() {
    let rig = Rig::new();
    let folder = rendered(&rig, FRAMES);
    (0..FRAMES).for_each(|frame| cut(&image(&folder, frame)));
    for arguments in [&["replay"][..], &["run"], &["run", "--live"]] {
        let (ended, _) = play(&rig, arguments, &folder, "none");
        assert_eq!(ended.status.code(), Some(1), "{arguments:?}: {}", ended.stderr);
        let error = ended.stderr.lines().find(|line| line.starts_with("error: ")).unwrap();
        assert!(error.contains("none of its 40 images can be used; the first: "), "{error}");
        assert_eq!(ended.stderr.lines().filter(|l| l.contains("damaged")).count(), 1, "{error}");
    }
}

#[test]
fn damaged_depth_images_do_not_cost_the_results() {
    let rig = Rig::new();
    let folder = rendered(&rig, FRAMES);
    for entry in fs::read_dir(folder.join("depth")).unwrap() {
        cut(&entry.unwrap().path());
    }
    let (ended, output) = play(&rig, &["replay"], &folder, "depth");
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stderr.contains("depth/") && ended.stderr.contains("damaged PNG"));
    let summary = summary(&output);
    assert!(summary["depth_pixels"].is_null() && summary["frames_tracked"].as_u64() > Some(20));
}
