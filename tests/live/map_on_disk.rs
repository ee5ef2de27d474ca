//! The map on disk: started by one process, continued by another, complete after a kill, unchanged if read-only.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::{Rig, WATCH_DOG, end, finish, small_camera, until};
use semidense::service::journal::folder::unfinished;
use semidense::service::journal::recovered::Recovered;
use semidense::service::map_folder::reading::{load, read_manifest};
use semidense::service::trajectory_file::read_trajectory;
use semidense::slam::map::Map;
use serde_json::Value;

/// Frames of a run that creates several keyframes.
const FRAMES: usize = 150;

/// A command on the small simulated camera, with this map.
fn with_map(rig: &Rig, command: &str, output: &Path, map: &Path, arguments: &[&str]) -> Command {
    let mut command = rig.command(&[command, "sim", "--json"]);
    command.arg("--output").arg(output).arg("--map").arg(map);
    for setting in small_camera(FRAMES) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    command.args(arguments);
    command
}

/// Runs a command that must succeed; returns its summary.
fn done(command: Command) -> Value {
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    serde_json::from_str(&ended.stdout).unwrap()
}

/// Every file of a folder with its content.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        match entry.file_type().unwrap().is_dir() {
            true => found.extend(contents(&entry.path())),
            false => found.push((entry.path(), fs::read(entry.path()).unwrap())),
        }
    }
    found.sort();
    found
}

