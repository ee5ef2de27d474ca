//! What a run leaves on disk, however it ends: killed, out of space, with nothing tracked.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};

use crate::support::{
    Ended, Rig, end, finish, journal_of, signal, small_camera, until, with_mount,
};
use rustix::process::{Pid, Signal};
use semidense::service::peers::Peer;
use semidense::wire::topic::MAPPER_HEALTH;
use serde_json::Value;

/// The files of a run.
const FILES: [&str; 7] = [
    "trajectory.txt",
    "trajectory_online.txt",
    "keyframes.txt",
    "map.ply",
    "points.ply",
    "summary.json",
    "report.html",
];

/// A practically endless sequence from few pictures: sixty frames back and forth.
const ENDLESS: &str = "loop:200000:30:sim";

fn command(rig: &Rig, arguments: &[&str]) -> Command {
    let mut command = rig.command(arguments);
    for setting in small_camera(60) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    command
}

/// Every file below `folder`, including hidden ones, with its content.
fn content(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        match entry.path().is_dir() {
            true => found.extend(content(&entry.path())),
            false => drop(found.insert(entry.path(), fs::read(entry.path()).unwrap())),
        }
    }
    found
}

fn assert_set(folder: &Path) {
    let names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    assert_eq!(names.len(), FILES.len(), "{names:?}");
    assert!(FILES.iter().all(|file| names.iter().any(|name| name == file)), "{names:?}");
}

fn summary(folder: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(folder.join("summary.json")).unwrap()).unwrap()
}

/// Kills a run that has journaled a few hundred frames; returns its journal.
fn kill(child: Child, output: &Path) -> PathBuf {
    let journal = journal_of(output, 500);
    signal(&child, Signal::KILL);
    assert!(!end(child).status.success());
    journal
}

/// Lines of a file that are not comments.
fn lines(path: &Path) -> Vec<String> {
    let text = fs::read_to_string(path).unwrap();
    text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect()
}

/// Recovers `output` and compares it with an undisturbed replay of as many frames.
fn assert_recovered(rig: &Rig, output: &Path) -> Ended {
    let ended = finish(rig.command(&["recover", output.to_str().unwrap()]));
    assert!(ended.status.success(), "{}", ended.stderr);
    assert_set(output);
    let found = summary(output);
    assert_eq!(found["ended"], "recovered");
    assert!(fs::read_to_string(output.join("report.html")).unwrap().contains("recovered"));
    let frames = found["frames_in"].as_u64().unwrap().to_string();
    let whole = rig.folder().join("whole");
    let replayed = ["replay", ENDLESS, "--frames", &frames, "--output", whole.to_str().unwrap()];
    let replayed = finish(command(rig, &replayed));
    assert!(replayed.status.success(), "{}", replayed.stderr);
    let pair = |file: &str| (lines(&whole.join(file)), lines(&output.join(file)));
    let (all, mine) = pair("trajectory_online.txt");
    assert!(mine.len() >= 400, "{} poses", mine.len());
    assert!(mine == all, "trajectory_online.txt differs");
    // The replay estimated final poses again at its end, and realigned frames, or frames aligned to a map that began
    // after them, are not journaled: the same frames except for those, at nearly the same poses.
    let (all, mine) = pair("trajectory.txt");
    let expected = summary(&whole);
    let later = expected["frames_tracked_later"].as_u64().unwrap();
    assert_eq!(mine.len() as u64 + later, all.len() as u64);
    let tracked = |of: &Value| of["frames_tracked"].as_u64().unwrap();
    assert_eq!(tracked(&found) + later, tracked(&expected));
    // If the truth is known.
    assert_eq!(found["matched_poses"].is_null(), expected["matched_poses"].is_null());
    if let (Some(found), Some(expected)) =
        (found["matched_poses"].as_u64(), expected["matched_poses"].as_u64())
    {
        assert_eq!(found + later, expected);
    }
    let [mine, all] = [output, &whole].map(|folder| folder.join("trajectory.txt"));
    let files = [mine.to_str().unwrap(), all.to_str().unwrap()];
    let compared = finish(command(rig, &["evaluate", "--json", files[0], files[1]]));
    assert!(compared.status.success(), "{}", compared.stderr);
    let compared: Value = serde_json::from_str(&compared.stdout).unwrap();
    let [apart, path] = ["ate_rmse_m", "path_length_m"].map(|key| compared[key].as_f64().unwrap());
    assert!(apart < 0.01 * path, "{apart} apart on {path}");
    assert!(found["adjustments"].as_u64() > Some(0), "{found}");
    // The newest keyframe may have arrived after the last write, and the start's first frame is never published.
    let (mine, all) = (&found["keyframes"], &expected["keyframes"]);
    let keyframes = |value: &Value| value.as_u64().unwrap();
    assert!(keyframes(mine) + 2 >= keyframes(all) && keyframes(mine) > 0, "{mine} of {all}");
    assert!(found["points"].as_u64().unwrap() * 2 > expected["points"].as_u64().unwrap());
    ended
}

