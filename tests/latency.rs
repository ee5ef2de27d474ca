//! `semidense bench`: its reports are complete; the measurements are for people, not for a test.

#[allow(dead_code, reason = "every test uses its part of what they share")]
mod support;

use serde_json::Value;
use support::{Rig, finish, small_camera};

/// 1 000 frames.
const TRIAL: [&str; 6] = ["--fps", "60", "--seconds", "16.667", "--realtime", "on"];
/// An instance name of the user's: the processes of the benchmark have a different one.
const NAMED: [&str; 2] = ["--instance", "named"];
const FRAMES: u64 = 1000;

/// The measurements of trials with a small camera.
fn bench(arguments: &[&str]) -> Vec<Value> {
    let rig = Rig::new();
    let mut command = rig.command(&["bench", "latency", "--json"]);
    command.args(arguments);
    for setting in small_camera(40) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
    serde_json::from_str(&ended.stdout).unwrap()
}

fn assert_complete(measurement: &Value, frames: u64) {
    assert_eq!(measurement["frames"], frames, "{measurement}");
    let count =
        |key: &str| measurement[key].as_u64().unwrap_or_else(|| panic!("{key}: {measurement}"));
    assert_eq!(count("poses") + count("dropped"), frames, "every frame is accounted for");
    assert!(count("tracked") <= count("poses") && count("deadline_misses") <= count("poses"));
    let _ = count("page_faults");
    for times in ["latency_ms", "wake_ms", "track_ms"] {
        let at = |share: &str| measurement[times][share].as_f64().unwrap();
        assert!(0.0 <= at("p50") && at("p50") <= at("p99"), "{times}: {measurement}");
        assert!(at("p99") <= at("p999") && at("p999") <= at("max"), "{times}: {measurement}");
    }
    assert!(measurement["deadline_ms"].as_f64().unwrap() > 0.0);
    assert!(measurement["stolen_ms"].is_number(), "{measurement}");
}

#[test]
fn a_thousand_frames_with_every_cpu_busy_give_a_complete_report() {
    let measurements = bench(&[&TRIAL[..], &NAMED, &["--load", "busy-cpus"]].concat());
    assert_eq!(measurements.len(), 1);
    assert_eq!(measurements[0]["disturbance"], "busy_cpus");
    assert_eq!(measurements[0]["real_time"], true);
    assert_complete(&measurements[0], FRAMES);
}

#[test]
fn every_disturbance_is_tried_with_and_without_real_time() {
    let measurements =
        bench(&["--fps", "30", "--seconds", "1", "--load", "all", "--realtime", "both"]);
    assert_eq!(measurements.len(), 10);
    measurements.iter().for_each(|measurement| assert_complete(measurement, 30));
}

#[test]
fn a_trial_without_frames_is_refused() {
    let rig = Rig::new();
    let ended = finish(rig.command(&["bench", "latency", "--seconds", "0"]));
    assert_eq!(ended.status.code(), Some(1));
    assert!(ended.stderr.contains("is 0 frames; choose 1 to"), "{}", ended.stderr);
}

#[test]
fn a_soak_reports_every_trend_and_its_samples() {
    let rig = Rig::new();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("soak.csv");
    let mut command = rig.command(&["bench", "soak", "--json", "--source", "sim"]);
    command.args(["--frames", "300", "--every", "1", "--csv"]).arg(&path);
    for setting in small_camera(40) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
    let trends: Vec<Value> = serde_json::from_str(&ended.stdout).unwrap();
    let names: Vec<&str> = trends.iter().map(|trend| trend["name"].as_str().unwrap()).collect();
    assert!(["keyframes", "track_p99_ms", "mapper_mb"].iter().all(|name| names.contains(name)));
    let memory = trends.iter().find(|trend| trend["name"] == "mapper_mb").unwrap();
    assert!(memory["last_quarter"].as_f64().unwrap() > 1.0, "{memory}");
    let text = std::fs::read_to_string(path).unwrap();
    let frames = |line: &str| line.split(',').nth(1).unwrap().parse::<u64>().unwrap();
    let frames: Vec<u64> = text.lines().skip(1).map(frames).collect();
    assert!(frames.len() >= 4 && frames.is_sorted(), "{text}");
    assert!(*frames.last().unwrap() > 100, "{text}");
}
