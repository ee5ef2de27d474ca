//! Output folders of runs: one run at a time, no empty remains, and their recovery.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::{Child, Command};

use crate::support::{Ended, Rig, end, finish, journal_of, signal, small_camera, until};
use rustix::process::Signal;
use serde_json::Value;

const INTERRUPTED: i32 = 130;
const NOTHING_TRACKED: i32 = 3;

/// A practically endless sequence from few pictures.
const ENDLESS: &str = "loop:200000:30:sim";

/// Enough frames that their preparation lasts until it is interrupted.
const LONG_PREPARATION: &str = "simulator.frames=3000";

fn command(rig: &Rig, arguments: &[&str]) -> Command {
    let mut command = rig.command(arguments);
    for setting in small_camera(60) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    command
}

fn kill(child: Child) {
    signal(&child, Signal::KILL);
    assert!(!end(child).status.success());
}

fn summary(folder: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(folder.join("summary.json")).unwrap()).unwrap()
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect()
}

#[test]
fn two_runs_cannot_write_to_one_folder() {
    let rig = Rig::new();
    let output = rig.output();
    let to = output.to_str().unwrap();
    let first = command(&rig, &["replay", ENDLESS, "--output", to]).spawn().unwrap();
    journal_of(&output, 200);
    for second in [
        &["replay", "sim", "--frames", "20", "--output", to][..],
        &["run", "--instance", "second", "--output", to],
    ] {
        let ended = finish(command(&rig, second));
        assert_eq!(ended.status.code(), Some(1), "{second:?}: {}", ended.stderr);
        let held = format!("is in use by semidense, process {}", first.id());
        assert!(ended.stderr.contains(&held), "{second:?}: {}", ended.stderr);
    }
    signal(&first, Signal::TERM);
    let ended = end(first);
    assert_eq!(ended.status.code(), Some(INTERRUPTED), "{}", ended.stderr);
    assert!(summary(&output)["frames_tracked"].as_u64().unwrap() > 0);
    assert!(!names(&output).iter().any(|name| name.starts_with('.')), "{:?}", names(&output));
}

#[test]
fn a_run_interrupted_during_its_preparation_leaves_no_folder() {
    let rig = Rig::new();
    let outer = rig.folder().join("new");
    let output = outer.join("output");
    let to = output.to_str().unwrap();
    for name in ["run", "replay"] {
        for (of, code) in
            [(Signal::INT, INTERRUPTED), (Signal::TERM, INTERRUPTED), (Signal::HUP, INTERRUPTED)]
        {
            let arguments = [name, "sim", "--set", LONG_PREPARATION, "--output", to];
            let child = rig.command(&arguments).spawn().unwrap();
            until("a folder", || output.join(".semidense-lock").exists().then_some(()));
            signal(&child, of);
            let ended = end(child);
            assert_eq!(ended.status.code(), Some(code), "{name} {of:?}: {}", ended.stderr);
            assert!(ended.stderr.contains("interrupted before the first"), "{}", ended.stderr);
            assert!(!outer.exists(), "{name} {of:?}");
        }
    }
    fs::create_dir_all(&output).unwrap();
    let arguments = ["replay", "sim", "--set", LONG_PREPARATION, "--output", to];
    let child = rig.command(&arguments).spawn().unwrap();
    until("a lock", || output.join(".semidense-lock").exists().then_some(()));
    signal(&child, Signal::INT);
    end(child);
    assert!(output.exists() && names(&output).is_empty(), "it is the user's");
}

#[test]
fn a_simulation_ends_cleanly_on_every_signal() {
    let rig = Rig::new();
    let folder = rig.folder().join("made");
    fs::create_dir(&folder).unwrap();
    for of in [Signal::INT, Signal::TERM, Signal::HUP] {
        let mut command = rig.command(&["simulate", "--frames", "3000", "--output", "dataset"]);
        let child = command.current_dir(&folder).spawn().unwrap();
        until("frames", || (!names(&folder).is_empty()).then_some(()));
        signal(&child, of);
        let ended = end(child);
        assert_eq!(ended.status.code(), Some(INTERRUPTED), "{of:?}: {}", ended.stderr);
        assert_eq!(names(&folder), Vec::<String>::new(), "{of:?}");
    }
}

