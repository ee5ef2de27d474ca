//! Reads one run of an instance: the ports, the loans from them, and the end of the run.

use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::time::{Duration, Instant};

use rustix::event::epoll;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create,
    timerfd_settime,
};
use semidense::service::health::ProcessState;
use semidense::service::peers::Peer;
use semidense::slam::keyframe::DepthPoint;
use semidense::wire::conversion::{
    check_points, frame_from_message, keyframe_pose_from_message, similarity_from_message,
};
use semidense::wire::message::{
    FrameHeader, GraphHeader, KeyframeHeader, KeyframeImageHeader, KeyframePoseMessage, PoseMessage,
};
use semidense::wire::place::Place;
use semidense::wire::port::{
    Access, Events, Hub, OpenError, ReceiveError, Received, Subscriber, wait,
};
use semidense::wire::topic::{FRAME, GRAPH, HEALTH_TOPICS, KEYFRAME, KEYFRAME_IMAGE, POSE};

use crate::conversion;
use crate::status::{Failure, Status};
use crate::types::{Frame, Graph, Keyframe, KeyframePose, Pose};

/// Silence after which an instance counts as gone: processes report once a second.
const LONGEST_SILENCE: Duration = Duration::from_secs(3);
/// Interval at which a descriptor becomes readable even without messages, so that the end of a run is noticed.
const HEARTBEAT: Duration = Duration::from_millis(500);
/// Pause between two attempts to join an instance that is not running yet.
const RETRY_PERIOD: Duration = Duration::from_millis(100);

/// The kinds of messages to read, as bits.
pub mod wants {
    /// Poses.
    pub const POSES: u32 = 1;
    /// Images of the camera.
    pub const FRAMES: u32 = 2;
    /// Keyframes.
    pub const KEYFRAMES: u32 = 4;
    /// Poses of all keyframes.
    pub const GRAPH: u32 = 8;
}

/// A reader of one run.
pub struct Reader {
    poses: Option<Subscriber<PoseMessage, ()>>,
    frames: Option<Subscriber<u8, FrameHeader>>,
    depths: Option<Subscriber<DepthPoint, KeyframeHeader>>,
    images: Option<Subscriber<u8, KeyframeImageHeader>>,
    graphs: Option<Subscriber<KeyframePoseMessage, GraphHeader>>,
    peers: Vec<Peer>,
    // Loans are released when they are replaced; a closed port keeps its loans alive.
    frame: Option<Received<u8, FrameHeader>>,
    depth: Option<Received<DepthPoint, KeyframeHeader>>,
    is_depth_new: bool,
    image: Option<Received<u8, KeyframeImageHeader>>,
    graph: Vec<KeyframePose>,
    waited: OwnedFd,
    heartbeat: OwnedFd,
    heard: Instant,
    last_health: i64,
    has_ended: bool,
    has_told_end: bool,
    /// Number of messages refused because they are malformed.
    pub refused: u64,
    _hub: Hub,
}

impl From<OpenError> for Failure {
    fn from(error: OpenError) -> Self {
        let status = match &error {
            OpenError::Version { .. } => Status::ErrorWireVersion,
            error if error.is_absence() => Status::ErrorNotRunning,
            _ => Status::ErrorTransport,
        };
        Self::new(status, error.to_string())
    }
}

impl From<ReceiveError> for Failure {
    fn from(error: ReceiveError) -> Self {
        transport(error)
    }
}

fn transport(error: impl std::fmt::Display) -> Failure {
    Failure::new(Status::ErrorTransport, error.to_string())
}

impl From<rustix::io::Errno> for Failure {
    fn from(error: rustix::io::Errno) -> Self {
        Self::new(Status::ErrorTransport, format!("waiting for messages failed ({error})"))
    }
}

/// Waits for the instance and joins it; without a `timeout`, indefinitely.
pub fn open(place: &Place, wanted: u32, timeout: Option<Duration>) -> Result<Reader, Failure> {
    let begun = Instant::now();
    loop {
        let failure = match Reader::join(place, wanted) {
            Ok(reader) => return Ok(reader),
            Err(failure) => failure,
        };
        let left = timeout.map(|timeout| timeout.saturating_sub(begun.elapsed()));
        if failure.status != Status::ErrorNotRunning || left.is_some_and(|left| left.is_zero()) {
            return Err(failure);
        }
        let pause = left.map_or(RETRY_PERIOD, |left| left.min(RETRY_PERIOD));
        wait(&[], None, pause).map_err(transport)?;
    }
}

