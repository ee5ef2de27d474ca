//! A running mapper switches to the map in another folder, and stays in its own if that cannot be used.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Child;

use crate::support::{Ended, Rig, end, finish, journal_of, signal, small_camera, until};
use rustix::process::{Pid, Signal, kill_process};
use semidense::service::health::cause;
use semidense::service::journal::recovered::Recovered;
use semidense::service::map_folder::reading::{load, read_manifest};
use semidense::service::peers::Peer;
use semidense::slam::map::Map;
use semidense::wire::port::Hub;
use semidense::wire::topic::MAPPER_HEALTH;

/// A room seen repeatedly, at the camera's rate, for longer than the tests take on a busy machine: they end it.
const SOURCE: &str = "loop:1000:30:sim";

/// A map of the simulated room, or of another camera's view of it.
fn make_map(rig: &Rig, name: &str, setting: Option<&str>) -> PathBuf {
    let map = rig.folder().join(name);
    let mut command = rig.command(&["replay", "sim", "--json"]);
    command.arg("--output").arg(rig.folder().join("output-of-map")).arg("--map").arg(&map);
    for setting in small_camera(150) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    if let Some(setting) = setting {
        command.args(["--set", setting]);
    }
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    map
}

/// A run with its own map.
struct Running {
    child: Child,
    own: PathBuf,
    _hub: Hub,
    mapper: Peer,
}

impl Running {
    fn start(rig: &Rig) -> Self {
        let own = rig.folder().join("own");
        let mut command = rig.run(120, &["--live", "--json", "--source", SOURCE]);
        let child = command.arg("--map").arg(&own).spawn().unwrap();
        let hub = rig.observe();
        let mapper = until("the mapper's health", || Peer::open(&hub, &MAPPER_HEALTH).ok());
        let mut running = Self { child, own, _hub: hub, mapper };
        running.wait_for("mapping");
        until("a keyframe on the disk", || (!keyframes(&running.own).is_empty()).then_some(()));
        running
    }

    /// Waits until the mapper's own report starts with `beginning`.
    fn wait_for(&mut self, beginning: &str) {
        until(beginning, || {
            self.mapper.update().ok()?;
            cause(self.mapper.last()?).starts_with(beginning).then_some(())
        });
    }

    /// Ends it as Ctrl-C does; returns its summary.
    fn stop(self) -> serde_json::Value {
        const INTERRUPTED: i32 = 130;
        signal(&self.child, Signal::INT);
        let ended = end(self.child);
        assert_eq!(ended.status.code(), Some(INTERRUPTED), "{}", ended.stderr);
        assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
        serde_json::from_str(&ended.stdout).unwrap()
    }
}

fn load_map(rig: &Rig, arguments: &[&str], map: &Path) -> Ended {
    let mut command = rig.command(&["map", "load"]);
    command.arg(map).args(arguments);
    finish(command)
}

/// Ids of the keyframes on disk.
fn keyframes(map: &Path) -> Vec<u64> {
    let listed = read_manifest(map).map(|(manifest, _)| manifest.keyframes).unwrap_or_default();
    listed.iter().map(|listed| listed.keyframe.keyframe_id).collect()
}

fn saves(map: &Path) -> u64 {
    read_manifest(map).unwrap().0.saves
}

fn whole(map: &Path) -> Map {
    let loaded = load(map, usize::MAX).unwrap();
    assert!(loaded.problems.is_empty(), "{:?}", loaded.problems);
    loaded.map
}

fn epochs(map: &Map) -> BTreeSet<u32> {
    map.keyframes.iter().map(|keyframe| keyframe.epoch).collect()
}

