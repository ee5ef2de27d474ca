//! Bit-identical results for any number of threads, and for three processes as for one, on a sequence that
//! initialises, tracks and changes keyframes. It is rendered once a test: other tests check that its bytes do not
//! depend on threads.

use std::fs;
use std::path::Path;

use crate::support::{Rig, finish, small_camera};
use serde_json::Value;

/// Half-size images of the default room: 3 s, enough for a map and its first new keyframes.
const SETTINGS: [&str; 4] = [
    "simulator.frames=90",
    "simulator.width=320",
    "simulator.height=240",
    "simulator.focal_px=262.5",
];
/// Files that must be equal.
const FILES: [&str; 5] =
    ["trajectory.txt", "trajectory_online.txt", "keyframes.txt", "map.ply", "points.ply"];

/// Writes the sequence and returns its name as a source.
fn recorded(rig: &Rig) -> String {
    let folder = rig.folder().join("sequence");
    let mut command = rig.command(&["simulate", "--output", folder.to_str().unwrap()]);
    for setting in SETTINGS {
        command.args(["--set", setting]);
    }
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    format!("tum:{}", folder.display())
}

/// Runs a command of the binary and returns its summary.
fn summary(rig: &Rig, arguments: &[&str], output: &Path) -> Value {
    let mut command = rig.command(arguments);
    command.arg("--json").arg("--output").arg(output);
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    serde_json::from_str(&ended.stdout).unwrap()
}

fn contents(output: &Path) -> [Vec<u8>; FILES.len()] {
    FILES.map(|name| fs::read(output.join(name)).unwrap())
}

/// Compares file by file, so that a failure names the file instead of printing a megabyte of bytes.
fn assert_same(one: &[Vec<u8>], other: &[Vec<u8>], what: &str) {
    for (name, (one, other)) in FILES.iter().zip(one.iter().zip(other)) {
        assert!(one == other, "{name} differs: {what}");
    }
}

#[test]
fn threads_and_processes_do_not_change_a_bit() {
    let rig = Rig::new();
    let sequence = recorded(&rig);
    let replayed = ["1", "2", "4"].map(|threads| {
        let output = rig.folder().join(threads);
        let figures = summary(&rig, &["replay", &sequence, "--threads", threads], &output);
        // Equal files of a run that never tracked would prove nothing.
        assert!(figures["frames_tracked"].as_u64().unwrap() >= 45, "{figures}");
        // … nor would those of one whose keyframes were not estimated jointly.
        assert!(figures["adjustments"].as_u64().unwrap() >= 3, "{figures}");
        contents(&output)
    });
    assert_same(&replayed[0], &replayed[1], "1 and 2 threads");
    assert_same(&replayed[0], &replayed[2], "1 and 4 threads");

    let output = rig.folder().join("processes");
    summary(&rig, &["run", "--source", &sequence, "--set", "mapper.threads=2"], &output);
    assert_same(&replayed[0], &contents(&output), "one process and three in lockstep");
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn poses_that_a_run_keeps_only_in_its_journal_equal_those_of_a_replay() {
    let rig = Rig::new();
    // Three hundred are written at a time.
    let long = "loop:900:30:sim";
    let small = small_camera(90).map(|setting| format!("--set=simulator.{setting}"));
    let finished = |arguments: &[&str], output: &Path| {
        let mut command = rig.command(arguments);
        command.args(&small).arg("--output").arg(output);
        let ended = finish(command);
        assert!(ended.status.success(), "{}", ended.stderr);
        contents(output)
    };
    let replayed = finished(&["replay", long], &rig.folder().join("replay"));
    let run = finished(&["run", "--source", long], &rig.folder().join("run"));
    assert_same(&replayed, &run, "poses in memory and in the journal");
}

#[test]
fn no_depth_filter_depends_on_the_number_of_threads() {
    let rig = Rig::new();
    let sequence = recorded(&rig);
    // "gaussian" is the default, which is compared above.
    for filter in ["interval", "both"] {
        let chosen = format!("mapping.depth_filter=\"{filter}\"");
        let replayed = ["1", "3"].map(|threads| {
            let output = rig.folder().join(format!("{filter}-{threads}"));
            let arguments = ["replay", &sequence, "--threads", threads, "--set", &chosen];
            let figures = summary(&rig, &arguments, &output);
            assert!(figures["frames_tracked"].as_u64().unwrap() >= 45, "{filter}: {figures}");
            assert!(figures["keyframes"].as_u64().unwrap() >= 2, "{filter}: {figures}");
            contents(&output)
        });
        assert_same(&replayed[0], &replayed[1], &format!("{filter}, 1 and 3 threads"));
    }
}

#[test]
fn results_of_either_filter_and_of_passes_do_not_depend_on_the_number_of_threads() {
    let rig = Rig::new();
    let sequence = recorded(&rig);
    let of = |threads: &str, source: &str, every: &str| {
        let output = rig.folder().join(format!("{threads}-{source}-{every}"));
        let mut arguments = vec!["replay", &sequence, "--threads", threads];
        let source = format!("mapping.window.points_from=\"{source}\"");
        let every = format!("mapping.window.pass_every={every}");
        // A short sequence has few keyframes: a pass begins with the third.
        let few = ["mapping.window.num_first=2", "mapping.window.num_free=2"];
        for chosen in [&source, &every].map(String::as_str).into_iter().chain(few) {
            arguments.extend(["--set", chosen]);
        }
        let figures = summary(&rig, &arguments, &output);
        let estimates = figures["adjustments"].as_u64().unwrap();
        assert!(estimates >= 3, "points from {source}, {every}: {figures}");
        (contents(&output), estimates)
    };
    let [(one, estimates), (two, _), (four, _)] =
        ["1", "2", "4"].map(|threads| of(threads, "interval", "1"));
    assert_same(&one, &two, "points from interval, with passes, 1 and 2 threads");
    assert_same(&one, &four, "points from interval, with passes, 1 and 4 threads");
    let (_, without) = of("2", "interval", "0");
    assert!(estimates > without, "no piece was estimated: {estimates} of {without}");
    let [(gaussian, _), (gaussian_four, _)] =
        ["1", "4"].map(|threads| of(threads, "gaussian", "1"));
    assert_same(&gaussian, &gaussian_four, "passes, 1 and 4 threads");
    let points = FILES.iter().position(|name| *name == "points.ply").unwrap();
    assert!(gaussian[points] != one[points], "the switch changes no point");
}
