//! `semidense evaluate` compared with the figures of the Python package `evo` 1.38.1 for the same files (`evo_ape`
//! with `-a -s`, `-a` or neither, `evo_rpe` with `--delta 1 --delta_unit f --all_pairs`).

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use nalgebra::Vector6;
use semidense::slam::geometry::se3::SE3;
use serde_json::Value;

/// Largest difference of two equivalent figures.
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
fn figures_equal_those_of_evo() {
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

/// Ground truth in EuRoC layout for a body that carries the camera of `world_from_cameras`.
fn write_euroc(folder: &Path, body_from_camera: &SE3, world_from_cameras: &[(i64, SE3)]) {
    let poses = folder.join("mav0/state_groundtruth_estimate0");
    std::fs::create_dir_all(&poses).unwrap();
    std::fs::create_dir_all(folder.join("mav0/cam0")).unwrap();
    let mut lines = String::from("#timestamp, p, q\n");
    for (nanos, world_from_camera) in world_from_cameras {
        let body = *world_from_camera * body_from_camera.inverse();
        let (t, [x, y, z, w]) = (body.translation, body.quaternion_xyzw());
        lines += &format!("{nanos},{},{},{},{w},{x},{y},{z}\n", t.x, t.y, t.z);
    }
    std::fs::write(poses.join("data.csv"), lines).unwrap();
    let (r, t) = (body_from_camera.rotation_matrix(), body_from_camera.translation);
    let row = |i: usize| format!("{}, {}, {}, {},", r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]);
    let sensor = format!(
        "T_BS:\n  data: [{} {} {} 0.0, 0.0, 0.0, 1.0]\nresolution: [752, 480]\ncamera_model: pinhole\n\
         intrinsics: [458.654, 457.296, 367.215, 248.375]\ndistortion_model: none\n\
         distortion_coefficients: []\n",
        row(0),
        row(1),
        row(2)
    );
    std::fs::write(folder.join("mav0/cam0/sensor.yaml"), sensor).unwrap();
}

#[test]
fn ground_truth_of_a_body_is_moved_to_its_camera() {
    let path = |i: i64| {
        let s = i as f64 / 20.0;
        let pose = SE3::exp(&Vector6::new(s, (2.0 * s).sin(), 0.0, 0.2 * s, 0.7 * s.cos(), s));
        (1_000_000_000 + i * 50_000_000, pose)
    };
    let cameras: Vec<_> = (0..60).map(path).collect();
    // The camera as mounted on EuRoC's helicopter: rotated by slightly more than a right angle.
    let turned = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.02, -0.01, 1.556));
    let aside = SE3::exp(&Vector6::new(-0.1, 0.3, 0.05, 0.02, -0.01, 1.556));
    for body_from_camera in [turned, aside] {
        let folder = tempfile::tempdir().unwrap();
        write_euroc(folder.path(), &body_from_camera, &cameras);
        let estimate = folder.path().join("estimate.txt");
        let line = |(nanos, pose): &(i64, SE3)| {
            let (t, [x, y, z, w]) = (pose.translation, pose.quaternion_xyzw());
            format!("{} {} {} {} {x} {y} {z} {w}\n", *nanos as f64 * 1e-9, t.x, t.y, t.z)
        };
        std::fs::write(&estimate, cameras.iter().map(line).collect::<String>()).unwrap();
        let estimate = estimate.display().to_string();
        let figures = |truth: &Path, more: &[&str]| -> (Value, String) {
            let truth = truth.display().to_string();
            let output = evaluate(&[&[&estimate, &truth, "--json"], more].concat());
            let said = String::from_utf8(output.stderr).unwrap();
            (serde_json::from_slice(&output.stdout).expect(&said), said)
        };
        let beside = folder.path().join("mav0/state_groundtruth_estimate0/data.csv");
        let alone = folder.path().join("alone.csv");
        std::fs::copy(&beside, &alone).unwrap();
        let sensor = folder.path().join("mav0/cam0/sensor.yaml").display().to_string();
        let (by_body, warning) = figures(&alone, &[]);
        assert!(warning.contains("--sensor") && warning.lines().count() == 1, "{warning}");
        for (figures, said) in [figures(&beside, &[]), figures(&alone, &["--sensor", &sensor])] {
            assert!(said.contains("moved to the camera"), "{said}");
            for key in ["ate_rmse_m", "rpe_translation", "rpe_rotation_deg"] {
                assert!(
                    number(&figures[key]) < TOLERANCE,
                    "{key} of a perfect estimate: {figures}"
                );
            }
        }
        // The same truth in TUM layout: `--sensor` declares it to be the body's.
        let tum = folder.path().join("truth.txt");
        let text = std::fs::read_to_string(&alone).unwrap();
        let as_tum = |line: &str| {
            let columns: Vec<&str> = line.split(',').map(str::trim).collect();
            let secs = columns[0].parse::<f64>().unwrap() * 1e-9;
            let [x, y, z, qw, qx, qy, qz] = columns[1..8] else { panic!("{line}") };
            format!("{secs} {x} {y} {z} {qx} {qy} {qz} {qw}\n")
        };
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        std::fs::write(&tum, lines.map(as_tum).collect::<String>()).unwrap();
        let (moved, _) = figures(&tum, &["--sensor", &sensor]);
        assert!(number(&moved["rpe_translation"]) < TOLERANCE, "{moved}");

        // An estimate of the body's poses has the same figures as the camera's.
        let bend = |(i, (nanos, pose)): (usize, &(i64, SE3))| {
            let off = (i as f64).sin() * 0.01;
            (*nanos, *pose * SE3::exp(&Vector6::new(off, 0.0, -off, off, 0.0, 2.0 * off)))
        };
        let bent: Vec<(i64, SE3)> = cameras.iter().enumerate().map(bend).collect();
        let other = tempfile::tempdir().unwrap();
        write_euroc(other.path(), &body_from_camera, &bent);
        let by_camera = other.path().join("camera.txt");
        std::fs::write(&by_camera, bent.iter().map(line).collect::<String>()).unwrap();
        let of = |estimate: &Path| -> Value {
            let [estimate, truth] = [estimate, &beside].map(|path| path.display().to_string());
            serde_json::from_slice(&evaluate(&[&estimate, &truth, "--json"]).stdout).unwrap()
        };
        let body = of(&other.path().join("mav0/state_groundtruth_estimate0/data.csv"));
        for key in ["ate_rmse_m", "rpe_translation", "rpe_rotation_deg"] {
            let off = number(&body[key]) - number(&of(&by_camera)[key]);
            assert!(off.abs() < TOLERANCE, "{key} of the body's poses: {body}");
            assert!(number(&body[key]) > 1e-3, "{key}: {body}");
        }
        // Positions agree if camera and body coincide; relative motions never do.
        let is_aside = body_from_camera.translation.norm() > 0.0;
        assert_eq!(number(&by_body["ate_rmse_m"]) > 1e-3, is_aside, "{by_body}");
        assert!(number(&by_body["rpe_translation"]) > 1e-3, "{by_body}");
    }
}

