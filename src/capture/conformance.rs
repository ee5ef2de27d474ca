//! Tests every source against the contract of [`FrameSource`], and the readers' errors for bad input.

use std::fs;
use std::path::Path;

use crate::capture::image_file::{write_depth_png, write_gray_png};
use crate::capture::opening::{self, SourceParams};
use crate::capture::simulator::params::SimulatorParams;
use crate::capture::source::{FrameSource, FrameStamp};
use crate::capture::source_error::SourceError;
use crate::capture::source_name::SourceName;
use crate::capture::test_bag::{TestBag, camera_info, compressed_image};
use crate::capture::test_images::flat_block_jpeg;

const WIDTH: usize = 32;
const HEIGHT: usize = 24;
const FRAMES: usize = 5;
const PERIOD_NANOS: i64 = 50_000_000;

const RIG: &str =
    "model = \"pinhole\"\nwidth = 32\nheight = 24\nfx = 30\nfy = 31\ncx = 15.5\ncy = 11.5\n";

const SENSOR_YAML: &str = "T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.2,
         0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [32, 24]
camera_model: pinhole
intrinsics: [30.0, 31.0, 15.5, 11.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.02, 0.0, 0.0]
";

/// A grey level that identifies the frame; JPEG and PNG preserve it.
fn level(frame: usize) -> u8 {
    (40 + 20 * frame) as u8
}

/// Writes an image of one level, alternating between PNG and JPEG, always called `.png`.
fn write_image(path: &Path, frame: usize) {
    if frame.is_multiple_of(2) {
        write_gray_png(path, WIDTH, HEIGHT, &[level(frame); WIDTH * HEIGHT]).expect("written");
    } else {
        let jpeg = flat_block_jpeg(WIDTH, HEIGHT, 3, false, |_, _, _| level(frame));
        fs::write(path, jpeg).expect("written");
    }
}

fn write_tum(folder: &Path) {
    fs::create_dir_all(folder.join("rgb")).expect("folder");
    fs::create_dir_all(folder.join("depth")).expect("folder");
    let (mut rgb, mut depth) = ("# timestamp filename\n".to_owned(), String::new());
    let mut truth = "# timestamp tx ty tz qx qy qz qw\n".to_owned();
    for frame in 0..FRAMES {
        write_image(&folder.join(format!("rgb/{frame}.png")), frame);
        rgb += &format!("1000000000.{:02}0000001 rgb/{frame}.png\n", 5 * frame);
        // 15 ms after its frame, and only for every other one.
        if frame % 2 == 0 {
            let steps = vec![5000 * (1 + frame as u16); WIDTH * HEIGHT];
            write_depth_png(&folder.join(format!("depth/{frame}.png")), WIDTH, HEIGHT, &steps)
                .expect("written");
            depth += &format!("1000000000.{:02}5 depth/{frame}.png\n", 5 * frame + 1);
        }
        truth += &format!("1000000000.{:02} {frame} 0 0 0 0 0 1\n", 5 * frame);
    }
    fs::write(folder.join("rgb.txt"), rgb).expect("written");
    fs::write(folder.join("depth.txt"), depth).expect("written");
    fs::write(folder.join("groundtruth.txt"), truth).expect("written");
    fs::write(folder.join("camera.txt"), "30 31 15.5 11.5 32 24 -0.1 0.02 0 0\n").expect("written");
}

fn write_euroc(folder: &Path) {
    let (camera, truth) =
        (folder.join("mav0/cam0"), folder.join("mav0/state_groundtruth_estimate0"));
    fs::create_dir_all(camera.join("data")).expect("folder");
    fs::create_dir_all(&truth).expect("folder");
    let mut frames = "#timestamp [ns],filename\r\n".to_owned();
    let mut poses = "#timestamp, p_RS_R_x [m], and more\n".to_owned();
    for frame in 0..FRAMES {
        let nanos = 1_000_000_000_000_000_001 + PERIOD_NANOS * frame as i64;
        write_image(&camera.join(format!("data/{nanos}.png")), frame);
        frames += &format!("{nanos},{nanos}.png\r\n");
        poses += &format!("{nanos},{frame},0,0,1,0,0,0,0.1,0.2,0.3,0,0,0,0,0,0\n");
    }
    fs::write(camera.join("data.csv"), frames).expect("written");
    fs::write(camera.join("sensor.yaml"), SENSOR_YAML).expect("written");
    fs::write(truth.join("data.csv"), poses).expect("written");
}

