//! The fuzz targets: everything that semidense reads from files and from shared memory, one function each. None may
//! panic, hang or allocate without bound; accepted input must satisfy the invariants of its type.
//! `tests/files/fuzz_findings.rs` runs the seeds and all past findings through the same functions.

use std::fs;
use std::path::Path;

use semidense::capture::image_file::decode_gray_into;
use semidense::capture::opening::open;
use semidense::capture::rig::Rig;
use semidense::capture::source::FrameSource;
use semidense::capture::source_name::SourceName;
use semidense::capture::{png_image, sensor_yaml};
use semidense::service::adjustments::message::adjustment_from_message;
use semidense::service::config::Config;
use semidense::service::frame_order::FrameOrder;
use semidense::service::health::{ProcessState, cause, percentile_ms, warning};
use semidense::service::journal::recovered::Recovered;
use semidense::service::map_file::parse_map;
use semidense::service::map_folder::depth_file::{MapDetail, decode_into, encode, seal};
use semidense::service::map_folder::manifest::Manifest;
use semidense::service::pairing::Pairing;
use semidense::service::results::record::RunRecord;
use semidense::service::trajectory_file::{parse_trajectory, tum_line};
use semidense::slam::alignment::reference::{Reference, ReferenceParams, ReferenceScratch};
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::rectification::Rectification;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::slam::mapper::{Mapper, MapperParams};
use semidense::slam::tracker::{Tracker, TrackerParams};
use semidense::slam::trajectory::EpochPose;
use semidense::wire::command::{command_of, text_from_bytes};
use semidense::wire::conversion::{
    PoseTiming, frame_from_message, keyframe_from_messages, keyframe_pose_from_message,
    pose_from_message, pose_message, rigid_from_message,
};
use semidense::wire::message::{
    AdjustmentMessage, CommandRequest, CommandResponse, FrameHeader, HealthMessage, KeyframeHeader,
    KeyframeImageHeader, KeyframePoseMessage, PoseMessage, StepMessage,
};

/// Upper limit for the pixels of an image that is rectified or tracked: larger ones only take longer.
const MAX_PIXELS: usize = 64 * 64;
/// Width and height of decoded images.
pub const IMAGE_SIDE: usize = 16;

/// A trajectory file: accepted poses are ordered and finite, and survive a round trip through their own lines.
pub fn trajectory(bytes: &[u8]) {
    let Ok(poses) = parse_trajectory(bytes) else { return };
    assert!(poses.windows(2).all(|pair| pair[0].pose.nanos <= pair[1].pose.nanos));
    for EpochPose { pose, .. } in &poses {
        assert!(pose.world_from_camera.translation.iter().all(|x| x.is_finite()));
        assert!((pose.world_from_camera.rotation.norm() - 1.0).abs() < 1e-9);
        let again = parse_trajectory(tum_line(pose).as_bytes()).expect("our own line");
        assert_eq!(again[0].pose.nanos, pose.nanos);
    }
}

/// A rig: the first byte selects TOML, `camera.txt` or `sensor.yaml`.
pub fn rig(bytes: &[u8]) {
    let Some((kind, rest)) = bytes.split_first() else { return };
    let Ok(text) = str::from_utf8(rest) else { return };
    let path = Path::new("rig");
    let rig = match kind % 3 {
        0 => Rig::from_toml(path, text).ok(),
        1 => Rig::from_camera_txt(path, text).ok(),
        _ => sensor_yaml::parse(path, text).ok().map(|sensor| sensor.rig),
    };
    let Some(rig) = rig else { return };
    let raw = rig.camera.intrinsics();
    assert!(raw.is_valid());
    if raw.width * raw.height <= MAX_PIXELS
        && let Ok(rectification) = Rectification::new(&rig.camera)
    {
        let size = raw.width * raw.height;
        assert!(rectification.intrinsics().is_valid());
        rectification.rectify_into(&vec![7; size], &mut vec![0; size]);
    }
}