#[test]
fn a_run_with_a_killed_supervisor_is_recovered() {
    let rig = Rig::new();
    let output = rig.output();
    let arguments = ["run", "--source", ENDLESS, "--output", output.to_str().unwrap()];
    let journal = kill(command(&rig, &arguments).spawn().unwrap(), &output);
    let other = rig.folder().join("other");
    let where_from = [
        vec!["status", "--once"],
        vec!["replay", "sim", "--frames", "8", "--output", other.to_str().unwrap()],
        vec!["run", "--source", "loop:8:30:sim", "--output", other.to_str().unwrap()],
    ];
    until("the end of its processes", || {
        let left = rig.leftovers();
        left.iter().all(|name| name.ends_with(".journal")).then_some(())
    });
    for arguments in where_from {
        let said = finish(command(&rig, &arguments)).stderr;
        let line = said.lines().find(|line| line.contains("semidense recover"));
        let line = line.unwrap_or_else(|| panic!("{arguments:?} says nothing of it: {said}"));
        assert!(line.contains(journal.file_name().unwrap().to_str().unwrap()), "{line}");
    }
    assert!(journal.exists());
    assert_recovered(&rig, &output);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
    let again = finish(rig.command(&["recover", output.to_str().unwrap()]));
    assert_eq!(again.status.code(), Some(1), "{}", again.stderr);
    assert!(again.stderr.contains("holds no journal"), "{}", again.stderr);
}

#[test]
fn a_killed_replay_is_recovered() {
    let rig = Rig::new();
    let output = rig.output();
    let arguments = ["replay", ENDLESS, "--output", output.to_str().unwrap()];
    let journal = kill(command(&rig, &arguments).spawn().unwrap(), &output);
    // A run that died during a write.
    let log = fs::File::options().append(true).open(journal.join("log")).unwrap();
    std::io::Write::write_all(&mut &log, &[77; 300]).unwrap();
    // By the name of the journal, which is kept, as often as one likes.
    for _ in 0..2 {
        let kept = finish(rig.command(&["recover", journal.to_str().unwrap(), "--keep"]));
        assert!(kept.status.success() && journal.exists(), "{}", kept.stderr);
        assert!(!kept.stderr.contains("semidense recover"), "it is the only one: {}", kept.stderr);
    }
    assert_recovered(&rig, &output);
}

#[test]
fn later_results_are_not_replaced_by_a_recovery() {
    let rig = Rig::new();
    let output = rig.output();
    let arguments = ["replay", ENDLESS, "--output", output.to_str().unwrap()];
    let journal = kill(command(&rig, &arguments).spawn().unwrap(), &output);
    let later = ["replay", "sim", "--frames", "20", "--output", output.to_str().unwrap()];
    assert!(finish(command(&rig, &later)).status.success());
    let before = content(&output);
    let refused = finish(rig.command(&["recover", output.to_str().unwrap()]));
    assert_eq!(refused.status.code(), Some(1), "{}", refused.stderr);
    assert!(refused.stderr.contains("later run"), "{}", refused.stderr);
    assert_eq!(content(&output), before);
    let other = rig.folder().join("other");
    let arguments = ["recover", output.to_str().unwrap(), "--output", other.to_str().unwrap()];
    let recovered = finish(rig.command(&arguments));
    assert!(recovered.status.success() && !journal.exists(), "{}", recovered.stderr);
    assert_set(&other);
    assert_set(&output);
}

#[test]
fn depth_of_a_mapper_that_died_is_in_the_final_map() {
    let rig = Rig::new();
    let output = rig.output();
    let child = rig.run(450, &["--live"]).spawn().unwrap();
    let journal = journal_of(&output, 60);
    until("four keyframes", || {
        let entries = fs::read_dir(&journal).unwrap().flatten();
        let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
        (names.filter(|name| name.starts_with("keyframe-")).count() >= 4).then_some(())
    });
    let hub = rig.observe();
    let mut mapper = until("the mapper", || Peer::open(&hub, &MAPPER_HEALTH).ok());
    let victim = until("its health", || mapper.update().unwrap().map(|health| health.process_id));
    let victim = Pid::from_raw(i32::try_from(victim).unwrap()).unwrap();
    rustix::process::kill_process(victim, Signal::KILL).unwrap();
    drop((mapper, hub));
    let ended = end(child);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert_eq!(summary(&output)["restarts"], 1);
    // timestamp, seven of the pose, scale, id, sequence, epoch, points, state
    let with_depth = lines(&output.join("keyframes.txt")).into_iter().filter(|line| {
        let columns: Vec<&str> = line.split(' ').collect();
        columns[9].parse::<u64>().unwrap() < 1000 && columns[12] != "0"
    });
    let count = with_depth.count();
    assert!(count >= 3, "{count} keyframes of the dead mapper have depth");
}

