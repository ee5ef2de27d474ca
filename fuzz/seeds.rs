//! Small valid inputs from which fuzzing starts: generated here, so that no third-party files are included.

use std::sync::Arc;

use semidense::service::journal::log::{Record, RunStart, Step, log_header};
use semidense::service::map_file::write_map;
use semidense::service::map_folder::depth_file::{MapDetail, encode};
use semidense::service::map_folder::manifest::{DepthFile, Listed, Manifest};
use semidense::service::results::record::{RunCounters, RunMode};
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::{DepthPoint, Keyframe, KeyframePose};
use semidense::slam::map::Map;
use semidense::slam::places::{Description, Feature, FeaturePlace};
use semidense::slam::pose::{PoseEstimate, TrackingState};
use semidense::slam::two_frame::MIN_SIDE_PX;
use semidense::wire::conversion::{
    PoseTiming, keyframe_header, keyframe_image_header, pose_message, rigid_message,
    similarity_message,
};
use semidense::wire::message::{
    AdjustmentMessage, CommandRequest, CommandResponse, FrameHeader, HISTOGRAM_BUCKETS,
    HealthMessage, KeyframePoseMessage, PATH_BYTES, StepMessage, TEXT_BYTES,
};

use super::test_bag::{TestBag, camera_info, compressed_image, frame_record, image};
use super::test_images::{flat_block_jpeg, png_of};
use crate::parsers::{IMAGE_SIDE, SENSOR_YAML, plain};