fn write_images(folder: &Path) {
    for frame in 0..FRAMES {
        // 8, 9, 10, … so that only natural order is right.
        write_image(&folder.join(format!("frame{}.png", frame + 8)), frame);
    }
    fs::write(folder.join("rig.toml"), format!("{RIG}rate_hz = 20\n")).expect("written");
}

/// The images of [`write_images`] with stamps to the nanosecond.
fn write_mcap(folder: &Path) {
    let mut bag = TestBag::default();
    let images = bag.topic("/cam/image_raw/compressed", "sensor_msgs/msg/CompressedImage");
    let camera = bag.topic("/cam/camera_info", "sensor_msgs/msg/CameraInfo");
    let lens = [-0.1, 0.02, 0.0, 0.0];
    let camera_message = camera_info(32, 24, "plumb_bob", &lens, [30.0, 31.0, 15.5, 11.5], 0);
    for frame in 0..FRAMES {
        let nanos = 1_000_000_000_000_000_001 + PERIOD_NANOS * frame as i64;
        let file = folder.join("image");
        write_image(&file, frame);
        let content = fs::read(&file).expect("written");
        bag.message(camera, nanos, &camera_message);
        bag.message(images, nanos, &compressed_image(nanos, "png", &content));
    }
    fs::write(folder.join("bag.mcap"), bag.finish()).expect("written");
}

fn open(name: &SourceName, rig: Option<&Path>) -> Result<Box<dyn FrameSource>, SourceError> {
    let simulator = SimulatorParams {
        frames: FRAMES,
        rate_hz: 20.0,
        width: WIDTH,
        height: HEIGHT,
        focal_px: 30.0,
        ..SimulatorParams::default()
    };
    opening::open(name, rig, &SourceParams { simulator, ..SourceParams::default() })
}

/// Creates a dataset, lets `spoil` change it and opens it.
fn opened(
    kind: &str,
    spoil: impl FnOnce(&Path),
) -> (tempfile::TempDir, Result<Box<dyn FrameSource>, SourceError>) {
    let folder = tempfile::tempdir().expect("temporary folder");
    let (root, mut rig) = (folder.path(), None);
    match kind {
        "tum" => write_tum(root),
        "euroc" => write_euroc(root),
        "sim" => {}
        "mcap" => write_mcap(root),
        _ => {
            write_images(root);
            rig = Some(root.join("rig.toml"));
        }
    }
    spoil(root);
    let name =
        if kind == "sim" { "sim:room".to_owned() } else { format!("{kind}:{}", root.display()) };
    let name: SourceName = name.parse().expect("a name");
    let source = open(&name, rig.as_deref().filter(|rig| rig.exists()));
    (folder, source)
}

/// Every frame, with its middle pixel.
fn play(source: &mut dyn FrameSource) -> Result<Vec<(FrameStamp, u8)>, SourceError> {
    let k = source.intrinsics();
    let mut pixels = vec![0; k.width * k.height];
    let mut frames = Vec::new();
    while let Some(stamp) = source.next_into(&mut pixels)? {
        frames.push((stamp, pixels[k.width * k.height / 2 + k.width / 2]));
    }
    Ok(frames)
}