/// Lines of a trajectory file: every pose of `poses` in another coordinate frame, at another scale.
fn tum_lines(poses: &[(i64, SE3)], other_from_world: &SE3, scale: f64) -> String {
    let line = |(nanos, pose): &(i64, SE3)| {
        let other = *other_from_world * *pose;
        let (t, [x, y, z, w]) = (other.translation * scale, other.quaternion_xyzw());
        format!("{} {} {} {} {x} {y} {z} {w}\n", *nanos as f64 * 1e-9, t.x, t.y, t.z)
    };
    poses.iter().map(line).collect()
}

/// An estimate with three epochs, the last of two poses, and its ground truth.
fn write_epochs(folder: &Path) -> [String; 2] {
    let path = |i: i64| {
        let s = i as f64 / 20.0;
        let off = if i % 2 == 0 { 0.002 } else { 0.0 };
        let pose =
            |off: f64| SE3::exp(&Vector6::new(s + off, (2.0 * s).sin(), 0.0, 0.2 * s, s, 0.1));
        let nanos = 1_000_000_000 + i * 50_000_000;
        ((nanos, pose(0.0)), (nanos, pose(off)))
    };
    let (truth, estimate): (Vec<_>, Vec<_>) = (0..120).map(path).unzip();
    let frame = |turn: f64| SE3::exp(&Vector6::new(turn, 2.0, -1.0, 0.3, turn, 0.1));
    let text = format!(
        "# c\n# epoch 0: x\n{}# epoch 1: x\n{}# epoch 0: x\n{}# epoch 2: x\n{}",
        tum_lines(&estimate[..40], &frame(0.5), 0.5),
        tum_lines(&estimate[45..85], &frame(2.0), 4.0),
        tum_lines(&estimate[90..110], &frame(0.5), 0.5),
        tum_lines(&estimate[115..117], &frame(1.0), 1.0)
    );
    [("estimate.txt", text), ("truth.txt", tum_lines(&truth, &SE3::identity(), 1.0))].map(
        |(name, text)| {
            std::fs::write(folder.join(name), text).unwrap();
            folder.join(name).display().to_string()
        },
    )
}