/// A valid input for a target.
#[derive(Debug, Clone)]
pub struct Seed {
    /// The target's name.
    pub target: &'static str,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// A bag of our own: a camera, an image of each kind, uncompressed chunks.
fn bag() -> Vec<u8> {
    const SIDE: u32 = IMAGE_SIDE as u32;
    let mut bag = TestBag::default();
    let raw = bag.topic("/a/image", "sensor_msgs/msg/Image");
    let camera = bag.topic("/a/camera_info", "sensor_msgs/msg/CameraInfo");
    let frames = bag.topic("/a/details/frame", "semidense_msgs/msg/Frame");
    let lens = [0.01, 0.0, 0.0, 0.0, 0.0];
    bag.message(camera, 1, &camera_info(SIDE, SIDE, "plumb_bob", &lens, [20.0, 20.0, 7.5, 7.5], 0));
    bag.message(frames, 2, &frame_record(2, 5, 2, 3));
    bag.message(raw, 2, &image(2, SIDE, SIDE, "mono8", SIDE, &[9; IMAGE_SIDE * IMAGE_SIDE]));
    bag.end_chunk("", <[u8]>::to_vec);
    bag.message(raw, 3, &image(3, SIDE, SIDE, "rgb8", 3 * SIDE, &[9; 3 * IMAGE_SIDE * IMAGE_SIDE]));
    bag.message(raw, 4, &compressed_image(4, "png", &[1, 2, 3]));
    bag.finish()
}

const CAMERA: Intrinsics = Intrinsics::pinhole(40, 32, 25.0);

/// At least one seed for each target, and one for each kind that its first byte can select.
pub fn seeds() -> Vec<Seed> {
    let mut seeds = Vec::new();
    let mut add = |target, bytes: Vec<u8>| seeds.push(Seed { target, bytes });
    let kind = |kind: u8, rest: &[u8]| [&[kind], rest].concat();
    add("trajectory", b"# c\n1.5 1 2 3 0 0 0 1\n2.5\t-1e-3 2 3 0.5 0.5 0.5 0.5\n".to_vec());
    add(
        "trajectory",
        b"#t\n1500000000,1,2,3,1,0,0,0,9,9\n2500000000, 1, 2, 3, .5, .5, .5, .5\n".to_vec(),
    );
    let toml = "model = \"radtan\"\nwidth = 64\nheight = 48\nfx = 50\nfy = 50.0\ncx = 32\ncy = 24\n\
                coefficients = [0.1, 0.0, 0.0, 0.0]\nrate_hz = 30\n";
    let fisheye = toml.replace("radtan", "equidistant");
    let pinhole = toml.replace("radtan", "pinhole").replace("[0.1, 0.0, 0.0, 0.0]", "[]");
    [toml, &fisheye, &pinhole].iter().for_each(|rig| add("rig", kind(0, rig.as_bytes())));
    add("rig", kind(1, b"# c\n50 50 32 24 64 48\n"));
    add("rig", kind(1, b"50 50.0 3.2e1 24 64 48 0.1 0.01 0 0 0.001 0.1 0.1 0.1\n"));
    add("rig", kind(2, SENSOR_YAML.as_bytes()));
    let lists: [&[u8]; 7] = [
        b"# c\n1.25 1.png\n2.5 2.png\n",
        b"1.26 1.png\n2.51 2.png\n",
        b"1.25 0 0 0 0 0 0 1\n2.5 1 0 0 0.5 0.5 0.5 0.5\n",
        b"1.png 1.25 3.5\n2 2.5\n",
        b"#t,f\n1250000000,1.png\n2500000000,2.png\n",
        b"1250000000,1,2,3,1,0,0,0,9\n2500000000,1,2,3,.5,.5,.5,.5,9\n",
        SENSOR_YAML.as_bytes(),
    ];
    lists.iter().zip(0..).for_each(|(list, index)| add("lists", kind(index, list)));
    add("lists", kind(3, b"1.25\n2.5\n"));
    images().into_iter().for_each(|bytes| add("image", bytes));
    add("bag", bag());
    let file = include_str!("../config/semidense.toml");
    let plain: String =
        file.lines().filter(|l| !l.starts_with('#')).map(|l| format!("{l}\n")).collect();
    add("configuration", kind(0, plain.as_bytes()));
    add(
        "configuration",
        kind(0, b"[tracker]\ndeadline_ms = 5.0\n[mapper.scheduling]\ncpus = [0]\n"),
    );
    add(
        "configuration",
        kind(1, b"mapper.threads=2\nsimulator.motion.mean_speed_m_s=1.0\ninstance=rig2\n"),
    );
    add("map", map_bytes());
    add("map_folder", kind(0, &manifest()));
    for detail in [MapDetail::Full, MapDetail::Small] {
        add("map_folder", kind(1, &encode(&keyframe(), detail)));
        add("map_folder", kind(1, &encode(&described(), detail)));
    }
    add("journal", journal());
    messages()
        .into_iter()
        .zip(0..)
        .for_each(|(message, index)| add("message", kind(index, &message)));
    add("pipeline", pipeline());
    add("pipeline", camera_too_small_for_the_mapper());
    seeds
}

fn images() -> Vec<Vec<u8>> {
    use png::{BitDepth, ColorType};
    let side = IMAGE_SIDE as u32;
    let samples = |count: usize| -> Vec<u8> { (0..count).map(|i| (i * 37 % 251) as u8).collect() };
    let pixels = IMAGE_SIDE * IMAGE_SIDE;
    let palette = samples(3 * 16);
    vec![
        png_of(side, side, ColorType::Grayscale, BitDepth::Eight, None, &samples(pixels)),
        png_of(side, side, ColorType::Grayscale, BitDepth::Sixteen, None, &samples(2 * pixels)),
        png_of(side, side, ColorType::Rgba, BitDepth::Eight, None, &samples(4 * pixels)),
        png_of(
            side,
            side,
            ColorType::Indexed,
            BitDepth::Four,
            Some(&palette),
            &samples(pixels / 2),
        ),
        flat_block_jpeg(IMAGE_SIDE, IMAGE_SIDE, 1, false, |u, v, _| (40 * u + 80 * v) as u8),
        flat_block_jpeg(IMAGE_SIDE, IMAGE_SIDE, 3, false, |u, v, c| (40 * u + 80 * v) as u8 + c),
        flat_block_jpeg(IMAGE_SIDE, IMAGE_SIDE, 3, true, |u, v, c| (40 * u + 80 * v) as u8 + c),
    ]
}

fn keyframe() -> Keyframe {
    let point = DepthPoint { u: 3, v: 15, inverse_depth: 0.7, variance: 0.01, intensity: 128.5 };
    Keyframe {
        revision: 1,
        capture_nanos: 5,
        ..Keyframe::at(
            Sim3::new(SE3::identity(), 1.5),
            CAMERA,
            (0..24).map(|u| DepthPoint { u, ..point }).collect(),
            (0..CAMERA.width * CAMERA.height).map(|i| (i * i % 251) as u8).collect(),
        )
    }
}

fn described() -> Keyframe {
    let place = FeaturePlace { u: 5, v: 6, orientation: 7, scale: 1 };
    let features = vec![Feature { place, bits: [1, 2, 3, 4] }; 20];
    let description = Description::of_features(CAMERA.width, CAMERA.height, features);
    Keyframe { description: description.map(Arc::new), ..keyframe() }
}

fn map_bytes() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("map");
    let second = Keyframe { keyframe_id: 1, epoch: 1, ..keyframe() };
    write_map(
        &path,
        &Map { keyframes: vec![keyframe(), second], free_epoch: 17, ..Map::default() },
        &mut || (),
    )
    .expect("written");
    std::fs::read(path).expect("read")
}