#[test]
fn every_source_keeps_the_contract() {
    for kind in ["tum", "euroc", "images", "mcap", "sim"] {
        let (_folder, source) = opened(kind, |_| {});
        let mut source = source.unwrap_or_else(|error| panic!("{kind}: {error}"));
        source.prepare(&mut |_, _| true).expect("prepared");
        let k = source.intrinsics();
        assert!(k.is_valid(), "{kind}");
        assert_eq!((k.width, k.height), (WIDTH, HEIGHT), "{kind}");
        assert_eq!(source.num_frames(), Some(FRAMES), "{kind}");
        let wrong = source.next_into(&mut [0; 7]).expect_err("a short buffer");
        assert!(matches!(wrong, SourceError::Buffer { found: 7, .. }), "{kind}");

        let frames = play(&mut *source).unwrap_or_else(|error| panic!("{kind}: {error}"));
        assert_eq!(frames.len(), FRAMES, "{kind}");
        for (i, (stamp, middle)) in frames.iter().enumerate() {
            assert_eq!(stamp.sequence, i as u64, "{kind}");
            assert_eq!(stamp.capture_nanos - frames[0].0.capture_nanos, PERIOD_NANOS * i as i64);
            assert!(kind == "sim" || *middle == level(i), "{kind} frame {i} is {middle}");
        }
        let mut pixels = vec![0; WIDTH * HEIGHT];
        assert!(source.next_into(&mut pixels).expect("the end stays").is_none(), "{kind}");
        let truth = source.ground_truth();
        assert_eq!(
            truth.len(),
            if matches!(kind, "images" | "mcap") { 0 } else { FRAMES },
            "{kind}"
        );
        assert!(truth.windows(2).all(|pair| pair[0].nanos < pair[1].nanos), "{kind}");
    }
}

#[test]
fn frames_up_to_a_sequence_can_be_skipped() {
    for kind in ["tum", "euroc", "images", "mcap", "sim"] {
        for (sequence, expected) in
            [(0, vec![1, 2, 3, 4]), (2, vec![3, 4]), (4, vec![]), (99, vec![])]
        {
            let (_folder, source) = opened(kind, |_| {});
            let mut source = source.unwrap_or_else(|error| panic!("{kind}: {error}"));
            source.prepare(&mut |_, _| true).expect("prepared");
            source.skip_to(sequence).unwrap_or_else(|error| panic!("{kind}: {error}"));
            let frames = play(&mut *source).unwrap_or_else(|error| panic!("{kind}: {error}"));
            let left: Vec<u64> = frames.iter().map(|(stamp, _)| stamp.sequence).collect();
            assert_eq!(left, expected, "{kind} behind {sequence}");
        }
    }
}

#[test]
fn a_bad_image_is_one_error_and_the_next_frame_follows() {
    for (kind, image) in [
        ("tum", "rgb/2.png"),
        ("euroc", "mav0/cam0/data/1000000000100000001.png"),
        ("images", "frame10.png"),
    ] {
        let (_folder, source) = opened(kind, |root| {
            let whole = fs::read(root.join(image)).expect("there");
            fs::write(root.join(image), &whole[..whole.len() / 2]).expect("written");
        });
        let mut source = source.unwrap_or_else(|error| panic!("{kind}: {error}"));
        let message = play(&mut *source).expect_err("a truncated image").to_string();
        assert!(message.contains(image) && message.contains("damaged PNG"), "{kind}: {message}");
        let rest = play(&mut *source).expect("the rest is good");
        assert_eq!(rest.iter().map(|(s, _)| s.sequence).collect::<Vec<_>>(), [3, 4], "{kind}");
    }
}

#[test]
fn stamps_keep_every_nanosecond() {
    const LATE: i64 = 1_000_000_000_000_000_001;
    for (kind, first) in [("tum", LATE), ("euroc", LATE), ("mcap", LATE), ("images", 0)] {
        let (_folder, source) = opened(kind, |_| {});
        let frames = play(&mut *source.expect(kind)).expect(kind);
        assert_eq!(frames[0].0.capture_nanos, first, "{kind}");
    }
}

