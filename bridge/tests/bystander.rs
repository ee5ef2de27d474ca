//! A stopped or killed bridge does not affect the run that it reads: no result changes, and no frame waits for it.
#![cfg(feature = "zenoh")]

mod support;

use std::fs;
use std::path::Path;
use std::process::Command;

use support::machines::{Root, Running, bridge};
use support::semidense;

/// What happens to the bridge once it has joined the run.
#[derive(Clone, Copy, PartialEq)]
enum Fate {
    Absent,
    Stopped,
    Killed,
}

/// Frames rendered while the bridge joins.
const RENDERED: usize = 1500;

/// A run on a small simulated camera alongside a bridge; returns what it wrote to `output`.
fn run(mode: &str, frames: usize, fate: Fate, read: impl Fn(&Path) -> String) -> String {
    let root = Root::new("bystander");
    let output = root.path().join("output");
    let bystander = (fate != Fate::Absent).then(|| {
        let mut command = Command::new(bridge());
        command.args(["--log", "info", "--instance", "bystander", "zenoh", "send", "--frames"]);
        // Any free port: nothing connects.
        command.args(["--listen", "tcp/127.0.0.1:0"]);
        Running::start(command, root.path())
    });
    let mut command = Command::new(semidense());
    command.args(["run", mode, "--instance", "bystander", "--output"]).arg(&output);
    command.args(["--source", &format!("loop:{frames}:30:sim")]);
    for setting in ["width=160", "height=120", "focal_px=131.0", &format!("frames={RENDERED}")] {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    // A debug build is slow, but not hung.
    command.args(["--set", "supervisor.watchdog_s=100.0"]);
    if let Some(bystander) = &bystander {
        bystander.wait_for("sending instance");
    }
    let mut pipeline = Running::start(command, root.path());
    if let Some(bystander) = &bystander {
        bystander.wait_for("joined the instance");
        bystander.signal(if fate == Fate::Stopped { "STOP" } else { "KILL" });
    }
    assert!(pipeline.end(), "{}", pipeline.said());
    read(&output)
}

#[test]
fn a_stopped_and_a_killed_bridge_change_no_result_of_a_lockstep_run() {
    const FRAMES: usize = 40;
    let trajectories = |output: &Path| {
        let text = |name| fs::read_to_string(output.join(name)).unwrap();
        text("trajectory.txt") + &text("trajectory_online.txt")
    };
    let alone = run("--lockstep", FRAMES, Fate::Absent, trajectories);
    assert!(alone.lines().count() > FRAMES, "it tracks");
    for fate in [Fate::Stopped, Fate::Killed] {
        assert!(run("--lockstep", FRAMES, fate, trajectories) == alone, "another trajectory");
    }
}

#[test]
fn a_live_run_alongside_a_stopped_and_a_killed_bridge() {
    const FRAMES: usize = 150;
    let counts = |output: &Path| {
        let text = fs::read_to_string(output.join("summary.json")).unwrap();
        let keys = ["\"frames_in\"", "\"frames_dropped\"", "\"deadline_misses\""];
        let lines = text.lines().filter(|line| keys.iter().any(|key| line.contains(key)));
        lines.map(str::trim).collect::<Vec<_>>().join(" ")
    };
    for (fate, name) in
        [(Fate::Absent, "no"), (Fate::Stopped, "a stopped"), (Fate::Killed, "a killed")]
    {
        let counted = run("--live", FRAMES, fate, counts);
        eprintln!("live beside {name} bridge: {counted}");
        assert!(counted.contains(&format!("\"frames_in\": {FRAMES}")), "{counted}");
    }
}