impl Reader {
    fn join(place: &Place, wanted: u32) -> Result<Self, Failure> {
        let hub = Hub::join(place, "c-reader", Access::Observer)?;
        let is_wanted = |bit: u32| wanted & bit != 0;
        let poses = is_wanted(wants::POSES).then(|| hub.subscriber(&POSE)).transpose()?;
        let frames = is_wanted(wants::FRAMES).then(|| hub.subscriber(&FRAME)).transpose()?;
        let depths = is_wanted(wants::KEYFRAMES).then(|| hub.subscriber(&KEYFRAME)).transpose()?;
        let images =
            is_wanted(wants::KEYFRAMES).then(|| hub.subscriber(&KEYFRAME_IMAGE)).transpose()?;
        let graphs = is_wanted(wants::GRAPH).then(|| hub.subscriber(&GRAPH)).transpose()?;
        let peers: Result<Vec<_>, _> =
            HEALTH_TOPICS.iter().map(|topic| Peer::open(&hub, topic)).collect();
        let reader = Self {
            poses,
            frames,
            depths,
            images,
            graphs,
            peers: peers?,
            frame: None,
            depth: None,
            is_depth_new: false,
            image: None,
            graph: Vec::new(),
            waited: epoll::create(epoll::CreateFlags::CLOEXEC)?,
            heartbeat: heartbeat()?,
            heard: Instant::now(),
            last_health: i64::MIN,
            has_ended: false,
            has_told_end: false,
            refused: 0,
            _hub: hub,
        };
        for descriptor in reader.events().map(Events::as_fd).chain([reader.heartbeat.as_fd()]) {
            let data = epoll::EventData::new_u64(0);
            epoll::add(&reader.waited, descriptor, data, epoll::EventFlags::IN)?;
        }
        Ok(reader)
    }

    fn events(&self) -> impl Iterator<Item = &Events> {
        [
            self.poses.as_ref().map(Subscriber::events),
            self.frames.as_ref().map(Subscriber::events),
            self.depths.as_ref().map(Subscriber::events),
            self.graphs.as_ref().map(Subscriber::events),
        ]
        .into_iter()
        .flatten()
    }

    /// A descriptor that is readable when `wait` should be called.
    pub fn descriptor(&self) -> RawFd {
        self.waited.as_raw_fd()
    }

    /// Waits until there may be something to read, and consumes the wake-ups.
    pub fn wait(&mut self, timeout: Option<Duration>) -> Result<Status, Failure> {
        let begun = Instant::now();
        loop {
            if self.has_told_end {
                return Ok(Status::Ended);
            }
            let left = timeout.map(|timeout| timeout.saturating_sub(begun.elapsed()));
            // The common descriptor and the heartbeat wake it in time for the end of the run.
            let step = left.map_or(HEARTBEAT, |left| left.min(HEARTBEAT));
            wait(&[], [self.waited.as_fd()], step).map_err(transport)?;
            let has_woken = self.take_wakes()?;
            if self.is_over()? {
                // Once more, for messages that arrived before the end.
                self.has_told_end = true;
                return Ok(Status::Ok);
            }
            if has_woken {
                return Ok(Status::Ok);
            }
            if left.is_some_and(|left| left <= step) {
                return Ok(Status::None);
            }
        }
    }

    /// Whether a topic has woken the reader.
    fn take_wakes(&self) -> Result<bool, Failure> {
        // Each of them, whichever has woken.
        let woken = self.events().filter(|events| events.take()).count() > 0;
        if is_readable(self.heartbeat.as_fd()) {
            let mut count = [0; 8];
            // The number of missed beats does not matter.
            let _ = rustix::io::read(&self.heartbeat, &mut count);
        }
        Ok(woken)
    }