#[test]
fn depth_belongs_to_the_nearest_frame_within_20_ms() {
    let (_folder, source) = opened("tum", |_| {});
    let mut source = source.expect("valid");
    for (stamp, _) in play(&mut *source).expect("valid") {
        let depth = source.depth_at(stamp.capture_nanos).expect("readable");
        let metres = depth.map(|depth| depth.at(WIDTH / 2, HEIGHT / 2));
        let expected = (stamp.sequence % 2 == 0).then_some(1.0 + stamp.sequence as f32);
        assert_eq!(metres, expected, "frame {}", stamp.sequence);
    }
    // The first depth image is stamped 15 ms.
    let first = 1_000_000_000_000_000_000;
    assert!(source.depth_at(first + 35_000_000).expect("readable").is_some());
    assert!(source.depth_at(first + 35_000_001).expect("readable").is_none());
    assert!(source.depth_at(i64::MIN).expect("readable").is_none());
}

#[test]
fn euroc_truth_is_transformed_from_the_body_to_the_camera() {
    let (_folder, source) = opened("euroc", |_| {});
    let source = source.expect("valid");
    let pose = source.ground_truth()[3];
    assert_eq!(pose.nanos, 1_000_000_000_150_000_001);
    let camera = pose.world_from_camera;
    assert!((camera.translation - nalgebra::Vector3::new(3.1, 0.2, 0.3)).norm() < 1e-12);
    // The camera's x axis is the body's y axis.
    let x_axis = camera.rotation * nalgebra::Vector3::x();
    assert!((x_axis - nalgebra::Vector3::y()).norm() < 1e-12);
}

#[test]
fn stamps_of_an_image_folder_come_from_its_times() {
    let times = |text: &'static str| {
        move |root: &Path| fs::write(root.join("times.txt"), text).expect("written")
    };
    let (_folder, source) = opened("images", times("0\n0.5\n1\n1.5\n2\n"));
    let frames = play(&mut *source.expect("valid")).expect("valid");
    assert_eq!(frames[4].0.capture_nanos, 2_000_000_000);
    // By name, with exposure, and only some.
    let (_folder, source) = opened("images", times("frame12 1.5 10.25\nframe8.png 2.5 4\n"));
    let frames = play(&mut *source.expect("valid")).expect("valid");
    let found: Vec<_> =
        frames.iter().map(|(s, l)| (s.capture_nanos, s.exposure_nanos, *l)).collect();
    assert_eq!(
        found,
        [(1_500_000_000, 10_250_000, level(4)), (2_500_000_000, 4_000_000, level(0))]
    );
}

#[test]
fn a_named_rig_overrides_the_recordings_own() {
    for kind in ["tum", "euroc"] {
        let (folder, own) = opened(kind, |_| {});
        let rig = folder.path().join("rig.toml");
        fs::write(&rig, RIG).expect("written");
        let name: SourceName = format!("{kind}:{}", folder.path().display()).parse().expect("name");
        let named = open(&name, Some(&rig)).expect("valid");
        assert_eq!(named.intrinsics().fx, 30.0, "{kind}");
        assert_ne!(own.expect("valid").intrinsics().fx, 30.0, "{kind}: its own has distortion");
        assert_eq!(named.ground_truth().len(), FRAMES, "{kind}");
    }
}

const CAM: &str = "mav0/cam0/data.csv";
const TRUTH: &str = "mav0/state_groundtruth_estimate0/data.csv";