#[test]
fn a_run_that_tracks_nothing_keeps_the_earlier_results() {
    let rig = Rig::new();
    let output = rig.output();
    let good = ["replay", "sim", "--frames", "20", "--output", output.to_str().unwrap()];
    assert!(finish(command(&rig, &good)).status.success());
    let before = content(&output);
    let bad = ["replay", "sim", "--frames", "2", "--json", "--output", output.to_str().unwrap()];
    let ended = finish(command(&rig, &bad));
    assert_eq!(ended.status.code(), Some(3), "{}", ended.stderr);
    assert!(ended.stderr.contains("earlier results") && ended.stderr.contains("kept"));
    let printed: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(printed["frames_tracked"], 0);
    assert_eq!(content(&output), before);
}

#[test]
fn a_full_disk_leaves_the_earlier_results_and_the_journal() {
    let rig = Rig::new();
    let binary = env!("CARGO_BIN_EXE_semidense");
    let mount = rig.folder().join("disk");
    let settings: Vec<String> =
        small_camera(60).iter().map(|s| format!("--set simulator.{s}")).collect();
    let settings = settings.join(" ");
    // The first run fits; then all but a given number of kB is taken before the second begins.
    let script = format!(
        "{binary} replay sim --frames 20 --output {mount}/out {settings} >/dev/null 2>&1 || exit 98
         cat {mount}/out/* | cksum > {mount}/sum
         # Room for nothing but the journal, for some files, for all but the last.
         for free in 120 400 900 1200; do
             dd if=/dev/zero of={mount}/ballast bs=1024 count=$(($(df -k --output=avail {mount} | tail -n 1) - free)) 2>/dev/null
             {binary} replay sim --frames 40 --output {mount}/out {settings} >/dev/null 2>{mount}/../said
             echo \"code $?\"; grep '^error' {mount}/../said
             [ \"$(cat {mount}/out/* | cksum)\" = \"$(cat {mount}/sum)\" ] && echo same
             ls -A {mount}/out | grep -c '^.semidense-results'
             rm {mount}/ballast
             {binary} recover {mount}/out >/dev/null 2>&1; echo \"recovered $?\"
             ls -A {mount}/out | wc -l
             {binary} replay sim --frames 20 --output {mount}/out {settings} >/dev/null 2>&1 || exit 98
             cat {mount}/out/* | cksum > {mount}/sum
         done",
        mount = mount.display(),
    );
    fs::create_dir(&mount).unwrap();
    let mounting = format!("mount -t tmpfs -o size=8m tmpfs {}", mount.display());
    let Some(ended) = with_mount(&rig, &mounting, &script) else { return };
    assert!(ended.status.success(), "{}{}", ended.stdout, ended.stderr);
    let rounds: Vec<&str> = ended.stdout.split("code ").skip(1).collect();
    assert_eq!(rounds.len(), 4, "{}", ended.stdout);
    for round in rounds {
        let lines: Vec<&str> = round.lines().collect();
        assert_eq!(lines[0], "1", "{round}");
        assert!(lines[1].contains("MB are needed") && lines[1].contains("semidense recover"));
        assert_eq!(lines[2..], ["same", "0", "recovered 0", "7"], "{round}");
    }
}

#[test]
fn every_run_has_its_own_folder_and_the_link_leads_to_the_newest() {
    let rig = Rig::new();
    let here = rig.folder().join("here");
    fs::create_dir(&here).unwrap();
    let start = || {
        let mut command = command(&rig, &["replay", "sim", "--frames", "20"]);
        command.current_dir(&here).spawn().unwrap()
    };
    let both = [start(), start()].map(end);
    for ended in &both {
        assert!(ended.status.success(), "{}", ended.stderr);
        let last = ended.stdout.lines().last().unwrap();
        let folder = last.strip_prefix("results in ").unwrap();
        assert_set(&here.join(folder));
    }
    assert_ne!(both[0].stdout.lines().last(), both[1].stdout.lines().last());
    let latest = fs::read_link(here.join("output/latest")).unwrap();
    let is_latest = |ended: &Ended| ended.stdout.contains(latest.to_str().unwrap());
    assert!(both.iter().any(is_latest), "{latest:?}");
    // A failed start leaves no folder, and a run that tracks nothing does not become the latest.
    let mut failing = command(&rig, &["replay", "tum:/nowhere"]);
    assert_eq!(
        finish({
            failing.current_dir(&here);
            failing
        })
        .status
        .code(),
        Some(1)
    );
    let mut nothing = command(&rig, &["replay", "sim", "--frames", "2"]);
    assert_eq!(
        finish({
            nothing.current_dir(&here);
            nothing
        })
        .status
        .code(),
        Some(3)
    );
    assert_eq!(fs::read_link(here.join("output/latest")).unwrap(), latest);
    assert_eq!(fs::read_dir(here.join("output")).unwrap().count(), 4, "three runs and the link");
}

#[test]
fn a_users_file_is_never_replaced() {
    let rig = Rig::new();
    let output = rig.output();
    fs::create_dir(&output).unwrap();
    let mine = output.join("trajectory.txt");
    fs::write(&mine, "1.0 0 0 0 0 0 0 1\n").unwrap();
    for name in ["run", "replay"] {
        let arguments = [&[name][..], &["--output", output.to_str().unwrap()]].concat();
        let source: &[&str] = if name == "replay" { &["sim"] } else { &[] };
        let refused = finish(command(&rig, &[&arguments, source].concat()));
        assert_eq!(refused.status.code(), Some(1), "{}", refused.stderr);
        assert!(refused.stderr.contains("trajectory.txt was not written by semidense"));
    }
    assert_eq!(content(&output).len(), 1);
    assert_eq!(fs::read_to_string(&mine).unwrap(), "1.0 0 0 0 0 0 0 1\n");
}

#[test]
fn an_interrupted_replay_writes_its_results_so_far() {
    let rig = Rig::new();
    let output = rig.output();
    let arguments = ["replay", ENDLESS, "--output", output.to_str().unwrap()];
    let child = command(&rig, &arguments).spawn().unwrap();
    journal_of(&output, 100);
    signal(&child, Signal::TERM);
    let ended = end(child);
    assert_eq!(ended.status.code(), Some(130), "{}", ended.stderr);
    assert_set(&output);
    assert_eq!(summary(&output)["ended"], "interrupted");
}

#[test]
fn a_second_interrupt_ends_a_replay_at_once_and_its_journal_remains() {
    let rig = Rig::new();
    let output = rig.output();
    // Many pictures: the end takes longer than the test needs for the second signal.
    let arguments = ["replay", ENDLESS, "--debug-images", "--output", output.to_str().unwrap()];
    let child = command(&rig, &arguments).spawn().unwrap();
    let journal = journal_of(&output, 100);
    signal(&child, Signal::INT);
    // Two signals of one kind that are pending at a time are one.
    let status = format!("/proc/{}/status", child.id());
    until("the first signal is taken", || {
        let status = fs::read_to_string(&status).unwrap();
        status.contains("ShdPnd:\t0000000000000000").then_some(())
    });
    signal(&child, Signal::INT);
    let ended = end(child);
    assert_eq!(ended.status.code(), Some(130), "{}", ended.stderr);
    assert!(!output.join("summary.json").exists() && journal.exists(), "{}", ended.stderr);
    let recovered = finish(rig.command(&["recover", output.to_str().unwrap()]));
    assert!(recovered.status.success(), "{}", recovered.stderr);
    assert_set(&output);
}

#[test]
fn a_run_is_recovered_without_its_source() {
    let rig = Rig::new();
    let (output, recording) = (rig.output(), rig.folder().join("recording"));
    let made = ["simulate", "--layout", "tum", "--output", recording.to_str().unwrap()];
    assert!(finish(command(&rig, &made)).status.success());
    let source = format!("loop:200000:30:tum:{}", recording.display());
    let arguments = ["replay", &source, "--output", output.to_str().unwrap()];
    kill(command(&rig, &arguments).spawn().unwrap(), &output);
    fs::rename(&recording, rig.folder().join("elsewhere")).unwrap();
    let ended = finish(rig.command(&["recover", output.to_str().unwrap()]));
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stderr.contains("no comparison with ground truth"), "{}", ended.stderr);
    assert!(summary(&output)["ate_rmse_m"].is_null());
    assert!(summary(&output)["frames_tracked"].as_u64().unwrap() > 400);
}