    /// Whether tracker and mapper have finished, or no process has reported for too long.
    fn is_over(&mut self) -> Result<bool, Failure> {
        let mut newest = self.last_health;
        let mut finished = 0;
        for peer in &mut self.peers {
            if let Some(health) = peer.update()? {
                newest = newest.max(health.published_nanos);
            }
            let is_finished = peer.state() == Some(ProcessState::Finished);
            finished += usize::from(is_finished && peer.name() != "capture");
        }
        if newest > self.last_health {
            self.last_health = newest;
            self.heard = Instant::now();
        }
        self.has_ended |= finished == 2 || self.heard.elapsed() > LONGEST_SILENCE;
        Ok(self.has_ended)
    }

    /// The status without a message.
    pub fn empty_status(&self) -> Status {
        if self.has_ended { Status::Ended } else { Status::None }
    }

    /// The oldest unread pose.
    pub fn next_pose(&mut self) -> Result<Option<Pose>, Failure> {
        let port = self.poses.as_ref().ok_or_else(|| not_wanted("POSES"))?;
        while let Some(message) = port.receive()? {
            for message in message.payload() {
                match conversion::pose(message) {
                    Ok(pose) => return Ok(Some(pose)),
                    Err(_) => self.refused += 1,
                }
            }
        }
        Ok(None)
    }

    /// The newest frame, if unread.
    pub fn newest_frame(&mut self) -> Result<Option<Frame>, Failure> {
        let port = self.frames.as_ref().ok_or_else(|| not_wanted("FRAMES"))?;
        self.frame = None;
        let Some(received) = port.newest()? else { return Ok(None) };
        let header = *received.header();
        let Ok((view, intrinsics)) = frame_from_message(&header, received.payload()) else {
            self.refused += 1;
            return Ok(None);
        };
        let frame = Frame {
            sequence: header.sequence,
            capture_nanos: header.capture_nanos,
            realtime_nanos: header.realtime_nanos,
            exposure_nanos: header.exposure_nanos,
            gain: header.gain,
            width: header.width,
            height: header.height,
            intrinsics: conversion::intrinsics(&intrinsics),
            pixels: view.pixels.as_ptr(),
        };
        self.frame = Some(received);
        Ok(Some(frame))
    }

    /// The newest keyframe, if unread.
    pub fn newest_keyframe(&mut self) -> Result<Option<Keyframe>, Failure> {
        let none = || not_wanted("KEYFRAMES");
        let depths = self.depths.as_ref().ok_or_else(none)?;
        let images = self.images.as_ref().ok_or_else(none)?;
        // Depth first: the mapper sends the image before it, so the image of a received depth is here. The old loan is
        // released first: there is room for one. An image serves every revision of its keyframe's depth.
        if !self.is_depth_new || depths.has_unread()? {
            self.depth = None;
            self.depth = depths.receive()?;
            self.is_depth_new = self.depth.is_some();
        }
        if images.has_unread()? {
            self.image = None;
            self.image = images.receive()?;
        }
        let (Some(depth), Some(image)) = (&self.depth, &self.image) else {
            return Ok(None);
        };
        let ids = (depth.header().keyframe_id, depth.header().epoch);
        if ids != (image.header().keyframe_id, image.header().epoch) {
            // The other half is in transit.
            return Ok(None);
        }
        self.is_depth_new = false;
        let keyframe = whole_keyframe(depth, image);
        self.refused += u64::from(keyframe.is_none());
        Ok(keyframe)
    }

    /// The newest graph, if unread.
    pub fn newest_graph(&mut self) -> Result<Option<Graph>, Failure> {
        let port = self.graphs.as_ref().ok_or_else(|| not_wanted("GRAPH"))?;
        let Some(received) = port.receive()? else { return Ok(None) };
        let header = *received.header();
        let poses: Result<Vec<_>, _> =
            received.payload().iter().map(keyframe_pose_from_message).collect();
        let Ok(poses) = poses else {
            self.refused += 1;
            return Ok(None);
        };
        self.graph = poses.iter().map(conversion::keyframe_pose).collect();
        Ok(Some(Graph {
            revision: header.revision,
            map_revision: header.map_revision,
            epoch: header.epoch,
            num_keyframes: self.graph.len() as u32,
            keyframes: self.graph.as_ptr(),
        }))
    }
}

fn not_wanted(kind: &str) -> Failure {
    let text = format!("the reader was not opened for these: open it with SEMIDENSE_WANT_{kind}");
    Failure::new(Status::ErrorNotWanted, text)
}

