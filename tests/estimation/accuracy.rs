//! Accuracy in simulated rooms, whose poses and depth are exact, and on recordings of real cameras if these are on the
//! machine. The full measurement of the default room takes minutes: `cargo test --release --test estimation accuracy
//! -- --ignored --nocapture`.

use crate::figures::{Figure, hold};
use crate::recording::{recording, say};
use crate::support::{Rig, finish};
use serde_json::Value;
use std::path::Path;
use tempfile::TempDir;

/// Limits for the default room: error per length of path, and median relative error of depth.
const MAX_ATE_PER_PATH: f64 = 0.01;
const MAX_DEPTH_ERROR: f64 = 0.05;

/// Replays a source into a separate folder; returns its summary.
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

/// Replays the default room with each seed and checks the medians against the limits.
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
        // All frames except for the second that the start of a map may take.
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
fn a_short_path_through_the_room_is_accurate() {
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

/// Replays a recording with portable arithmetic, which gives the same bits on every machine, and compares its figures
/// with the table.
fn assert_recording_is_as_before(name: &str) {
    let Some(folder) = recording(name) else { return };
    let arguments =
        ["--set", "tracking.alignment.simd=portable", "--threads", "1"].map(str::to_owned);
    let found = replay(&format!("tum:{}", folder.display()), &arguments);
    let mut figures = vec![
        Figure::count("frames_in", number(&found, "frames_in"), 0.0),
        Figure::count("frames_tracked", number(&found, "frames_tracked"), 10.0),
        Figure::count("lost_count", number(&found, "lost_count"), 0.0),
        Figure::new("keyframes", number(&found, "keyframes"), 1.0),
        Figure::new("ate_rmse_m", number(&found, "ate_rmse_m"), 0.0005),
        Figure::new("rpe_translation_m", number(&found, "rpe_translation"), 0.0001),
        Figure::new("rpe_rotation_deg", number(&found, "rpe_rotation_deg"), 0.01),
        Figure::new("window_error_m", number(&found, "window_error_m"), 0.0003),
        Figure::new("nees_median", number(&found, "nees_median"), 0.05),
    ];
    // Short recordings have a single window, and not all have true depth.
    let ratio = found["window_scale_ratio"].as_f64();
    figures.extend(ratio.map(|ratio| Figure::new("scale_drift", ratio - 1.0, 0.01)));
    let error = found["depth_relative_error_median"].as_f64();
    figures.extend(error.map(|error| Figure::new("depth_relative_error_median", error, 0.002)));
    let names = ["depth_within_1_sigma", "depth_within_2_sigma", "depth_within_3_sigma"];
    let shares = found["depth_coverage"].as_array().into_iter().flatten();
    figures.extend(
        names
            .into_iter()
            .zip(shares)
            .map(|(n, share)| Figure::count(n, share.as_f64().unwrap(), 0.05)),
    );
    say(&format!("{name}: {figures:?}"));
    hold(name, &figures);
}

#[test]
fn redkitchen_has_the_pinned_figures() {
    assert_recording_is_as_before("redkitchen");
}

#[test]
fn the_floor_has_the_pinned_figures() {
    assert_recording_is_as_before("fr1-floor");
}

#[test]
fn the_rendered_desk_has_the_pinned_figures() {
    assert_recording_is_as_before("tsukuba");
}

#[test]
fn the_rendered_office_has_the_pinned_figures() {
    assert_recording_is_as_before("icl-office3");
}

/// Every `step`-th frame of a recording, from the first, in a separate folder.
fn thinned(recording: &Path, step: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in ["camera.txt", "groundtruth.txt", "rgb"] {
        std::os::unix::fs::symlink(recording.join(name), folder.path().join(name)).unwrap();
    }
    let list = std::fs::read_to_string(recording.join("rgb.txt")).unwrap();
    let lines = list.lines().filter(|line| !line.starts_with('#')).step_by(step);
    std::fs::write(folder.path().join("rgb.txt"), lines.collect::<Vec<_>>().join("\n")).unwrap();
    folder
}

/// The parallax between these frames exceeds the usual search range for new pixels. Without a longer one each keyframe
/// has less depth than the previous one, and the camera is lost on the way, with an error of 0.03 to 0.2 m.
#[test]
fn frames_far_apart_do_not_starve_the_keyframes_of_depth() {
    /// Twice the worst of seven first frames.
    const MAX_ATE_M: [(usize, f64); 3] = [(2, 0.008), (3, 0.012), (4, 0.031)];
    let Some(desk) = recording("tsukuba") else { return };
    // The relative target of a link would be resolved next to the link.
    let desk = desk.canonicalize().unwrap();
    for (step, max_ate_m) in MAX_ATE_M {
        let folder = thinned(&desk, step);
        let found = replay(&format!("tum:{}", folder.path().display()), &[]);
        let (tracked, frames) = (number(&found, "frames_tracked"), number(&found, "frames_in"));
        let ate = number(&found, "ate_rmse_m");
        say(&format!("one frame in {step}: {tracked} of {frames} tracked, ATE {ate:.4} m"));
        assert_eq!((tracked, number(&found, "lost_count")), (frames, 0.0), "one in {step}");
        assert!(ate < max_ate_m, "one frame in {step}: {ate} m");
    }
}