/// Layout, file, the text replaced in it, its replacement, and the expected error.
const BAD_RECORDINGS: &[(&str, &str, &str, &str, &str)] = &[
    ("tum", "rgb.txt", "000.10", "000.01", "rgb.txt, line 4: has an earlier time stamp"),
    ("tum", "rgb.txt", "000.10", "000.05", "rgb.txt, line 4: has the same time stamp"),
    ("tum", "rgb.txt", "1000000000.10", "nan", "rgb.txt, line 4: `nan0000001` is not a time"),
    ("tum", "rgb.txt", "1000000000.100000001 ", "", "rgb.txt, line 4: needs `timestamp filename`"),
    ("tum", "rgb.txt", "rgb/3.png", "rgb/x.png", "rgb/x.png: cannot be read: No such file"),
    ("tum", "groundtruth.txt", " 2 0 0 0 0 0 1", " 2 0 0 0 0 1", "line 4: needs the eight"),
    ("tum", "groundtruth.txt", " 2 0 0 0 0 0 1", " 2 0 0 0 0 0 0", "line 4: its quaternion"),
    ("tum", "groundtruth.txt", " 2 0 0 0", " inf 0 0 0", "line 4: `inf` is not a finite"),
    ("tum", "camera.txt", "32 24", "40 24", "rgb/0.png is 32x24 pixels, but the rig expects 40x24"),
    ("tum", "camera.txt", "32 24", "32", "camera.txt: height = 0: must be 16 to 8192"),
    ("tum", "camera.txt", " 0 0", " 0", "camera.txt: coefficients = [-0.1, 0.02, 0.0]: must be"),
    ("tum", "camera.txt", "30 31 15.5 11.5 32 24 -0.1 0.02 0 0", "30 31", "has 2 numbers"),
    ("tum", "camera.txt", "15.5", "35.5", "camera.txt: cx = 35.5: must be 0 to 31"),
    ("euroc", CAM, "0001,", "0001", "data.csv, line 2: needs `timestamp,filename`"),
    ("euroc", CAM, "1000000000050000001,", "1.5,", "data.csv, line 3: `1.5` is not a time stamp"),
    ("euroc", CAM, "1000000000050000001,", "7,", "data.csv, line 3: has an earlier time"),
    ("euroc", CAM, ",1000000000050000001", ",5", "cam0/data/5.png: cannot be read: No such file"),
    ("euroc", TRUTH, ",2,0,0,1", ",2,0,0,0", "line 4: its quaternion has zero length"),
    ("euroc", TRUTH, ",0,0,1,0,0,0,0.1,0.2,0.3,0,0,0,0,0,0", "", "line 2: needs `timestamp,px"),
    ("images", "rig.toml", "rate_hz = 20", "", "has no times.txt and "),
    ("images", "rig.toml", "rate_hz", "rate", "rig.toml, line 8: unknown field `rate`"),
    ("images", "rig.toml", "= 20", "= nan", "rig.toml: rate_hz = NaN: must be 0.1 to 1000"),
];

/// One line of a file replaced; the error names the file and what to do.
#[test]
fn a_bad_recording_is_one_clear_line() {
    for &(kind, file, from, to, expected) in BAD_RECORDINGS {
        let (_folder, source) = opened(kind, |root| {
            let text = fs::read_to_string(root.join(file)).expect("there");
            assert!(text.contains(from), "{file} has no `{from}`");
            fs::write(root.join(file), text.replace(from, to)).expect("written");
        });
        let error = match source {
            Ok(mut source) => play(&mut *source).expect_err(expected),
            Err(error) => error,
        };
        let message = error.to_string();
        assert!(message.contains(expected), "{kind} {file}: {message}\n  expected {expected}");
        assert!(!message.contains('\n'), "{message}");
    }
}

