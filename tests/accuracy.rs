//! Accuracy on simulated rooms, whose poses and depth are exact, and on recordings of real cameras
//! where these are on the machine. The full measurement of the default room takes minutes:
//! `cargo test --release --test accuracy -- --ignored --nocapture`.

#[allow(dead_code, reason = "every test uses its part of what they share")]
mod support;

use std::io::Write;
use std::path::PathBuf;

use serde_json::Value;
use support::{Rig, finish};

/// Limits of the default room: error of the path, and median relative error of depth.
const MAX_ATE_PER_PATH: f64 = 0.01;
const MAX_DEPTH_ERROR: f64 = 0.05;

/// `replay` of a source into the folder of its own, its summary.
fn replay(source: &str, arguments: &[String]) -> Value {
    let rig = Rig::new();
    let mut command = rig.command(&["replay", source, "--json", "--output"]);
    command.arg(rig.output()).args(arguments);
    let ended = finish(command);
    assert!(ended.status.success(), "{source}: {}", ended.stderr);
    serde_json::from_str(&ended.stdout).unwrap()
}

fn number(figures: &Value, key: &str) -> f64 {
    figures[key].as_f64().unwrap_or_else(|| panic!("{key} is missing: {figures}"))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Says it even of a test that passes: the runner swallows `println!`.
fn say(line: &str) {
    // A closed standard error must not fail a test.
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Replays the default room with each seed and holds the medians to the limits.
fn assert_room_is_accurate(seeds: std::ops::RangeInclusive<u64>, settings: &[&str]) {
    let (mut ates, mut depths) = (Vec::new(), Vec::new());
    for seed in seeds {
        let mut arguments = vec!["--seed".to_owned(), seed.to_string()];
        arguments.extend(settings.iter().flat_map(|s| ["--set".to_owned(), s.to_string()]));
        let figures = replay("sim", &arguments);
        let ate = number(&figures, "ate_rmse_m") / number(&figures, "path_length_m");
        let depth = number(&figures, "depth_relative_error_median");
        say(&format!(
            "room, seed {seed}: ATE {:.3} % of {:.2} m, median depth error {:.2} %, {} of {} frames",
            100.0 * ate,
            number(&figures, "path_length_m"),
            100.0 * depth,
            figures["frames_tracked"],
            figures["frames_in"]
        ));
        assert_eq!(figures["lost_count"], 0, "seed {seed}: {figures}");
        // All but the second that it may take to begin a map.
        let missed = number(&figures, "frames_in") - number(&figures, "frames_tracked");
        assert!(missed <= 30.0, "seed {seed}: {missed} frames without a pose");
        ates.push(ate);
        depths.push(depth);
    }
    let (ate, depth) = (median(ates), median(depths));
    assert!(ate <= MAX_ATE_PER_PATH, "median ATE {ate} of the path");
    assert!(depth <= MAX_DEPTH_ERROR, "median relative depth error {depth}");
}

#[test]
fn a_short_way_through_the_room_is_accurate() {
    let half_size = [
        "simulator.frames=150",
        "simulator.width=320",
        "simulator.height=240",
        "simulator.focal_px=262.5",
    ];
    assert_room_is_accurate(1..=3, &half_size);
}

#[test]
#[ignore = "minutes of rendering; the short way through the same room is always tested"]
fn the_default_room_is_accurate() {
    assert_room_is_accurate(1..=5, &[]);
}

/// A recording of a real (or, for two, a rendered) camera and what is asked of it: to the end,
/// with bounds that a broken tracker or map misses and the weather of another machine does not.
struct Recording {
    name: &'static str,
    frames: u64,
    min_tracked: u64,
    max_losses: u64,
    max_ate_m: f64,
}

/// Frames by the list of each. The way through redkitchen turns fast, blurs and changes its
/// exposure; its scale drifts, so its bound is wide.
const RECORDINGS: [Recording; 4] = [
    Recording { name: "fr1-floor", frames: 90, min_tracked: 70, max_losses: 0, max_ate_m: 0.03 },
    Recording { name: "tsukuba", frames: 150, min_tracked: 110, max_losses: 1, max_ate_m: 0.15 },
    Recording { name: "icl-office3", frames: 75, min_tracked: 25, max_losses: 1, max_ate_m: 0.02 },
    Recording { name: "redkitchen", frames: 500, min_tracked: 150, max_losses: 20, max_ate_m: 0.5 },
];

#[test]
fn recordings_run_to_their_end() {
    let root = std::env::var_os("SEMIDENSE_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    for recording in RECORDINGS {
        let folder = root.join(recording.name);
        if !folder.is_dir() {
            say(&format!("skipped: {} is not there (SEMIDENSE_DATA)", folder.display()));
            continue;
        }
        let figures = replay(&format!("tum:{}", folder.display()), &[]);
        let ate = number(&figures, "ate_rmse_m");
        let tracked = figures["frames_tracked"].as_u64().unwrap();
        let losses = figures["lost_count"].as_u64().unwrap();
        say(&format!("{}: ATE {ate:.4} m over {tracked} frames, {losses} lost", recording.name));
        assert_eq!(figures["frames_in"], recording.frames, "{}", recording.name);
        assert!(tracked >= recording.min_tracked, "{}: {tracked} frames", recording.name);
        assert!(losses <= recording.max_losses, "{}: {losses} losses", recording.name);
        assert!(ate <= recording.max_ate_m, "{}: ATE {ate} m", recording.name);
    }
}