#[test]
fn every_marked_epoch_is_evaluated_separately() {
    let folder = tempfile::tempdir().unwrap();
    let [estimate, truth] = write_epochs(folder.path());
    let json = |estimate: &str| -> Value {
        let output = evaluate(&[estimate, &truth, "--json"]);
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)))
    };
    let found = json(&estimate);
    let [first, second, short] = found["epochs"].as_array().unwrap().as_slice() else {
        panic!("{found}")
    };
    for (epoch, (number_of, poses, scale)) in [(first, (0, 60, 2.0)), (second, (1, 40, 0.25))] {
        assert_eq!(
            (&epoch["epoch"], &epoch["poses"], &epoch["matched_poses"], &epoch["left_out"]),
            (&number_of.into(), &poses.into(), &poses.into(), &Value::Null)
        );
        assert!((number(&epoch["ate_scale"]) / scale - 1.0).abs() < 0.01, "{epoch}");
        assert!((1e-4..2e-3).contains(&number(&epoch["ate_rmse_m"])), "{epoch}");
    }
    assert_eq!((&short["epoch"], &short["poses"]), (&2.into(), &2.into()));
    assert!(short["left_out"].as_str().unwrap().contains("2 of 2 poses"), "{short}");
    assert!(short["ate_rmse_m"].is_null() && found["ate_scale"].is_null(), "{found}");
    let of = |epoch: &Value, key: &str| number(&epoch[key]);
    let squares = 60.0 * of(first, "ate_rmse_m").powi(2) + 40.0 * of(second, "ate_rmse_m").powi(2);
    assert!((of(&found, "ate_rmse_m") - (squares / 100.0).sqrt()).abs() < 1e-9, "{found}");
    assert_eq!(found["matched_poses"], 100);
    let path = of(first, "path_length_m") + of(second, "path_length_m");
    assert!((of(&found, "path_length_m") - path).abs() < 1e-9, "{found}");

    let text = String::from_utf8(evaluate(&[&estimate, &truth]).stdout).unwrap();
    for part in ["3 epochs, each with", "epoch 2             2 left out: only 2 of 2 poses"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert!(text.contains("total of 2 epochs, over all matched poses:\n100 of 102"), "{text}");

    // Without marks it is one path, like a file of any other program.
    let all = std::fs::read_to_string(&estimate).unwrap();
    let unmarked = folder.path().join("unmarked.txt").display().to_string();
    let lines = all.lines().filter(|line| !line.starts_with("# epoch"));
    std::fs::write(&unmarked, lines.map(|line| format!("{line}\n")).collect::<String>()).unwrap();
    let one = json(&unmarked);
    assert!(number(&one["ate_rmse_m"]) > 0.1 && number(&one["ate_scale"]) > 0.0, "{one}");
    assert_eq!(one["epochs"].as_array().unwrap().len(), 1);
    assert_eq!(one["epochs"][0]["ate_rmse_m"], one["ate_rmse_m"]);
    assert!(!String::from_utf8(evaluate(&[&unmarked, &truth]).stdout).unwrap().contains("epoch"));
    // An epoch alone has the same figures as among others.
    let end = all.find("# epoch 0: x\n").unwrap()..all.find("# epoch 1: x\n").unwrap();
    let begin = all.rfind("# epoch 0: x\n").unwrap()..all.find("# epoch 2: x\n").unwrap();
    std::fs::write(&unmarked, all[end].to_owned() + &all[begin]).unwrap();
    assert_eq!(json(&unmarked)["epochs"][0], *first);

    let refused = evaluate(&[&truth, &estimate]);
    let message = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(refused.status.code(), Some(1), "{message}");
    assert!(message.contains("estimate.txt marks 3 epochs"), "{message}");
    let last = &all[all.find("# epoch 2: x\n").unwrap()..];
    let none = format!("{last}# epoch 3: x\n9 0 0 0 0 0 0 1\n");
    std::fs::write(&unmarked, none).unwrap();
    let refused = evaluate(&[&unmarked, &truth]);
    let message = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(refused.status.code(), Some(1), "{message}");
    assert!(
        message.contains("none of 2 epochs can be compared; epoch 2, the longest"),
        "{message}"
    );
}

#[test]
fn malformed_files_are_refused_in_one_line_that_names_the_position() {
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
        (format!("1305033528 {pose}1305033529 {pose}1305033530 {pose}"), &["does not move"]),
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
fn the_plot_is_a_complete_picture() {
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