fn manifest() -> Vec<u8> {
    let file = DepthFile { revision: 1, bytes: 3000, checksum: 7, num_points: 24 };
    let listed = Listed { keyframe: keyframe().without_depth(), file: Some(file) };
    let other = Keyframe { keyframe_id: 1, epoch: 1, ..keyframe().without_depth() };
    let without = Listed { keyframe: other, file: None };
    let empty = Manifest::new(CAMERA, MapDetail::Full);
    Manifest { keyframes: vec![listed, without], ..empty }.to_bytes()
}

fn journal() -> Vec<u8> {
    let start = RunStart {
        mode: RunMode::Live,
        source: "sim".into(),
        rig: None,
        folder: "/".into(),
        config: "instance = \"rig\"\n".to_owned(),
        poses_given: false,
        is_depth_from_sensor: false,
        first_keyframe_id: 0,
        began_nanos: 1,
    };
    let map_from_keyframe = Sim3::new(SE3::identity(), 2.0);
    let without_depth = keyframe().without_depth();
    let records = [
        Record::Start(Box::new(start)),
        Record::Pose(Box::new(pose_message(&pose(1), &PoseTiming::default()))),
        Record::Step(Step { step_nanos: 5, change_nanos: 3, start_frame: 1 }),
        Record::Keyframe(Box::new(without_depth)),
        Record::KeyframePose(0, KeyframePose { keyframe_id: 0, revision: 1, map_from_keyframe }),
        Record::Counters(Box::new(RunCounters { frames_in: 2, ..RunCounters::default() })),
    ];
    let mut bytes = log_header();
    records.iter().for_each(|record| record.write(&mut bytes));
    bytes
}