/// `recover` in the folder in which the run was started.
fn recover(rig: &Rig, here: &Path) -> Ended {
    let mut command = rig.command(&["recover"]);
    finish({
        command.current_dir(here);
        command
    })
}

#[test]
fn a_recovery_is_marked_as_such_and_reports_what_is_missing() {
    let rig = Rig::new();
    let here = rig.folder().join("here");
    fs::create_dir(&here).unwrap();
    let mut replay = command(&rig, &["replay", ENDLESS]);
    let child = replay.current_dir(&here).spawn().unwrap();
    let output = until("a folder", || {
        let entries = fs::read_dir(here.join("output")).ok()?.flatten();
        entries.map(|entry| entry.path()).find(|path| path.is_dir())
    });
    let journal = journal_of(&output, 500);
    kill(child);
    // As on a full disk, where depth made room for poses.
    for name in names(&journal).iter().filter(|name| name.starts_with("keyframe-")) {
        fs::remove_file(journal.join(name)).unwrap();
    }
    let ended = recover(&rig, &here);
    assert!(ended.status.success(), "{}", ended.stderr);
    let summary = summary(&output);
    let keyframes = summary["keyframes"].as_u64().unwrap();
    assert!(keyframes > 0, "{summary}");
    assert_eq!(summary["keyframes_without_depth"], keyframes);
    let warning = format!("depth of {keyframes} of {keyframes} keyframes is missing: ");
    assert!(ended.stderr.contains(&warning), "{}", ended.stderr);
    let time = summary["recovered_run_end"].as_str().unwrap();
    let said = format!("recovered from the journal of a run that ended at {time}");
    assert!(ended.stdout.lines().last().unwrap().contains(&said), "{}", ended.stdout);
    let report = fs::read_to_string(output.join("report.html")).unwrap();
    assert!(report.to_lowercase().contains(&said.to_lowercase()));
    let latest = fs::read_link(here.join("output/latest")).unwrap();
    assert_eq!(Some(latest.as_os_str()), output.file_name());
}

#[test]
fn a_run_killed_during_its_preparation_has_nothing_to_recover() {
    let rig = Rig::new();
    let here = rig.folder().join("here");
    fs::create_dir(&here).unwrap();
    let mut run = rig.command(&["run", "sim", "--set", LONG_PREPARATION]);
    let child = run.current_dir(&here).spawn().unwrap();
    let output = until("a folder", || {
        let entries = fs::read_dir(here.join("output")).ok()?.flatten();
        entries.map(|entry| entry.path()).find(|path| path.is_dir())
    });
    let journal = journal_of(&output, 0);
    // They clean up once the supervisor is gone.
    until("all processes", || {
        let claims = ["capture", "tracker", "mapper"].map(|name| rig.place().claimant(name));
        claims.iter().all(Option::is_some).then_some(())
    });
    kill(child);
    until("the end of its processes", || {
        let left = rig.leftovers();
        left.iter().all(|name| name.ends_with(".journal")).then_some(())
    });
    assert!(journal.exists());
    let ended = recover(&rig, &here);
    assert_eq!(ended.status.code(), Some(NOTHING_TRACKED), "{}", ended.stderr);
    assert!(ended.stderr.contains("nothing to recover: the run that ended at 20"));
    assert!(ended.stdout.is_empty(), "{}", ended.stdout);
    assert!(!output.exists() && !here.join("output/latest").exists());
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

#[test]
fn a_recovery_finds_a_source_whose_path_is_not_utf8() {
    let rig = Rig::new();
    let (output, recording) = (rig.output(), rig.folder().join(OsStr::from_bytes(b"b\xffd")));
    let mut simulate = command(&rig, &["simulate", "--frames", "400"]);
    simulate.arg("--output").arg(&recording);
    assert!(finish(simulate).status.success());
    let mut run = rig.command(&["run", "--live", "--output", output.to_str().unwrap()]);
    run.arg(&recording);
    let child = run.spawn().unwrap();
    journal_of(&output, 90);
    kill(child);
    let ended = finish(rig.command(&["recover", output.to_str().unwrap()]));
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(!ended.stderr.contains("no comparison with ground truth"), "{}", ended.stderr);
    assert!(summary(&output)["ate_rmse_m"].is_number());
}
