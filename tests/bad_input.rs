//! What a recording or an output folder can be wrong in: one line that names the place, exit code 1,
//! no panic, nothing left behind.

#[allow(dead_code, reason = "every test uses its part of what they share")]
mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use support::{Ended, Rig, finish};

/// Frames of the recording that is broken; each image has a line of the list, after two of comment.
const FRAMES: usize = 5;
const COMMENT_LINES: usize = 2;

/// A small recording in TUM layout.
fn recording(rig: &Rig) -> PathBuf {
    let folder = rig.folder().join("recording");
    let mut command = rig.command(&["simulate", "--force", "--output"]);
    command.arg(&folder).args(["--frames", &FRAMES.to_string()]);
    command.args(["--width", "64", "--height", "48", "--focal", "52"]);
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    folder
}

/// The image of a frame.
fn image(folder: &Path, frame: usize) -> PathBuf {
    let list = fs::read_to_string(folder.join("rgb.txt")).unwrap();
    let line = list.lines().nth(COMMENT_LINES + frame).unwrap();
    folder.join(line.split_whitespace().nth(1).unwrap())
}

/// Changes the lines of a list.
fn rewrite(list: &Path, change: impl Fn(&mut Vec<String>)) {
    let mut lines: Vec<String> =
        fs::read_to_string(list).unwrap().lines().map(str::to_owned).collect();
    change(&mut lines);
    fs::write(list, lines.join("\n") + "\n").unwrap();
}

/// Exit code 1 and exactly one error, with these words.
fn assert_refused(ended: &Ended, words: &[&str], what: &str) {
    assert_eq!(ended.status.code(), Some(1), "{what}: {}", ended.stderr);
    assert!(!ended.stderr.contains("panicked"), "{what}: {}", ended.stderr);
    let errors: Vec<_> = ended.stderr.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{what}: {}", ended.stderr);
    for word in words {
        assert!(errors[0].contains(word), "{what}: `{word}` is not in: {}", errors[0]);
    }
}

#[test]
fn recordings_that_are_wrong_are_refused_by_run_and_replay() {
    type Break = fn(&Path);
    let cases: &[(&str, Break, &[&str])] = &[
        (
            "missing image",
            |d| fs::remove_file(image(d, 3)).unwrap(),
            &["rgb/", "cannot be read: No such file"],
        ),
        ("empty image", |d| fs::write(image(d, 2), "").unwrap(), &["rgb/", "is empty"]),
        (
            "truncated image",
            |d| {
                let bytes = fs::read(image(d, 2)).unwrap();
                fs::write(image(d, 2), &bytes[..bytes.len() / 2]).unwrap();
            },
            &["rgb/", "damaged PNG"],
        ),
        (
            "a rig of another size",
            |d| fs::write(d.join("camera.txt"), "100 100 50 50 320 240\n").unwrap(),
            &["64x48", "320x240", "rig"],
        ),
        (
            "a camera of not-a-number",
            |d| fs::write(d.join("camera.txt"), "nan 100 50 50 64 48\n").unwrap(),
            &["camera.txt", "nan"],
        ),
        ("no camera", |d| fs::remove_file(d.join("camera.txt")).unwrap(), &["camera.txt", "--rig"]),
        (
            "stamps that go back",
            |d| rewrite(&d.join("rgb.txt"), |l| l.swap(COMMENT_LINES + 1, COMMENT_LINES + 2)),
            &["rgb.txt, line 5", "earlier"],
        ),
        (
            "two equal stamps",
            |d| {
                rewrite(&d.join("rgb.txt"), |l| {
                    l[COMMENT_LINES + 1] = l[COMMENT_LINES].clone();
                });
            },
            &["rgb.txt, line 4", "same time stamp"],
        ),
        (
            "a line without stamp",
            |d| {
                rewrite(&d.join("rgb.txt"), |l| {
                    let line = l[COMMENT_LINES + 1].clone();
                    l[COMMENT_LINES + 1] = line.split_whitespace().nth(1).unwrap().to_owned();
                });
            },
            &["rgb.txt, line 4", "timestamp"],
        ),
        (
            "a stamp that is none",
            |d| rewrite(&d.join("rgb.txt"), |l| l[COMMENT_LINES] = "inf rgb/x.png".to_owned()),
            &["rgb.txt, line 3", "inf"],
        ),
        ("no frame", |d| fs::write(d.join("rgb.txt"), "# none\n").unwrap(), &["no frames"]),
    ];
    for (what, broken, words) in cases {
        let rig = Rig::new();
        let folder = recording(&rig);
        broken(&folder);
        let source = format!("tum:{}", folder.display());
        let output = rig.output();
        let output = output.to_str().unwrap();
        for arguments in [vec!["run", "--strict", &source], vec!["replay", "--strict", &source]] {
            let ended = finish(rig.command(&[&arguments[..], &["--output", output]].concat()));
            assert_refused(&ended, words, what);
            assert_eq!(rig.leftovers(), Vec::<String>::new(), "{what}");
        }
    }
}