fn frame_header(sequence: u64) -> FrameHeader {
    FrameHeader {
        sequence,
        capture_nanos: 33_000_000 * sequence as i64,
        clock_nanos: 0,
        realtime_nanos: 0,
        sent_nanos: 0,
        exposure_nanos: 5_000_000,
        intrinsics: [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
        width: CAMERA.width as u32,
        height: CAMERA.height as u32,
        stride: CAMERA.width as u32,
        gain: 1.0,
    }
}

fn pose(sequence: u64) -> PoseEstimate {
    let (width, height) = (CAMERA.width, CAMERA.height);
    let (capture_nanos, exposure_nanos) = (33_000_000 * sequence as i64, 0);
    let pixels = &[][..];
    let frame = FrameView { sequence, capture_nanos, exposure_nanos, width, height, pixels };
    PoseEstimate { state: TrackingState::Tracking, keyframe_id: 0, ..PoseEstimate::unknown(&frame) }
}

/// One message of each kind of `parsers::message`, in that order.
fn messages() -> [Vec<u8>; 7] {
    let (keyframe, timing) = (keyframe(), PoseTiming::default());
    let pixels = vec![9; CAMERA.width * CAMERA.height];
    let health = HealthMessage {
        published_nanos: 1,
        process_id: 1,
        state: 3,
        frames: 9,
        rate_hz: 30.0,
        cause_bytes: 4,
        latency_counts: [1; HISTOGRAM_BUCKETS],
        wake_counts: [2; HISTOGRAM_BUCKETS],
        adjustments: 5,
        adjustments_merged: 2,
        adjustments_dropped: 1,
        adjustment_counts: [3; HISTOGRAM_BUCKETS],
        loops_closed: 1,
        loops_held: 2,
        epochs_joined: 3,
        loops_refused: 4,
        loops_against_drift: 5,
        loops_unconfirmed: 6,
        loops_inconsistent: 7,
        scheduling: 1,
        priority: 70,
        memory_locked: 1,
        warning_bytes: 3,
        warning: [b'w'; TEXT_BYTES],
        cause: [b'c'; TEXT_BYTES],
        source: [b's'; TEXT_BYTES],
        source_bytes: 5,
        ..HealthMessage::empty()
    };
    let step = StepMessage {
        world_from_camera: rigid_message(&SE3::identity()),
        has_pose: 1,
        ..StepMessage::default()
    };
    let graph = KeyframePoseMessage {
        keyframe_id: 1,
        revision: 3,
        map_from_keyframe: similarity_message(&keyframe.map_from_keyframe),
    };
    let mut request =
        CommandRequest { keyframe_id: 0, kind: 0, path_bytes: 6, path: [0; PATH_BYTES] };
    request.path[..6].copy_from_slice(b"/tmp/x");
    let response = CommandResponse { status: 1, text_bytes: 2, text: [b't'; TEXT_BYTES] };
    [
        [bytes_of(&frame_header(1)), pixels.clone()].concat(),
        [bytes_of(&pose_message(&pose(1), &timing)), bytes_of(&pose_message(&pose(2), &timing))]
            .concat(),
        [
            bytes_of(&keyframe_header(&keyframe)),
            bytes_of(&keyframe_image_header(&keyframe)),
            keyframe.points[..4].iter().flat_map(bytes_of).collect(),
            pixels,
        ]
        .concat(),
        [bytes_of(&graph), bytes_of(&graph)].concat(),
        [bytes_of(&step), bytes_of(&AdjustmentMessage::default())].concat(),
        bytes_of(&health),
        [bytes_of(&request), bytes_of(&response)].concat(),
    ]
}

/// Frames, a keyframe from the wire, frames tracked on it, and a pose from the wire.
fn pipeline() -> Vec<u8> {
    let frame =
        |sequence: u64| [vec![4 * sequence as u8], bytes_of(&frame_header(sequence))].concat();
    let keyframe = keyframe();
    let mut bytes = [frame(1), frame(2)].concat();
    bytes.push(2);
    bytes.extend(bytes_of(&keyframe_header(&keyframe)));
    bytes.extend(bytes_of(&keyframe.points[0]));
    bytes.extend((3..6).flat_map(frame));
    bytes.push(1);
    bytes.extend(bytes_of(&frame_header(6)));
    bytes.extend(bytes_of(&pose_message(&pose(6), &PoseTiming::default())));
    bytes.push(3);
    bytes.extend((7..9).flat_map(frame));
    bytes
}

/// A finding: a start that the tracker accepts and the mapper refuses.
fn camera_too_small_for_the_mapper() -> Vec<u8> {
    let (width, height) = (MIN_SIDE_PX as u32, MIN_SIDE_PX as u32 - 1);
    let small = |sequence| FrameHeader { width, height, stride: width, ..frame_header(sequence) };
    let frame = |sequence: u64| [vec![4 * sequence as u8], bytes_of(&small(sequence))].concat();
    (1..4).flat_map(frame).collect()
}

/// The bytes of a message as in shared memory.
fn bytes_of<T: Copy + plain::Message>(message: &T) -> Vec<u8> {
    // SAFETY: a message has no padding, so that all its bytes are initialised.
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(message).cast::<u8>(), size_of::<T>()) }
        .to_vec()
}