fn copy(from: &Path, to: &Path) {
    for (path, bytes) in contents(from) {
        let path = to.join(path.strip_prefix(from).unwrap());
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
}

fn loaded(folder: &Path) -> Map {
    let loaded = load(folder, usize::MAX).unwrap();
    assert!(loaded.problems.is_empty(), "{:?}", loaded.problems);
    loaded.map
}

#[test]
fn the_camera_is_relocalised_in_a_read_only_map() {
    let rig = Rig::new();
    let (map, first, second) =
        (rig.folder().join("map"), rig.folder().join("first"), rig.folder().join("second"));
    let summary = done(with_map(&rig, "replay", &first, &map, &[]));
    let keyframes = loaded(&map).keyframes;
    assert_eq!(summary["keyframes"], keyframes.len());
    assert!(keyframes.iter().all(|keyframe| keyframe.has_depth()), "the active one too");
    let before = contents(&map);
    let summary = done(with_map(&rig, "replay", &second, &map, &["--read-only"]));
    assert!(contents(&map) == before, "something in the folder has changed");
    assert_eq!(summary["keyframes"], keyframes.len());
    // The same frames are at the same poses; the first pass knew some of them only afterwards.
    let truth = read_trajectory(&first.join("trajectory.txt")).unwrap();
    let found = read_trajectory(&second.join("trajectory.txt")).unwrap();
    assert!(found.len() > FRAMES * 9 / 10, "{} frames", found.len());
    let mut errors: Vec<f64> = found
        .iter()
        .filter_map(|pose| {
            let same = truth.iter().find(|of| of.nanos == pose.nanos)?;
            let apart = pose.world_from_camera.translation - same.world_from_camera.translation;
            Some(apart.norm())
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    let length: f64 = truth
        .windows(2)
        .map(|pair| {
            let [a, b] = [pair[0], pair[1]].map(|pose| pose.world_from_camera.translation);
            (b - a).norm()
        })
        .sum();
    let median = errors[errors.len() / 2];
    assert!(median < 0.01 * length, "{median} of a path of {length}");
}

#[test]
fn the_next_run_continues_in_the_same_epoch_and_lockstep_gives_the_same_bits() {
    let rig = Rig::new();
    let at = |name: &str| rig.folder().join(name);
    done(with_map(&rig, "replay", &at("first"), &at("map"), &["--frames", "80"]));
    let begun = loaded(&at("map"));
    copy(&at("map"), &at("copy"));
    let summary = done(with_map(&rig, "replay", &at("second"), &at("map"), &[]));
    assert!(summary["frames_tracked"].as_u64() > Some(FRAMES as u64 * 9 / 10), "{summary}");
    let grown = loaded(&at("map"));
    let epochs: BTreeSet<u32> = grown.keyframes.iter().map(|keyframe| keyframe.epoch).collect();
    assert_eq!(epochs, BTreeSet::from([0]), "another epoch was begun");
    assert!(grown.keyframes.len() > begun.keyframes.len());
    let ids: Vec<u64> = begun.keyframes.iter().map(|keyframe| keyframe.keyframe_id).collect();
    assert!(ids.iter().all(|id| grown.get(*id).is_some()), "what was there stays");
    done(with_map(&rig, "run", &at("lockstep"), &at("copy"), &["--lockstep"]));
    let trajectory = |name: &str| fs::read(at(name).join("trajectory.txt")).unwrap();
    assert!(trajectory("second") == trajectory("lockstep"));
    assert!(loaded(&at("copy")).keyframes == grown.keyframes);
}

#[test]
fn a_kill_at_any_instant_leaves_a_complete_map_at_most_a_keyframe_old() {
    let rig = Rig::new();
    let (map, output) = (rig.folder().join("map"), rig.folder().join("output"));
    let (mut saves, mut has_run) = (0, false);
    for trial in 0..12u64 {
        let mut child = with_map(&rig, "replay", &output, &map, &[]).spawn().unwrap();
        // The first kill is before any keyframe, each other one a given number of saves and then a delay later, which
        // meets every part of the next save.
        let wanted = saves + trial % 4 + u64::from(trial > 0);
        let wait = Duration::from_millis(trial * 37 % 60);
        let begin = Instant::now();
        let has_saved = || read_manifest(&map).is_ok_and(|(of, _)| of.saves >= wanted);
        while trial > 0 && !has_saved() && child.try_wait().unwrap().is_none() {
            assert!(begin.elapsed() < WATCH_DOG, "nothing was saved");
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(wait);
        // It may have ended already, which is fine.
        drop(child.kill());
        drop(end(child));
        let journal = unfinished(None, &output);
        let made = journal.first().and_then(|found| Recovered::read(&found.folder).ok());
        match load(&map, usize::MAX) {
            Ok(loaded) => {
                assert!(loaded.problems.is_empty(), "trial {trial}: {:?}", loaded.problems);
                assert!(loaded.manifest.saves >= saves, "trial {trial}: an older map");
                saves = loaded.manifest.saves;
                has_run = true;
                let made = made.map_or(0, |of| of.map(&journal[0].folder, 1 << 30).keyframes.len());
                let kept = loaded.map.keyframes.len();
                // One is being observed, and one may be in transit.
                assert!(kept + 2 >= made, "trial {trial}: {kept} of {made} keyframes");
                assert!(loaded.map.keyframes.iter().all(|of| of.has_depth()), "trial {trial}");
            }
            Err(error) => {
                assert!(!has_run, "trial {trial}: {error}");
                assert!(error.to_string().contains("holds no map"), "{error}");
            }
        }
        // The next trial begins at the first frame again.
        journal.iter().for_each(|found| fs::remove_dir_all(&found.folder).unwrap());
    }
    assert!(has_run && saves > 3, "no trial has saved anything");
}

#[test]
fn maps_that_do_not_fit_are_refused_in_one_line() {
    let rig = Rig::new();
    let (map, output) = (rig.folder().join("map"), rig.folder().join("output"));
    done(with_map(&rig, "replay", &output, &map, &["--frames", "60"]));
    let refused = |arguments: &[&str], map: &Path| {
        let ended = finish(with_map(&rig, "replay", &output, map, arguments));
        assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
        let lines: Vec<&str> = ended.stderr.lines().filter(|l| l.contains("error")).collect();
        assert_eq!(lines.len(), 1, "{}", ended.stderr);
        lines[0].to_owned()
    };
    let other = refused(&["--set", "simulator.focal_px=140.0"], &map);
    assert!(other.contains("another camera") && other.contains("140"), "{other}");
    // A run reports this before it starts anything.
    let never = rig.folder().join("never");
    let ended = finish(with_map(&rig, "run", &never, &map, &["--set", "simulator.focal_px=140.0"]));
    assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
    assert!(ended.stderr.contains("another camera") && !never.exists(), "{}", ended.stderr);
    let missing = refused(&["--read-only"], &rig.folder().join("nowhere"));
    assert!(missing.contains("holds no map"), "{missing}");
    let given = refused(&["--poses", "groundtruth"], &map);
    assert!(given.contains("--poses groundtruth"), "{given}");
    let manifest = map.join("manifest");
    let mut newer = fs::read(&manifest).unwrap();
    newer[16] = 200;
    fs::write(&manifest, newer).unwrap();
    let version = refused(&[], &map);
    assert!(version.contains("version 200"), "{version}");
}

fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let (path, copy) = (entry.path(), to.join(entry.file_name()));
        match path.is_dir() {
            true => copy_folder(&path, &copy),
            false => drop(fs::copy(&path, &copy).unwrap()),
        }
    }
}

#[test]
fn a_map_is_described_exported_and_merged() {
    let rig = Rig::new();
    let at = |name: &str| rig.folder().join(name);
    done(with_map(&rig, "replay", &at("output"), &at("map"), &["--frames", "60"]));
    let map = |arguments: &[&str]| {
        let mut command = rig.command(&["map"]);
        command.current_dir(rig.folder()).args(arguments);
        finish(command)
    };
    let info = map(&["info", "map", "--json"]);
    assert!(info.status.success(), "{}", info.stderr);
    let info: Value = serde_json::from_str(&info.stdout).unwrap();
    let keyframes = loaded(&at("map")).keyframes.len();
    assert_eq!(
        (&info["keyframes"], &info["keyframes_with_depth"]),
        (&keyframes.into(), &keyframes.into())
    );
    assert!(map(&["export", "map", "--output", "exported"]).status.success());
    let poses = read_trajectory(&at("exported").join("keyframes.txt")).unwrap();
    assert_eq!(poses.len(), keyframes);
    assert!(fs::read(at("exported").join("map.ply")).unwrap().starts_with(b"ply"));
    let twice = map(&["merge", "map", "./map", "--output", "both"]);
    assert!(twice.stderr.contains("named twice") && !at("both").exists(), "{}", twice.stderr);
    copy_folder(&at("map"), &at("same"));
    assert!(map(&["merge", "map", "same", "--output", "both"]).status.success());
    let both = loaded(&at("both"));
    let epochs: BTreeSet<u32> = both.keyframes.iter().map(|keyframe| keyframe.epoch).collect();
    assert_eq!((both.keyframes.len(), epochs.len()), (2 * keyframes, 2));
    // One file is damaged: it is named, and everything else is intact.
    let file = contents(&at("map/keyframes"))[0].0.clone();
    fs::write(&file, "semidense").unwrap();
    let info = map(&["info", "map"]);
    assert_eq!(info.status.code(), Some(1));
    let name = file.file_name().unwrap().to_string_lossy().into_owned();
    assert!(info.stderr.contains(&name), "{}", info.stderr);
}

#[test]
fn a_running_mapper_saves_on_request() {
    let rig = Rig::new();
    let map = rig.folder().join("map");
    let source = "loop:1000000:30:sim";
    let mut command = rig.run(40, &["--live", "--source", source]);
    let mut child = command.arg("--map").arg(&map).spawn().unwrap();
    let copy = rig.folder().join("copy");
    until("a saved map", || {
        let mut save = rig.command(&["map", "save"]);
        save.arg(&copy);
        finish(save).status.success().then_some(())
    });
    let again = finish(rig.command(&["map", "save"]));
    assert!(again.status.success(), "{}", again.stderr);
    assert!(!loaded(&copy).keyframes.is_empty() && !loaded(&map).keyframes.is_empty());
    drop(child.kill());
    drop(child.wait());
}
