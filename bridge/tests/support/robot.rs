//! An instance without a camera: it publishes what a pipeline publishes, with content known to the test.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use semidense::service::clock::now_nanos;
use semidense::slam::keyframe::DepthPoint;
use semidense::wire::command::text_bytes;
use semidense::wire::message::{
    AdjustmentMessage, FrameHeader, GraphHeader, HealthMessage, KeyframeHeader,
    KeyframeImageHeader, KeyframePoseMessage, PoseMessage,
};
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, Publisher};
use semidense::wire::topic::{
    ADJUSTMENT, CAPTURE_HEALTH, FRAME, GRAPH, KEYFRAME, KEYFRAME_IMAGE, MAPPER_HEALTH, POSE,
    TRACKER_HEALTH,
};
use zerocopy::FromZeros;

/// Size of its images.
pub const SIZE: [usize; 2] = [320, 240];
/// Period of 30 frames a second.
const PERIOD: Duration = Duration::from_nanos(33_333_333);
/// Points of its keyframe: 960 kB as a ROS cloud.
pub const POINTS: usize = 48_000;
/// Poses in its graph.
const KEYFRAMES: usize = 50;
/// No rotation, no translation, scale 1.
const IDENTITY: [f64; 8] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];

/// Messages sent so far.
#[derive(Default)]
pub struct Sent {
    /// By sequence, with the time of sending.
    pub poses: BTreeMap<u64, (PoseMessage, i64)>,
    /// By sequence.
    pub frames: BTreeMap<u64, FrameHeader>,
}

/// A robot that runs on a separate thread until it is dropped.
pub struct Robot {
    sent: Arc<Mutex<Sent>>,
    shall_end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Robot {
    /// Publishes at `place`; `number` distinguishes its messages from those of other robots.
    pub fn start(place: &Place, number: u64) -> Self {
        let sent = Arc::<Mutex<Sent>>::default();
        let shall_end = Arc::<AtomicBool>::default();
        let (place, log, end) = (place.clone(), Arc::clone(&sent), Arc::clone(&shall_end));
        let thread = std::thread::spawn(move || run(&place, number, &log, &end));
        Self { sent, shall_end, thread: Some(thread) }
    }

    /// Inspects the messages sent so far.
    pub fn sent<T>(&self, look: impl FnOnce(&Sent) -> T) -> T {
        look(&self.sent.lock().unwrap())
    }

    /// Sequence of the last pose.
    pub fn last_sequence(&self) -> u64 {
        self.sent(|sent| sent.poses.keys().next_back().copied().unwrap_or(0))
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        self.shall_end.store(true, Ordering::Release);
        // A panic of the thread shows in its output.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn run(place: &Place, number: u64, log: &Mutex<Sent>, end: &AtomicBool) {
    let hub = Hub::join(place, "robot", Access::Member).unwrap();
    let pixels = SIZE[0] * SIZE[1];
    let poses: Publisher<PoseMessage, ()> = hub.publisher(&POSE, 1).unwrap();
    let frames: Publisher<u8, FrameHeader> = hub.publisher(&FRAME, pixels).unwrap();
    let depths: Publisher<DepthPoint, KeyframeHeader> = hub.publisher(&KEYFRAME, POINTS).unwrap();
    let images: Publisher<u8, KeyframeImageHeader> =
        hub.publisher(&KEYFRAME_IMAGE, pixels).unwrap();
    let graphs: Publisher<KeyframePoseMessage, GraphHeader> =
        hub.publisher(&GRAPH, KEYFRAMES).unwrap();
    let health: Vec<Publisher<HealthMessage, ()>> = [CAPTURE_HEALTH, TRACKER_HEALTH, MAPPER_HEALTH]
        .iter()
        .map(|topic| hub.publisher(topic, 1).unwrap())
        .collect();
    // Subscribers open this topic although nothing is sent on it.
    let _adjustments: Publisher<AdjustmentMessage, ()> = hub.publisher(&ADJUSTMENT, 1).unwrap();
    images.send(keyframe_image_header(number), &image(number)).unwrap();
    depths.send(keyframe_header(number), &points(number)).unwrap();
    graphs.send(GraphHeader { revision: 3, ..GraphHeader::default() }, &graph(number)).unwrap();
    for sequence in 1.. {
        if end.load(Ordering::Acquire) {
            return;
        }
        let now = now_nanos();
        let (pose, frame) = (pose(number, sequence, now), frame_header(sequence, now));
        {
            let mut log = log.lock().unwrap();
            log.poses.insert(sequence, (pose, now));
            log.frames.insert(sequence, frame);
        }
        frames.send(frame, &image(sequence)).unwrap();
        poses.send((), &[pose]).unwrap();
        if sequence % 30 == 1 {
            health.iter().for_each(|port| port.send((), &[health_message(sequence, now)]).unwrap());
        }
        images.serve_late_joiners();
        depths.serve_late_joiners();
        graphs.serve_late_joiners();
        health.iter().for_each(Publisher::serve_late_joiners);
        std::thread::sleep(PERIOD);
    }
}

/// Pseudo-random numbers: the same for the same `seed`.
fn noise(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1_u64 << 53) as f64
    }
}