/// The lists of a recording: the first byte selects one, the others are valid.
pub fn lists(bytes: &[u8]) {
    let Some((kind, text)) = bytes.split_first() else { return };
    thread_local! {
        static FOLDER: tempfile::TempDir = tempfile::tempdir().expect("a temporary folder");
    }
    FOLDER.with(|folder| {
        let folder = folder.path();
        let lists: [(&str, &[u8]); 7] = [
            ("tum/rgb.txt", b"1.0 1.png\n2.0 2.png\n"),
            ("tum/depth.txt", b"1.0 1.png\n"),
            ("tum/groundtruth.txt", b"1.0 0 0 0 0 0 0 1\n"),
            ("images/times.txt", b"1.0\n2.0\n"),
            ("mav0/cam0/data.csv", b"1,1.png\n2,2.png\n"),
            ("mav0/state_groundtruth_estimate0/data.csv", b"1,0,0,0,1,0,0,0\n"),
            ("mav0/cam0/sensor.yaml", SENSOR_YAML.as_bytes()),
        ];
        if !folder.join("tum").exists() {
            write_images(folder);
        }
        let hostile = usize::from(*kind) % lists.len();
        for (index, (name, good)) in lists.iter().enumerate() {
            let content = if index == hostile { text } else { good };
            let path = folder.join(name);
            if fs::read(&path).ok().as_deref() != Some(content) {
                fs::write(path, content).expect("written");
            }
        }
        let (kind, place) = match hostile {
            0..=2 => ("tum", folder.join("tum")),
            3 => ("images", folder.join("images")),
            _ => ("euroc", folder.to_owned()),
        };
        let name: SourceName = format!("{kind}:{}", place.display()).parse().expect("a source");
        let Ok(mut source) = open(&name, None, &Default::default()) else { return };
        play(source.as_mut());
    });
}

/// The camera of the recording that [`lists`] writes.
pub const SENSOR_YAML: &str = "%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.1,
         1.0, 0.0, 0.0, 0.2,
         0.0, 0.0, 1.0, 0.3,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [16, 16]
camera_model: pinhole
intrinsics: [20.0, 20.0, 7.5, 7.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.01, 0.001, 0.0, 0.0]
";

fn write_images(folder: &Path) {
    let gray = vec![128; IMAGE_SIDE * IMAGE_SIDE];
    let png = png_image::encode_gray(IMAGE_SIDE, IMAGE_SIDE, png::BitDepth::Eight, &gray);
    let png = png.expect("a PNG");
    for images in ["tum", "images", "mav0/cam0/data"] {
        let images = folder.join(images);
        fs::create_dir_all(&images).expect("a folder");
        (1..=2).for_each(|i| fs::write(images.join(format!("{i}.png")), &png).expect("written"));
    }
    for images in ["tum", "images"] {
        let camera = folder.join(images).join("camera.txt");
        fs::write(camera, "20 20 7.5 7.5 16 16\n").expect("written");
    }
    fs::create_dir_all(folder.join("mav0/state_groundtruth_estimate0")).expect("a folder");
}

/// Reads every frame of a source; its stamps increase and its poses are finite.
fn play(source: &mut dyn FrameSource) {
    let k = source.intrinsics();
    let mut pixels = vec![0; k.width * k.height];
    let mut last = None;
    // Images that cannot be read are skipped; a list names few.
    for _ in 0..source.num_frames().unwrap_or(0) {
        if let Ok(Some(stamp)) = source.next_into(&mut pixels) {
            assert!(last.is_none_or(|last| stamp.capture_nanos > last));
            last = Some(stamp.capture_nanos);
            let _ = source.depth_at(stamp.capture_nanos);
        }
    }
    for pose in source.ground_truth() {
        assert!(pose.world_from_camera.translation.iter().all(|x| x.is_finite()));
    }
}

