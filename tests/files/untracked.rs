//! A run that tracks nothing ends with a dedicated exit code and the right cause.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::support::{Rig, finish, small_camera};
use serde_json::Value;

const WIDTH: usize = 160;
const HEIGHT: usize = 120;
const FOCAL_PX: f64 = 150.0;
const FRAMES: usize = 20;
/// Exit code of a run that tracked nothing.
const NOTHING_TRACKED: i32 = 3;

/// Grey values of a random pattern of soft blobs, the same for equal seeds.
fn pattern(seed: u64, u: f64, v: f64) -> u8 {
    let value = |x: i64, y: i64| {
        let mut z = (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
            ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f64 / (1u64 << 24) as f64
    };
    // Bilinear between the nodes of a grid of six pixels.
    let (x, y) = (u / 6.0, v / 6.0);
    let (i, j) = (x.floor() as i64, y.floor() as i64);
    let (a, b) = (x - x.floor(), y - y.floor());
    let top = value(i, j) * (1.0 - a) + value(i + 1, j) * a;
    let bottom = value(i, j + 1) * (1.0 - a) + value(i + 1, j + 1) * a;
    (30.0 + 190.0 * (top * (1.0 - b) + bottom * b)) as u8
}

/// A distant pattern, seen by a camera that rotates about its vertical axis, two pixels per frame.
fn turned(frame: usize, u: usize, v: usize) -> u8 {
    let (x, y) = ((u as f64 - 79.5) / FOCAL_PX, (v as f64 - 59.5) / FOCAL_PX);
    let (sin, cos) = (2.0 * frame as f64 / FOCAL_PX).sin_cos();
    let depth = cos - x * sin;
    pattern(1, FOCAL_PX * (x * cos + sin) / depth, FOCAL_PX * y / depth)
}

/// Black and white, with nothing in common between frames.
fn flicker(frame: usize, u: usize, v: usize) -> u8 {
    if pattern(frame as u64, u as f64, v as f64) > 125 { 250 } else { 5 }
}

/// Writes a recording in TUM layout whose pixels are those of `pixel(frame, u, v)`.
fn record(folder: &Path, frames: usize, pixel: impl Fn(usize, usize, usize) -> u8) -> String {
    record_sized(folder, frames, [WIDTH, HEIGHT], pixel)
}

fn record_sized(
    folder: &Path,
    frames: usize,
    [width, height]: [usize; 2],
    pixel: impl Fn(usize, usize, usize) -> u8,
) -> String {
    fs::create_dir_all(folder.join("rgb")).unwrap();
    let [cx, cy] = [width, height].map(|pixels| pixels as f64 / 2.0 - 0.5);
    let camera = format!("{FOCAL_PX} {FOCAL_PX} {cx} {cy} {width} {height}\n");
    fs::write(folder.join("camera.txt"), camera).unwrap();
    let mut list = String::new();
    for frame in 0..frames {
        let pixels: Vec<u8> =
            (0..width * height).map(|i| pixel(frame, i % width, i / width)).collect();
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
        fs::write(folder.join(format!("rgb/{frame:03}.png")), bytes).unwrap();
        list += &format!("{:.3} rgb/{frame:03}.png\n", 1.0 + frame as f64 / 30.0);
    }
    fs::write(folder.join("rgb.txt"), list).unwrap();
    format!("tum:{}", folder.display())
}

/// Checks that a run ends with exit code 3 and a cause, on standard error and in the summary.
fn assert_untracked(mut command: Command, output: &Path, cause: &str) {
    let ended = finish({
        command.args(["--json", "--output"]).arg(output);
        command
    });
    assert_eq!(ended.status.code(), Some(NOTHING_TRACKED), "{cause}: {}", ended.stderr);
    let line = ended.stderr.lines().find(|line| line.starts_with("nothing was tracked"));
    assert!(line.is_some_and(|line| line.contains(cause)), "{cause}: {}", ended.stderr);
    let summary: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert!(summary["untracked"].as_str().unwrap().contains(cause), "{summary}");
    let report = fs::read_to_string(output.join("report.html")).unwrap();
    assert!(report.contains("Nothing was tracked"));
}

#[test]
fn the_defect_of_the_images_is_reported() {
    let rig = Rig::new();
    type Pixel = fn(usize, usize, usize) -> u8;
    let cases: [(&str, Pixel, &str); 6] = [
        ("dark", |_, u, v| ((u + v) % 3) as u8, "dark"),
        ("bright", |_, _, _| 255, "overexposed"),
        ("wall", |_, _, _| 128, "too little texture"),
        ("still", |frame, u, v| pattern(1, u as f64, v as f64) ^ (frame % 2) as u8, "stood still"),
        ("turned", turned, "only turned"),
        ("flicker", flicker, "differ too much"),
    ];
    for (name, pixel, cause) in cases {
        let source = record(&rig.folder().join(name), FRAMES, pixel);
        let output = rig.folder().join(format!("{name}-replay"));
        assert_untracked(rig.command(&["replay", &source]), &output, cause);
        let output = rig.folder().join(format!("{name}-run"));
        assert_untracked(rig.command(&["run", "--source", &source]), &output, cause);
    }
    let source = record(&rig.folder().join("few"), 3, turned);
    let output = rig.folder().join("few-replay");
    assert_untracked(rig.command(&["replay", &source]), &output, "3 frames are too few");
}

#[test]
fn the_folder_of_the_results_is_printed_once() {
    let rig = Rig::new();
    let source = record(&rig.folder().join("few"), 3, turned);
    let output = rig.output();
    for (json, on_stdout) in [(false, true), (true, false)] {
        let ended = finish({
            let mut command = rig.command(&["replay", &source, "--output"]);
            command.arg(&output).args(json.then_some("--json"));
            command
        });
        assert_eq!(ended.status.code(), Some(NOTHING_TRACKED), "{}", ended.stderr);
        assert_eq!(ended.stdout.contains("results in "), on_stdout, "{}", ended.stdout);
        assert_eq!(ended.stderr.contains("results in "), !on_stdout, "{}", ended.stderr);
    }
}

#[test]
fn a_machine_that_is_too_slow_is_reported() {
    let rig = Rig::new();
    // Frames have nothing in common, so that nothing is tracked on any machine; and no machine processes a thousand
    // frames of this size per second.
    let size = [640, 480];
    let source = record_sized(&rig.folder().join("flicker"), FRAMES, size, flicker);
    let command = rig.command(&["run", "--live", "--source", &format!("loop:200:1000:{source}")]);
    assert_untracked(command, &rig.output(), "the machine is too slow");
}

#[test]
fn a_closed_pipe_does_not_hide_that_nothing_was_tracked() {
    let rig = Rig::new();
    let mut command = rig.command(&["replay", "sim", "--frames", "3", "--output"]);
    command.arg(rig.output());
    for setting in small_camera(3) {
        command.args(["--set", &format!("simulator.{setting}")]);
    }
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let status = command.stdout(writer).stderr(std::process::Stdio::null()).status().unwrap();
    assert_eq!(status.code(), Some(NOTHING_TRACKED));
}