fn pose(number: u64, sequence: u64, now: i64) -> PoseMessage {
    let mut next = noise(number << 32 | sequence);
    let mut message = PoseMessage::new_zeroed();
    message.sequence = sequence;
    message.capture_nanos = sequence as i64 * 33_333_333;
    message.published_nanos = now;
    message.latency_nanos = 4_000_000 + sequence;
    message.keyframe_id = number;
    message.state = 1;
    let mut place = || [0.0, 0.0, 0.0, 1.0, next(), next(), next()];
    message.world_from_camera = place();
    message.map_from_camera = place();
    message.keyframe_from_camera = place();
    for entry in message
        .covariance
        .iter_mut()
        .chain(&mut message.map_covariance)
        .chain(&mut message.alignment_covariance)
    {
        *entry = next();
    }
    message.inlier_ratio = next();
    message.has_velocity = 1;
    message.linear_velocity = [next(), next(), next()];
    message.angular_velocity = [next(), next(), next()];
    message.velocity_covariance.iter_mut().for_each(|entry| *entry = next());
    message.points = sequence as u32;
    message
}

fn frame_header(sequence: u64, now: i64) -> FrameHeader {
    let (width, height) = (SIZE[0] as u32, SIZE[1] as u32);
    FrameHeader {
        sequence,
        capture_nanos: sequence as i64 * 33_333_333,
        clock_nanos: now,
        sent_nanos: now,
        intrinsics: [300.0, 300.0, 159.5, 119.5],
        width,
        height,
        stride: width,
        ..FrameHeader::default()
    }
}

/// A smooth image, which suits JPEG.
pub fn image(number: u64) -> Vec<u8> {
    let [width, height] = SIZE;
    let pixel = |i: usize| ((i % width) / 2 + (i / width) / 3 + number as usize % 16) as u8;
    (0..width * height).map(pixel).collect()
}

pub fn keyframe_header(number: u64) -> KeyframeHeader {
    KeyframeHeader {
        keyframe_id: number,
        revision: 3,
        world_from_keyframe: IDENTITY,
        map_from_keyframe: IDENTITY,
        intrinsics: [300.0, 300.0, 159.5, 119.5],
        map_state: 1,
        width: SIZE[0] as u32,
        height: SIZE[1] as u32,
        ..KeyframeHeader::default()
    }
}

fn keyframe_image_header(number: u64) -> KeyframeImageHeader {
    let (width, height) = (SIZE[0] as u32, SIZE[1] as u32);
    KeyframeImageHeader { keyframe_id: number, epoch: 0, width, height, stride: width }
}

pub fn points(number: u64) -> Vec<DepthPoint> {
    let mut next = noise(number);
    let point = |i: usize| DepthPoint {
        u: (i % SIZE[0]) as u16,
        v: (i / SIZE[0]) as u16,
        inverse_depth: next() as f32,
        variance: next() as f32 * 1e-3,
        intensity: (i % 256) as f32,
    };
    (0..POINTS).map(point).collect()
}

pub fn graph(number: u64) -> Vec<KeyframePoseMessage> {
    let mut next = noise(number);
    let pose = |id: usize| {
        let mut map_from_keyframe = IDENTITY;
        map_from_keyframe[4] = next();
        KeyframePoseMessage { keyframe_id: id as u64, revision: 2, map_from_keyframe }
    };
    (0..KEYFRAMES).map(pose).collect()
}

fn health_message(frames: u64, now: i64) -> HealthMessage {
    let mut message = HealthMessage::new_zeroed();
    (message.published_nanos, message.started_nanos) = (now, now);
    (message.state, message.frames, message.process_id) = (3, frames, 1);
    (message.cause, message.cause_bytes) = text_bytes("tracking");
    message
}