/// A bag.
pub fn bag(bytes: &[u8]) {
    /// Upper limit for the frames read: a bag may contain thousands.
    const MAX_FRAMES: usize = 100;
    thread_local! {
        static FOLDER: tempfile::TempDir = tempfile::tempdir().expect("a temporary folder");
    }
    FOLDER.with(|folder| {
        let path = folder.path().join("bag.mcap");
        fs::write(&path, bytes).expect("written");
        let name = SourceName::Mcap { file: path, topic: None };
        let Ok(mut source) = open(&name, None, &Default::default()) else { return };
        let k = source.intrinsics();
        if k.width * k.height > MAX_PIXELS {
            return;
        }
        let mut pixels = vec![0; k.width * k.height];
        let mut last = None;
        for _ in 0..MAX_FRAMES {
            match source.next_into(&mut pixels) {
                Ok(Some(stamp)) => {
                    assert!(last.is_none_or(|last| (stamp.sequence, stamp.capture_nanos) > last));
                    last = Some((stamp.sequence, stamp.capture_nanos));
                }
                Ok(None) => break,
                Err(error) if error.is_transient() => {}
                Err(_) => break,
            }
        }
    });
}

/// An image, decoded as grey values and as depth.
pub fn image(bytes: &[u8]) {
    let mut gray = [0; IMAGE_SIDE * IMAGE_SIDE];
    let _ = decode_gray_into(bytes, IMAGE_SIDE, IMAGE_SIDE, &mut Vec::new(), &mut gray);
    if let Ok(depth) = png_image::decode_u16(bytes, IMAGE_SIDE, IMAGE_SIDE) {
        assert_eq!(depth.len(), gray.len());
    }
}

/// A configuration: an even first byte and the text of a file, or an odd one and settings, one per line.
pub fn configuration(bytes: &[u8]) {
    let Some((kind, rest)) = bytes.split_first() else { return };
    let Ok(text) = str::from_utf8(rest) else { return };
    let config = if kind % 2 == 0 {
        Config::from_text(text, "file")
    } else {
        let settings: Vec<String> = text.lines().take(4).map(str::to_owned).collect();
        Config::load(None, &settings)
    };
    match config {
        Ok(config) => {
            let again = Config::from_text(&config.to_text(), "again").expect("our own text");
            assert_eq!(again, config);
        }
        Err(error) => assert_eq!(error.to_string().lines().count(), 1, "{error}"),
    }
}

/// A map file or checkpoint.
pub fn map(bytes: &[u8]) {
    let Ok(map) = parse_map(bytes) else { return };
    for keyframe in &map.keyframes {
        assert!(keyframe.intrinsics.is_valid() && keyframe.world_from_keyframe.is_valid());
    }
    let Some(intrinsics) = map.keyframes.last().map(|keyframe| keyframe.intrinsics) else { return };
    if intrinsics.width * intrinsics.height <= MAX_PIXELS {
        let Ok(mut mapper) = Mapper::new(intrinsics, MapperParams::default()) else { return };
        mapper.resume(map);
        let view = View::new(1, 0, intrinsics, 3);
        let unknown = semidense::slam::pose::PoseEstimate::unknown(&view.frame());
        mapper.step(&view.frame(), &unknown, None, &mut || {});
    }
}

/// A file of a map folder: an even first byte and a manifest, or an odd one and a keyframe's image and depth.
pub fn map_folder(bytes: &[u8]) {
    let Some((kind, rest)) = bytes.split_first() else { return };
    // Corrects the checksums, which fuzzing would hardly guess.
    let mut rest = rest.to_vec();
    if kind % 2 == 0 {
        if let Some(body) = rest.len().checked_sub(4) {
            let checksum = crc32(&rest[..body]).to_le_bytes();
            rest[body..].copy_from_slice(&checksum);
        }
        let Ok(manifest) = Manifest::from_bytes(&rest) else { return };
        assert!(manifest.camera.is_valid());
        let again = Manifest::from_bytes(&manifest.to_bytes()).expect("our own bytes");
        assert_eq!(again.keyframes.len(), manifest.keyframes.len());
        return;
    }
    seal(&mut rest);
    let camera = Intrinsics::pinhole(40, 32, 25.0);
    let mut keyframe = Keyframe::at(Sim3::identity(), camera, Vec::new(), Vec::new());
    if decode_into(&rest, &mut keyframe).is_ok() {
        assert_eq!(keyframe.image.len(), 40 * 32);
        assert!(keyframe.points.iter().all(|point| point.u < 40 && point.v < 32));
        let mut again = keyframe.without_depth();
        decode_into(&encode(&keyframe, MapDetail::Full), &mut again).expect("our own bytes");
        assert!(again == keyframe);
    }
}