#[test]
fn a_running_mapper_continues_in_another_map_and_so_does_its_successor() {
    let rig = Rig::new();
    let other = make_map(&rig, "other", None);
    let (before, first_saves) = (keyframes(&other), saves(&other));
    let mut running = Running::start(&rig);
    let loaded = load_map(&rig, &[], &other);
    assert!(loaded.status.success(), "{}", loaded.stderr);
    let own = whole(&running.own);
    assert!(own.keyframes.iter().all(|keyframe| keyframe.has_depth()), "it was saved first");
    running.wait_for("localised");
    // The previous folder is released: it is an ordinary map, and no process writes to it any more.
    let own_saves = saves(&running.own);
    until("a save in the other map", || (saves(&other) > first_saves).then_some(()));
    // The successor after a crash continues in the same map.
    let claim = fs::read_to_string(rig.root().join("semidense.mapper.lock")).unwrap();
    let killed: i32 = claim.trim().parse().unwrap();
    kill_process(Pid::from_raw(killed).unwrap(), Signal::KILL).unwrap();
    let second_saves = saves(&other);
    until("a save of the next mapper", || (saves(&other) > second_saves + 1).then_some(()));
    let own_folder = running.own.clone();
    let summary = running.stop();
    let reasons = summary["grade"]["reasons"].to_string();
    assert!(summary["epochs"] == 2 && !reasons.contains("separate parts"), "{summary}");
    assert_eq!(saves(&own_folder), own_saves, "the map before was written again");
    assert_eq!(whole(&own_folder).keyframes, own.keyframes);
    // On disk the earlier ids are unchanged, and no keyframe of the run's own map is among them.
    let grown = whole(&other);
    let ids = keyframes(&other);
    assert!(before.iter().all(|id| ids.contains(id)), "{before:?} {ids:?}");
    assert_eq!(epochs(&grown), BTreeSet::from([0]));
    let poses =
        |map: &Map| map.keyframes.iter().filter(|of| before.contains(&of.keyframe_id)).count();
    assert_eq!(poses(&grown), before.len());
    assert!(!rig.root().join("semidense.map").exists(), "an orderly end leaves nothing behind");
}

#[test]
fn a_killed_run_is_recovered_with_the_map_that_it_had_switched_to() {
    let rig = Rig::new();
    let other = make_map(&rig, "other", None);
    let mut running = Running::start(&rig);
    let loaded = load_map(&rig, &[], &other);
    assert!(loaded.status.success(), "{}", loaded.stderr);
    running.wait_for("localised");
    let journal = journal_of(&rig.output(), 1);
    until("the map in the journal", || Recovered::read(&journal).ok()?.loaded_map);
    signal(&running.child, Signal::KILL);
    end(running.child);
    let mut recover = rig.command(&["recover"]);
    recover.arg(rig.output());
    let ended = finish(recover);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stdout.contains(other.to_str().unwrap()), "{}", ended.stdout);
    assert!(!ended.stdout.contains("separate parts"), "{}", ended.stdout);
}

#[test]
fn maps_that_do_not_fit_are_refused_in_one_line_and_the_running_map_continues() {
    let rig = Rig::new();
    let foreign = make_map(&rig, "foreign", Some("simulator.focal_px=140.0"));
    let newer = make_map(&rig, "newer", None);
    let manifest = newer.join("manifest");
    let mut bytes = fs::read(&manifest).unwrap();
    bytes[16] = 200;
    fs::write(&manifest, &bytes).unwrap();
    let damaged = make_map(&rig, "damaged", None);
    for name in ["manifest", "manifest.before"] {
        let mut bytes = fs::read(damaged.join(name)).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(damaged.join(name), bytes).unwrap();
    }
    let running = Running::start(&rig);
    let nowhere = rig.folder().join("nowhere");
    let cases = [
        (foreign.as_path(), "another camera"),
        (newer.as_path(), "version 200"),
        (damaged.as_path(), "checksum"),
        (nowhere.as_path(), "holds no map"),
        (running.own.as_path(), "already uses the map"),
    ];
    for (map, expected) in cases {
        for arguments in [&[][..], &["--read-only"]] {
            let ended = load_map(&rig, arguments, map);
            assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
            let lines: Vec<&str> = ended.stderr.lines().collect();
            assert!(lines.len() == 1 && lines[0].contains(expected), "{:?}", ended.stderr);
        }
    }
    assert!(!nowhere.exists(), "nothing is begun there");
    let before = saves(&running.own);
    until("the next save", || (saves(&running.own) > before).then_some(()));
    let own = running.own.clone();
    running.stop();
    assert_eq!(epochs(&whole(&own)), BTreeSet::from([0]), "the camera was not lost");
}