#[test]
fn an_output_folder_that_cannot_be_made_is_refused_before_any_work() {
    let rig = Rig::new();
    let file = rig.folder().join("file");
    fs::write(&file, "x").unwrap();
    let below = file.join("output");
    for output in [file.to_str().unwrap(), below.to_str().unwrap(), "/proc/output"] {
        for command in [&["run"][..], &["replay", "sim"], &["simulate"]] {
            let ended = finish(rig.command(&[command, &["--output", output]].concat()));
            // The simulator names the folder that it writes until all of it is there.
            let name = Path::new(output).file_name().unwrap().to_str().unwrap();
            assert_refused(&ended, &[name], output);
            assert!(!ended.stderr.contains("preparing"), "{}", ended.stderr);
        }
    }
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn a_folder_that_is_not_there_is_named() {
    let rig = Rig::new();
    let output = rig.output();
    for kind in ["tum", "euroc", "images"] {
        let source = format!("{kind}:/nowhere/at-all");
        for arguments in [vec!["run", "--source", &source], vec!["replay", &source]] {
            let output = output.to_str().unwrap();
            let ended = finish(rig.command(&[&arguments[..], &["--output", output]].concat()));
            assert_refused(&ended, &[&source, "no folder /nowhere/at-all"], kind);
        }
    }
}

#[test]
fn a_rig_of_another_camera_is_warned_of_in_one_line() {
    let rig = Rig::new();
    let folder = recording(&rig);
    let (camera, output) = (rig.folder().join("other.toml"), rig.output());
    let source = format!("tum:{}", folder.display());
    for (focal, is_warned) in [(52.0, false), (60.0, true)] {
        let text = format!(
            "model = \"pinhole\"\nwidth = 64\nheight = 48\nfx = {focal}\nfy = {focal}\ncx = 31.5\ncy = 23.5\n"
        );
        fs::write(&camera, text).unwrap();
        for arguments in [vec!["run", "--source", &source], vec!["replay", &source]] {
            let mut command = rig.command(&arguments);
            command.arg("--rig").arg(&camera).arg("--output").arg(&output);
            let ended = finish(command);
            // Nothing can be tracked on so few pictures.
            assert_eq!(ended.status.code(), Some(3), "{}", ended.stderr);
            let warnings: Vec<_> =
                ended.stderr.lines().filter(|line| line.contains("camera.txt")).collect();
            assert_eq!(warnings.len(), usize::from(is_warned), "{}", ended.stderr);
            assert!(warnings.iter().all(|line| line.contains("other.toml")), "{warnings:?}");
        }
    }
}

/// The binary in a shell whose children may write files of a few kilobytes at most: to a program a
/// full disk looks much the same.
fn with_small_files(rig: &Rig, arguments: &str) -> Command {
    let mut command = Command::new("sh");
    command
        .arg("-c")
        .arg(format!(
            "ulimit -f 16; trap '' XFSZ; exec '{}' {arguments}",
            env!("CARGO_BIN_EXE_semidense")
        ))
        .env("SEMIDENSE_ROOT", rig.root())
        .stdin(std::process::Stdio::null())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped());
    command
}

#[test]
fn results_that_do_not_fit_are_one_line_and_no_half_file() {
    let rig = Rig::new();
    let output = rig.output();
    let arguments = format!("replay sim --frames 2 --output '{}'", output.display());
    let ended = finish(with_small_files(&rig, &arguments));
    assert_refused(&ended, &["output/report.html", "MB are free", "--output"], "full folder");
    let names: Vec<String> = fs::read_dir(&output)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    // The run is not lost: its journal is all that there is.
    assert!(names.len() == 1 && names[0].starts_with(".semidense-journal"), "{names:?}");
}

#[test]
fn a_full_standard_output_is_an_error_and_a_reader_that_leaves_is_none() {
    let rig = Rig::new();
    let folder = recording(&rig);
    let truth = folder.join("groundtruth.txt");
    let evaluate = || {
        let mut command = rig.command(&["evaluate"]);
        command.arg(&truth).arg(&truth);
        command
    };
    let mut command = evaluate();
    command.stdout(fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    assert_refused(&finish(command), &["standard output"], "/dev/full");

    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let mut command = evaluate();
    command.stdout(writer);
    let ended = finish(command);
    assert!(ended.status.success() && ended.stderr.is_empty(), "{}", ended.stderr);
}