/// The CRC-32 of zlib, bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| crc >> 1 ^ if crc & 1 == 1 { 0xedb8_8320 } else { 0 };
    !bytes.iter().fold(!0, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

/// The log of a journal: an accepted log is a run whose results can be written.
pub fn journal(bytes: &[u8]) {
    let Some(found) = Recovered::from_log(bytes) else { return };
    let folder = Path::new("/nowhere");
    let map = found.map(folder, 1 << 20);
    assert!(map.keyframes.iter().all(|keyframe| keyframe.world_from_keyframe.is_valid()));
    let poses = found.recording.num_poses();
    assert!(found.counters.frames_in >= poses as u64);
    let known = RunRecord {
        map,
        counters: found.counters,
        is_depth_from_sensor: found.start.is_depth_from_sensor,
        ..RunRecord::empty(found.start.mode, &found.start.source.to_os_string().to_string_lossy())
    };
    let record = found.recording.into_record(known, 0.0);
    assert_eq!(record.poses.len(), poses);
    let _ = Config::from_text(&found.start.config, "journal");
}

/// One message of any topic, which the first byte selects.
pub fn message(bytes: &[u8]) {
    let Some((kind, mut rest)) = bytes.split_first() else { return };
    match kind % 7 {
        0 => {
            let Some(header) = take::<FrameHeader>(&mut rest) else { return };
            let mut order = FrameOrder::default();
            order.arrive(&header);
            let _ = frame_from_message(&header, rest);
            // A second header: no pair may overflow the arithmetic.
            if let Some(next) = take::<FrameHeader>(&mut rest) {
                order.arrive(&next);
                assert!(order.period_nanos() > 0);
            }
        }
        1 => {
            let mut pairing = Pairing::new(2);
            while let Some(message) = take::<PoseMessage>(&mut rest) {
                let Ok(pose) = pose_from_message(&message) else { continue };
                let again = pose_from_message(&pose_message(&pose, &PoseTiming::default()));
                assert_eq!(again.expect("our own message").state, pose.state);
                pairing.push_frame(message.keyframe_id, ());
                pairing.push_pose(pose);
                pairing.take();
            }
        }
        2 => {
            let (Some(header), Some(image_header)) =
                (take::<KeyframeHeader>(&mut rest), take::<KeyframeImageHeader>(&mut rest))
            else {
                return;
            };
            let mut points = Vec::new();
            while rest.len() % size_of::<DepthPoint>() != 0 || points.len() < 4 {
                match take::<DepthPoint>(&mut rest) {
                    Some(point) => points.push(point),
                    None => break,
                }
            }
            let image =
                vec![9; (header.width as usize).wrapping_mul(header.height as usize) % 9999];
            let _ = keyframe_from_messages(&header, &points, &image_header, &image);
            let _ = keyframe_from_messages(&header, &points, &image_header, rest);
        }
        3 => {
            while let Some(message) = take::<KeyframePoseMessage>(&mut rest) {
                let _ = keyframe_pose_from_message(&message);
            }
        }
        4 => {
            let Some(step) = take::<StepMessage>(&mut rest) else { return };
            let _ = rigid_from_message(&step.world_from_camera, "world_from_camera");
            while let Some(message) = take::<AdjustmentMessage>(&mut rest) {
                let _ = adjustment_from_message(&message);
            }
        }
        5 => {
            let Some(health) = take::<HealthMessage>(&mut rest) else { return };
            let _ = ProcessState::from_code(health.state);
            assert!(!cause(&health).contains('\n') && !warning(&health).contains('\n'));
            for counts in [&health.latency_counts, &health.work_counts, &health.wake_counts] {
                for share in [0.0, 0.5, 0.99, 1.0] {
                    assert!(percentile_ms(counts, share).is_none_or(f64::is_finite));
                }
            }
        }
        _ => {
            if let Some(request) = take::<CommandRequest>(&mut rest) {
                let _ = command_of(&request);
            }
            if let Some(response) = take::<CommandResponse>(&mut rest) {
                text_from_bytes(&response.text, response.text_bytes);
            }
        }
    }
}

/// Messages from the wire, in any order, through tracker and mapper: each is a byte for its kind and the message; the
/// images are generated here.
pub fn pipeline(bytes: &[u8]) {
    let mut rest = bytes;
    let mut tracker: Option<(Intrinsics, Tracker)> = None;
    let mut mapper: Option<(Intrinsics, Mapper)> = None;
    // The longest operation, a step of the map, takes a millisecond.
    for _ in 0..12 {
        let Some((kind, after)) = rest.split_first() else { return };
        rest = after;
        match kind % 4 {
            // A frame, tracked, then mapped with the resulting pose.
            0 => {
                let Some(view) = take_view(&mut rest, *kind) else { continue };
                let (of, tracker) =
                    tracker.get_or_insert_with(|| (view.intrinsics, tracker_for(view.intrinsics)));
                if *of != view.intrinsics {
                    (*of, *tracker) = (view.intrinsics, tracker_for(view.intrinsics));
                }
                let pose = tracker.track(&view.frame(), &mut |_| true);
                let sent = pose_from_message(&pose_message(&pose, &PoseTiming::default()));
                if let Ok(pose) = sent {
                    map_step(&mut mapper, &view, &pose);
                }
            }
            // A frame, mapped with a pose from the wire.
            1 => {
                let Some(view) = take_view(&mut rest, *kind) else { continue };
                let Some(message) = take::<PoseMessage>(&mut rest) else { continue };
                if let Ok(pose) = pose_from_message(&message) {
                    map_step(&mut mapper, &view, &pose);
                }
            }
            // A keyframe from the wire, with points on a grid.
            2 => {
                let Some(header) = take::<KeyframeHeader>(&mut rest) else { continue };
                let Some(point) = take::<DepthPoint>(&mut rest) else { continue };
                let size = (header.width as usize).saturating_mul(header.height as usize);
                let Some((_, tracker)) = tracker.as_mut().filter(|_| size <= MAX_PIXELS) else {
                    continue;
                };
                let (keyframe_id, epoch) = (header.keyframe_id, header.epoch);
                let (width, height) = (header.width, header.height);
                let image_header =
                    KeyframeImageHeader { keyframe_id, epoch, width, height, stride: width };
                let mut points = vec![point];
                points.extend((0..size).step_by(3).map(|i| DepthPoint {
                    u: (i % width as usize) as u16,
                    v: (i / width as usize) as u16,
                    ..point
                }));
                let image = picture(width as usize, height as usize, *kind);
                if let Ok(keyframe) =
                    keyframe_from_messages(&header, &points, &image_header, &image)
                {
                    let mut reference = Reference::new(ReferenceParams::default());
                    reference.prepare_into(&keyframe, &mut ReferenceScratch::default());
                    tracker.adopt(Box::new(reference));
                }
            }
            // The mapper's own keyframe, passed to the tracker.
            _ => {
                let keyframe = mapper.as_ref().and_then(|(_, mapper)| mapper.keyframe());
                if let (Some(keyframe), Some((_, tracker))) = (keyframe, tracker.as_mut()) {
                    let mut reference = Reference::new(ReferenceParams::default());
                    reference.prepare_into(keyframe, &mut ReferenceScratch::default());
                    tracker.adopt(Box::new(reference));
                }
            }
        }
    }
}

fn tracker_for(intrinsics: Intrinsics) -> Tracker {
    Tracker::new(intrinsics, TrackerParams::default()).expect("valid parameters")
}

fn map_step(
    mapper: &mut Option<(Intrinsics, Mapper)>,
    view: &View,
    pose: &semidense::slam::pose::PoseEstimate,
) {
    if mapper.as_ref().is_none_or(|(of, _)| *of != view.intrinsics) {
        // An image that is too small is refused, as in the mapper process.
        let Ok(mut fresh) = Mapper::new(view.intrinsics, MapperParams::default()) else { return };
        if let Some((_, before)) = mapper.take() {
            fresh.continue_from(before);
        }
        *mapper = Some((view.intrinsics, fresh));
    }
    if let Some((_, mapper)) = mapper {
        mapper.step(&view.frame(), pose, None, &mut || {});
    }
}

/// A frame with its own image.
struct View {
    sequence: u64,
    capture_nanos: i64,
    intrinsics: Intrinsics,
    pixels: Vec<u8>,
}

impl View {
    fn new(sequence: u64, capture_nanos: i64, intrinsics: Intrinsics, shift: u8) -> Self {
        let pixels = picture(intrinsics.width, intrinsics.height, shift);
        Self { sequence, capture_nanos, intrinsics, pixels }
    }

    fn frame(&self) -> FrameView<'_> {
        let Self { sequence, capture_nanos, .. } = *self;
        let pixels = &self.pixels[..];
        FrameView::new(&self.intrinsics, sequence, capture_nanos, pixels)
    }
}

