//! `semidense evaluate` against figures that the Python package `evo` 1.38.1 gave on the same files
//! (`evo_ape` with `-a -s`, `-a` or neither, `evo_rpe` with `--delta 1 --delta_unit f --all_pairs`).

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

/// Largest difference of two figures of the same meaning.
const TOLERANCE: f64 = 1e-6;

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/trajectories")
}

fn evaluate(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_semidense"))
        .arg("evaluate")
        .args(arguments)
        .output()
        .expect("the binary starts")
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn figures_are_those_of_evo() {
    let text = std::fs::read_to_string(fixtures().join("figures.json")).unwrap();
    let figures: Value = serde_json::from_str(&text).unwrap();
    let cases = figures["cases"].as_array().unwrap();
    assert!(cases.len() >= 21);
    for case in cases {
        let path = |key: &str| fixtures().join(case[key].as_str().unwrap()).display().to_string();
        let output = evaluate(&[
            &path("estimate"),
            &path("truth"),
            "--align",
            case["align"].as_str().unwrap(),
            "--max-difference",
            &case["max_difference_secs"].to_string(),
            "--json",
        ]);
        let ours: Value = serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)));
        let name = format!("{} against {}, {}", case["estimate"], case["truth"], case["align"]);
        assert_eq!(ours["matched_poses"], case["matched_poses"], "{name}");
        for (key, expected) in [
            ("ate_rmse_m", &case["ate"]["rmse"]),
            ("ate_mean_m", &case["ate"]["mean"]),
            ("ate_median_m", &case["ate"]["median"]),
            ("ate_max_m", &case["ate"]["max"]),
            ("ate_scale", &case["ate_scale"]),
            ("rpe_translation", &case["rpe_translation"]["rmse"]),
            ("rpe_rotation_deg", &case["rpe_rotation_deg"]["rmse"]),
        ] {
            let (ours, expected) = (number(&ours[key]), number(expected));
            let difference = (ours - expected).abs();
            assert!(difference < TOLERANCE, "{name}: {key} is {ours}, evo has {expected}");
        }
    }
}

#[test]
fn hostile_files_are_refused_in_one_line_that_names_the_place() {
    let folder = tempfile::tempdir().unwrap();
    let truth = fixtures().join("truth_100hz.txt").display().to_string();
    let pose = "0 0 0 0 0 0 1\n";
    for (content, parts) in [
        (String::new(), &["has no poses"][..]),
        (format!("1 {pose}1.1 0 0\n"), &[":2:", "3 columns"]),
        (format!("1 {pose}0.5 {pose}"), &[":2:", "earlier"]),
        (format!("x {pose}"), &[":1:", "timestamp"]),
        ("1 nan 0 0 0 0 0 1\n".to_owned(), &[":1:", "finite"]),
        ("1 0 0 0 0 0 0 0\n".to_owned(), &[":1:", "quaternion"]),
        (format!("1 {pose}2 {pose}3 {pose}"), &["0 of 3 poses", "clock"]),
        (format!("1305033528 {pose}1305033529 {pose}1305033530 {pose}"), &["stands still"]),
    ] {
        let path = folder.path().join("estimate.txt");
        std::fs::write(&path, &content).unwrap();
        let output = evaluate(&[&path.display().to_string(), &truth]);
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success(), "{content:?} is accepted");
        assert_eq!(message.trim_end().lines().count(), 1, "{message}");
        assert!(message.contains("estimate.txt"), "{message}");
        assert!(parts.iter().all(|part| message.contains(part)), "{parts:?}: {message}");
    }
    let missing = folder.path().join("missing.txt").display().to_string();
    assert!(!evaluate(&[&missing, &truth]).status.success());
    assert!(!evaluate(&[&truth, &truth, "--max-difference", "-1"]).status.success());
    assert!(!evaluate(&[&truth, &truth, "--max-difference", "nan"]).status.success());
}

#[test]
fn the_plot_is_a_whole_picture() {
    let folder = tempfile::tempdir().unwrap();
    let plot = folder.path().join("plot.svg");
    let path = |name: &str| fixtures().join(name).display().to_string();
    let output = evaluate(&[
        &path("drift_200hz.txt"),
        &path("truth_20hz.txt"),
        "--plot",
        &plot.display().to_string(),
    ]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let svg = std::fs::read_to_string(&plot).unwrap();
    assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
    assert_eq!(svg.matches("<svg").count(), svg.matches("</svg>").count());
    assert!(svg.contains("Position error") && !svg.contains("NaN"));
}