/// A keyframe from its two halves, with every point checked.
fn whole_keyframe(
    depth: &Received<DepthPoint, KeyframeHeader>,
    image: &Received<u8, KeyframeImageHeader>,
) -> Option<Keyframe> {
    let (header, image_header) = (depth.header(), image.header());
    // Size, stride and intrinsics are checked like those of a frame of this size.
    let as_frame = FrameHeader {
        width: image_header.width,
        height: image_header.height,
        stride: image_header.stride,
        intrinsics: header.intrinsics,
        ..FrameHeader::default()
    };
    let (view, intrinsics) = frame_from_message(&as_frame, image.payload()).ok()?;
    if (header.width, header.height) != (image_header.width, image_header.height) {
        return None;
    }
    check_points(depth.payload(), &intrinsics).ok()?;
    let place = |message, field| similarity_from_message(message, field).ok();
    let world = place(&header.world_from_keyframe, "world_from_keyframe")?;
    let map = place(&header.map_from_keyframe, "map_from_keyframe")?;
    Some(Keyframe {
        keyframe_id: header.keyframe_id,
        revision: header.revision,
        sequence: header.sequence,
        capture_nanos: header.capture_nanos,
        map_revision: header.map_revision,
        epoch: header.epoch,
        width: header.width,
        height: header.height,
        num_points: depth.payload().len() as u32,
        intrinsics: conversion::intrinsics(&intrinsics),
        world_from_keyframe: conversion::similarity(&world),
        map_from_keyframe: conversion::similarity(&map),
        points: conversion::points(depth.payload()),
        image: view.pixels.as_ptr(),
    })
}

/// A timer that becomes readable every [`HEARTBEAT`].
fn heartbeat() -> Result<OwnedFd, Failure> {
    let flags = TimerfdFlags::CLOEXEC | TimerfdFlags::NONBLOCK;
    let timer = timerfd_create(TimerfdClockId::Monotonic, flags)?;
    let period = Timespec { tv_sec: 0, tv_nsec: HEARTBEAT.subsec_nanos().into() };
    let periods = Itimerspec { it_interval: period, it_value: period };
    timerfd_settime(&timer, TimerfdTimerFlags::empty(), &periods)?;
    Ok(timer)
}

fn is_readable(descriptor: BorrowedFd<'_>) -> bool {
    let mut polled =
        [rustix::event::PollFd::from_borrowed_fd(descriptor, rustix::event::PollFlags::IN)];
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    rustix::event::poll(&mut polled, Some(&now)).is_ok_and(|ready| ready > 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use semidense::slam::frame::FrameView;
    use semidense::slam::pose::PoseEstimate;
    use semidense::wire::conversion::{PoseTiming, pose_message};
    use semidense::wire::port::Publisher;

    #[test]
    fn a_wait_consumes_the_wakes_of_all_topics_and_of_no_other_reader() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let hub = Hub::join(&place, "tracker", Access::Member).unwrap();
        let poses: Publisher<PoseMessage, ()> = hub.publisher(&POSE, 1).unwrap();
        let frames: Publisher<u8, FrameHeader> = hub.publisher(&FRAME, 1).unwrap();
        let health = HEALTH_TOPICS.map(|topic| Peer::open(&hub, &topic).unwrap());
        let wanted = wants::POSES | wants::FRAMES;
        let [mut first, second] = [(); 2].map(|()| Reader::join(&place, wanted).unwrap());
        let num_awake =
            |reader: &Reader| reader.events().filter(|events| is_readable(events.as_fd())).count();
        let (width, height, pixels) = (1, 1, &[0][..]);
        let (sequence, capture_nanos, exposure_nanos) = (0, 0, 0);
        let view = FrameView { sequence, capture_nanos, exposure_nanos, width, height, pixels };
        let pose = pose_message(&PoseEstimate::unknown(&view), &PoseTiming::default());
        poses.send((), &[pose]).unwrap();
        frames.send(FrameHeader::default(), pixels).unwrap();
        assert_eq!((num_awake(&first), num_awake(&second)), (2, 2));
        assert!(first.wait(Some(Duration::from_secs(10))).is_ok_and(|status| status == Status::Ok));
        assert_eq!((num_awake(&first), num_awake(&second)), (0, 2));
        drop((first, second, poses, frames, health, hub));
        place.tidy();
    }
}