fn take_view(rest: &mut &[u8], shift: u8) -> Option<View> {
    let header = take::<FrameHeader>(rest)?;
    let size = (header.width as usize).checked_mul(header.height as usize)?;
    let pixels = vec![0; Some(size).filter(|size| *size <= MAX_PIXELS)?];
    let (frame, intrinsics) = frame_from_message(&header, &pixels).ok()?;
    Some(View::new(frame.sequence, frame.capture_nanos, intrinsics, shift / 4))
}

/// Waves, shifted by `shift` tenths of a pixel to the right.
fn picture(width: usize, height: usize, shift: u8) -> Vec<u8> {
    let grey = |i: usize| {
        let (u, v) = ((i % width) as f64 - f64::from(shift) * 0.1, (i / width) as f64);
        128.0 + 40.0 * (u * 0.7).sin() * (v * 0.5).cos() + 30.0 * (0.3 * u + 0.4 * v).sin()
    };
    (0..width * height).map(|i| grey(i) as u8).collect()
}

/// Takes a message from the front of `bytes`.
fn take<T: Copy + plain::Message>(bytes: &mut &[u8]) -> Option<T> {
    let (front, rest) = bytes.split_at_checked(size_of::<T>())?;
    *bytes = rest;
    // SAFETY: the bytes are as many as a `T` has, and every bit pattern is a valid message.
    Some(unsafe { front.as_ptr().cast::<T>().read_unaligned() })
}

/// Types that can be read from shared memory unchanged.
pub mod plain {
    use super::*;

    /// Messages: `#[repr(C)]`, scalars only, every bit pattern valid.
    ///
    /// # Safety
    /// Implement it for no other type.
    pub unsafe trait Message {}

    macro_rules! messages {
        ($($message:ty),*) => {
            $(
                // SAFETY: src/wire/message.rs promises it of every message.
                unsafe impl Message for $message {}
            )*
        };
    }

    messages!(
        FrameHeader,
        PoseMessage,
        KeyframeHeader,
        KeyframeImageHeader,
        DepthPoint,
        KeyframePoseMessage,
        StepMessage,
        AdjustmentMessage,
        HealthMessage,
        CommandRequest,
        CommandResponse
    );
}
