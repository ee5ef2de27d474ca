//! A small run as a list of events, for tests without a pipeline.
#![allow(dead_code, reason = "every test uses its part of it")]

use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Vector6;
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::{DepthPoint, Keyframe, KeyframePose};
use semidense::slam::pose::{PoseEstimate, TrackingState};
use semidense::wire::conversion::{PoseTiming, pose_message};
use semidense::wire::message::{FrameHeader, GraphHeader, HealthMessage};
use semidense_bridge::session::{Event, Frame, Graph, Pose};

pub const WIDTH: usize = 64;
pub const HEIGHT: usize = 48;
pub const CAMERA: Intrinsics =
    Intrinsics { fx: 50.0, fy: 50.0, cx: 31.5, cy: 23.5, width: WIDTH, height: HEIGHT };
/// CLOCK_REALTIME of frame 0: a value with every digit in use.
pub const REALTIME: i64 = 1_750_000_000_123_456_789;
/// The source's clock at frame 0.
pub const CAPTURE: i64 = 5_000_000_007;
pub const PERIOD: i64 = 33_333_333;

/// Noise that depends on the frame, with uncorrelated pixels.
pub fn pixels(frame: u64) -> Vec<u8> {
    let mut state = frame as u32 * 7919 + 1;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    (0..WIDTH * HEIGHT).map(|_| next()).collect()
}

pub fn frame(sequence: u64) -> Event {
    let later = sequence as i64 * PERIOD;
    let header = FrameHeader {
        sequence,
        capture_nanos: CAPTURE + later,
        realtime_nanos: REALTIME + later,
        exposure_nanos: 4_000_000,
        intrinsics: [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
        width: WIDTH as u32,
        height: HEIGHT as u32,
        stride: WIDTH as u32,
        ..FrameHeader::default()
    };
    let pixels = Arc::from(pixels(sequence));
    Event::Frame(Arc::new(Frame { header, intrinsics: CAMERA, pixels }))
}

/// The camera moves ahead by 0.01 per frame, at 1 to the right of the world's origin.
pub fn pose(sequence: u64) -> Event {
    let later = sequence as i64 * PERIOD;
    let view = FrameView {
        sequence,
        capture_nanos: CAPTURE + later,
        exposure_nanos: 0,
        width: WIDTH,
        height: HEIGHT,
        pixels: &[],
    };
    let world_from_camera =
        SE3::exp(&Vector6::new(1.0, 0.0, 0.01 * sequence as f64, 0.0, 0.0, 0.0));
    let mut estimate = PoseEstimate::unknown(&view);
    estimate.state = TrackingState::Tracking;
    estimate.keyframe_id = 3;
    estimate.world_from_camera = world_from_camera;
    estimate.map_from_camera = world_from_camera;
    estimate.covariance = std::array::from_fn(|i| if i == 0 { 0.25 } else { 0.0 });
    estimate.map_covariance = estimate.covariance;
    let timing = PoseTiming { realtime_nanos: REALTIME + later, ..PoseTiming::default() };
    let message = pose_message(&estimate, &timing);
    Event::Pose(Box::new(Pose { message, estimate }))
}

pub fn keyframe(revision: u64) -> Event {
    let point = DepthPoint { u: 31, v: 23, inverse_depth: 0.5, variance: 0.0001, intensity: 99.0 };
    let mut keyframe = Keyframe::at(Sim3::identity(), CAMERA, vec![point; 500], pixels(0));
    keyframe.keyframe_id = 3;
    keyframe.revision = revision;
    keyframe.capture_nanos = CAPTURE;
    Event::Keyframe(Arc::new(keyframe))
}

pub fn graph() -> Event {
    let pose = KeyframePose { keyframe_id: 3, revision: 1, map_from_keyframe: Sim3::identity() };
    Event::Graph(Arc::new(Graph { header: GraphHeader::default(), poses: vec![pose; 2] }))
}

pub fn health(owner: &'static str) -> Event {
    let message = HealthMessage { process_id: 7, state: 3, frames: 90, ..HealthMessage::empty() };
    Event::Health(owner, Box::new(message))
}

/// A run of `num_frames` frames with every kind of event.
pub fn run(num_frames: u64) -> Vec<Event> {
    let mut events = vec![Event::Joined, keyframe(1), graph()];
    for sequence in 0..num_frames {
        events.extend([frame(sequence), pose(sequence)]);
        if sequence % 30 == 0 {
            events.extend(["capture", "tracker", "mapper"].map(health));
        }
    }
    events
}

/// A script next to the tests.
pub fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scripts").join(name)
}