#[test]
fn missing_files_and_entries_are_named() {
    for (kind, file, text, expected) in [
        ("tum", "rgb.txt", None, "rgb.txt: cannot be read"),
        ("tum", "rgb.txt", Some("# nothing\n"), "rgb.txt: has no frames"),
        ("tum", "camera.txt", None, "has no camera.txt; name the camera with --rig FILE"),
        ("tum", "camera.txt", Some(""), "camera.txt, line 1: needs one line"),
        ("euroc", "mav0/cam0/sensor.yaml", None, "sensor.yaml: cannot be read"),
        ("euroc", "mav0/cam0/data.csv", None, "data.csv: cannot be read"),
        ("euroc", "mav0/cam0/data.csv", Some("#\n"), "data.csv: has no frames"),
        ("images", "times.txt", Some("1\n2\n"), "times.txt: has 2 time stamps for 5 images"),
        ("images", "times.txt", Some("1\n2\n3\n4\n5\n6\n"), "line 6: there are only 5 images"),
        ("images", "times.txt", Some("1\n2 3\n"), "line 2: every line needs one stamp"),
        ("images", "times.txt", Some("a 3\n"), "line 1: there is no image `a`"),
        ("images", "times.txt", Some("frame8 3 -1\n"), "line 1: the exposure is -1: must be"),
        ("images", "times.txt", Some("# none\n"), "times.txt: has 0 time stamps for 5 images"),
        ("images", "rig.toml", None, "has no camera.txt; name the camera with --rig FILE"),
        ("images", "frame11.png", Some(""), "frame11.png is empty"),
    ] {
        let (_folder, source) = opened(kind, |root| {
            let path = root.join(file);
            match text {
                Some(text) => fs::write(path, text).expect("written"),
                None => fs::remove_file(path).expect("removed"),
            }
        });
        let error = match source {
            Ok(mut source) => play(&mut *source).expect_err(expected),
            Err(error) => error,
        };
        let message = error.to_string();
        assert!(message.contains(expected), "{kind} {file}: {message}\n  expected {expected}");
        assert!(!message.contains('\n'), "{message}");
    }
    let empty = tempfile::tempdir().expect("temporary folder");
    let message = open(&SourceName::Images(empty.path().to_owned()), None).err().expect("empty");
    assert!(message.to_string().contains("has no frames"), "{message}");
    fs::write(empty.path().join("rgb.txt"), "").expect("written");
    for named in [SourceName::Images, SourceName::Euroc] {
        let error = open(&named(empty.path().to_owned()), None).err().expect("another layout");
        assert!(error.to_string().contains("looks like tum:"), "{error}");
    }
    let looped = format!("loop:9:30:images:{}", empty.path().display());
    let error = open(&looped.parse().expect("a name"), None).err().expect("another layout");
    assert!(error.to_string().starts_with("source `images:"), "{error}");
    let nowhere = open(&SourceName::Images(empty.path().join("none")), None).err().expect("none");
    assert!(nowhere.to_string().contains("there is no folder "), "{nowhere}");
    assert!(nowhere.to_string().contains("none; check the path"), "{nowhere}");
}

#[test]
fn source_names_are_parsed_and_explained() {
    let cameras = ["v4l:/dev/video0", "stream:/run/frames", "ros2:/camera/image_raw"];
    for name in ["sim", "sim:room", "tum:/a/b", "euroc:a:b", "images:."].into_iter().chain(cameras)
    {
        let parsed: SourceName = name.parse().expect(name);
        assert_eq!(parsed.to_string(), name);
        assert_eq!(parsed.is_camera(), cameras.contains(&name));
    }
    for (name, expected) in [
        ("", "there is no such file or folder: ;"),
        ("ros:topic", "unknown kind; sources are a folder (TUM, EuRoC or images), sim[:SCENE]"),
        ("tum", "the folder is missing"),
        ("images:", "the folder is missing"),
        ("v4l:", "the device is missing, as in v4l:/dev/video0"),
        ("ros2:", "the topic is missing, as in ros2:/camera/image_raw"),
        ("stream:", "the socket's path is missing"),
        ("sim:", "the scene's name is missing"),
        ("/", "no recording was recognised: looked for rgb.txt (TUM)"),
    ] {
        let message = name.parse::<SourceName>().expect_err(name).to_string();
        assert!(message.contains(expected), "{message}");
    }
    let rig = Path::new("rig.toml");
    let simulated = open(&SourceName::Simulator { scene: None }, Some(rig)).err().expect("a rig");
    assert!(simulated.to_string().contains("the simulator takes no rig"), "{simulated}");
    let camera = open(&SourceName::Camera("/dev/video0".into()), None).err().expect("no rig");
    assert!(camera.to_string().contains("a camera needs a rig file"), "{camera}");
}
