//! Reads the topics of an instance whenever it runs: waits for it, notices its end, and joins the next one.
//!
//! ```no_run
//! use std::time::Duration;
//!
//! use semidense::reader::{Event, Place, Session, Wants};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let place = Place::new("semidense", "")?;
//! let mut session = Session::new(place, "my_robot", Wants { keyframes: true, ..Wants::default() });
//! loop {
//!     session.read(None, Duration::from_secs(1), |event| match event {
//!         Event::Pose(pose) => println!("{:?} {}", pose.estimate.state, pose.estimate.world_from_camera.translation),
//!         Event::Keyframe(keyframe) => println!("{} points", keyframe.points.len()),
//!         _ => {}
//!     })?;
//! }
//! # }
//! ```
//!
//! Messages are checked on arrival; invalid ones are counted and left out. A [`Session`] stays on the thread that
//! opened it; its events own their data and may be sent to other threads. To read the bytes in place, without a copy,
//! open single topics with [`crate::wire::port::Hub`].

use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::service::health::ProcessState;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{Keyframe, KeyframePose};
use crate::slam::pose::PoseEstimate;
use crate::wire::conversion::{frame_from_message, keyframe_pose_from_message, pose_from_message};
use crate::wire::keyframe_inbox::{InboxError, KeyframeInbox};
use crate::wire::message::{
    AdjustmentMessage, FrameHeader, GraphHeader, HealthMessage, KeyframePoseMessage, PoseMessage,
};
pub use crate::wire::place::Place;
use crate::wire::port::{
    Access, Events, Hub, OpenError, ReceiveError, Subscriber, WaitError, wait,
};
use crate::wire::topic::{ADJUSTMENT, FRAME, GRAPH, HEALTH_TOPICS, POSE};

/// Silence after which an instance counts as gone: processes report once a second.
const LONGEST_SILENCE: Duration = Duration::from_secs(3);
/// Time between two attempts to join an instance that does not run yet.
const RETRY_PERIOD: Duration = Duration::from_millis(250);

/// Attempts that a topic may prevent while it is created or removed, without being reported: a second.
const TRANSIENT_ATTEMPTS: u32 = 4;

/// Topics to read besides poses and health.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Wants {
    /// Images of the camera; the newest wins where they are not received in time.
    pub frames: bool,
    /// Keyframes: image and depth of the active one, and each revision of its depth.
    pub keyframes: bool,
    /// Poses of all keyframes in the map.
    pub graph: bool,
    /// Joint estimates.
    pub adjustments: bool,
}

/// An image of the camera.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Its header.
    pub header: FrameHeader,
    /// Intrinsics of the image.
    pub intrinsics: Intrinsics,
    /// Rectified grey image, `width * height` bytes.
    pub pixels: Arc<[u8]>,
}

/// A pose, checked, with its message.
#[derive(Debug, Clone, Copy)]
pub struct Pose {
    /// The message as sent: stamps and timing.
    pub message: PoseMessage,
    /// The pose in it.
    pub estimate: PoseEstimate,
}

/// Poses of all keyframes in the map.
#[derive(Debug, Clone)]
pub struct Graph {
    /// Epoch and revision.
    pub header: GraphHeader,
    /// One per keyframe.
    pub poses: Vec<KeyframePose>,
}

/// An event from shared memory.
#[derive(Debug, Clone)]
pub enum Event {
    /// An instance was joined, and its first messages follow: earlier events belong to another run.
    Joined,
    /// The instance is gone; the session waits for the next one.
    Left,
    /// An image.
    Frame(Arc<Frame>),
    /// A pose.
    Pose(Box<Pose>),
    /// A keyframe, or a new revision of its depth.
    Keyframe(Arc<Keyframe>),
    /// The map's graph.
    Graph(Arc<Graph>),
    /// Health of the process with this name: capture, tracker or mapper.
    Health(&'static str, Box<HealthMessage>),
    /// A joint estimate of keyframes.
    Adjustment(AdjustmentMessage),
}

/// Why reading failed.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The instance cannot be joined, and waiting will not help.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// Waiting failed.
    #[error(transparent)]
    Wait(#[from] WaitError),
}

/// The topics of one instance.
#[derive(Debug)]
pub struct Session {
    place: Place,
    name: String,
    wants: Wants,
    ports: Option<Ports>,
    /// Whether a message has arrived at these ports: topics alone may be those of other readers.
    is_joined: bool,
    tried: Option<Instant>,
    heard: Instant,
    refused: u64,
    /// Why an instance that runs cannot be joined, and how many attempts in a row that reason has prevented.
    obstacle: Option<(String, u32)>,
}

impl Session {
    /// A session with the instance at `place` under the process name `name`; joins it once it runs.
    pub fn new(place: Place, name: &str, wants: Wants) -> Self {
        Self {
            place,
            name: name.to_owned(),
            wants,
            ports: None,
            is_joined: false,
            tried: None,
            heard: Instant::now(),
            refused: 0,
            obstacle: None,
        }
    }

    /// As [`Self::new`], but returns an error where the instance does not run now.
    pub fn join(place: Place, name: &str, wants: Wants) -> Result<Self, OpenError> {
        let ports = Ports::open(&place, name, wants)?;
        let mut session = Self::new(place, name, wants);
        (session.ports, session.is_joined) = (Some(ports), true);
        Ok(session)
    }

    /// Whether an instance is joined.
    pub fn is_joined(&self) -> bool {
        self.is_joined
    }

    /// Why an instance that runs cannot be joined, e.g. as a topic has no place for another reader; it is tried again.
    pub fn obstacle(&self) -> Option<&str> {
        let lasting = self.obstacle.as_ref().filter(|(_, times)| *times >= TRANSIENT_ATTEMPTS);
        lasting.map(|(reason, _)| reason.as_str())
    }

    /// Invalid messages that were left out.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Waits for messages until `interrupt` is readable or `timeout` has passed, and passes those that arrived to
    /// `take`, in the order of each topic. An error is final.
    pub fn read(
        &mut self,
        interrupt: Option<BorrowedFd<'_>>,
        timeout: Duration,
        mut take: impl FnMut(Event),
    ) -> Result<(), SessionError> {
        if self.ports.is_none() {
            self.try_to_join()?;
        }
        let Some(ports) = &mut self.ports else {
            return Ok(wait(&[], interrupt, timeout.min(RETRY_PERIOD))?);
        };
        wait(&ports.events(), interrupt, timeout)?;
        // The first messages may be the last of a run that is over.
        let mut first = Vec::new();
        let mut num_taken = 0_usize;
        let outcome = ports.take_all(&mut self.refused, &mut |event| {
            num_taken += 1;
            match self.is_joined {
                true => take(event),
                false => first.push(event),
            }
        });
        let is_over = outcome.is_err() || ports.is_over();
        if num_taken > 0 {
            self.heard = Instant::now();
        }
        if !(first.is_empty() || is_over) {
            self.is_joined = true;
            std::iter::once(Event::Joined).chain(first).for_each(&mut take);
        }
        if is_over || self.heard.elapsed() > LONGEST_SILENCE {
            // Where the next run has begun it is joined at once.
            self.tried = (!ports.is_next_heard()).then(Instant::now);
            self.ports = None;
            if std::mem::take(&mut self.is_joined) {
                take(Event::Left);
            }
        }
        Ok(())
    }

    /// Retries an instance that is absent or only starting; one of another version never fits.
    fn try_to_join(&mut self) -> Result<(), SessionError> {
        if self.tried.is_some_and(|tried| tried.elapsed() < RETRY_PERIOD) {
            return Ok(());
        }
        self.tried = Some(Instant::now());
        match Ports::open(&self.place, &self.name, self.wants) {
            Ok(ports) => {
                (self.ports, self.heard, self.obstacle) = (Some(ports), Instant::now(), None);
            }
            Err(error @ OpenError::Version { .. }) => return Err(error.into()),
            Err(error) if error.is_absence() => {
                tracing::debug!("{error}");
                self.obstacle = None;
            }
            Err(error) => {
                let reason = error.to_string();
                let before = self.obstacle.take().filter(|(known, _)| *known == reason);
                let times = before.map_or(0, |(_, times)| times).saturating_add(1);
                if times == TRANSIENT_ATTEMPTS {
                    tracing::warn!("{reason}");
                }
                self.obstacle = Some((reason, times));
            }
        }
        Ok(())
    }
}

/// The open topics; the hub is dropped last.
#[derive(Debug)]
struct Ports {
    /// Whether the last report of each process is that it has finished, in the order of `health`.
    has_finished: [bool; HEALTH_TOPICS.len()],
    /// The same of any report that was taken last: those of the next run may follow.
    has_finished_before: [bool; HEALTH_TOPICS.len()],
    poses: Subscriber<PoseMessage, ()>,
    health: Vec<(&'static str, Subscriber<HealthMessage, ()>)>,
    frames: Option<Subscriber<u8, FrameHeader>>,
    keyframes: Option<KeyframeInbox>,
    graph: Option<Subscriber<KeyframePoseMessage, GraphHeader>>,
    adjustments: Option<Subscriber<AdjustmentMessage, ()>>,
    _hub: Hub,
}

impl Ports {
    fn open(place: &Place, name: &str, wants: Wants) -> Result<Self, OpenError> {
        let hub = Hub::join(place, name, Access::Observer)?;
        let health: Result<Vec<_>, _> = HEALTH_TOPICS
            .iter()
            .map(|topic| hub.subscriber(topic).map(|port| (topic.owner, port)))
            .collect();
        Ok(Self {
            has_finished: Default::default(),
            has_finished_before: Default::default(),
            poses: hub.subscriber(&POSE)?,
            health: health?,
            frames: wants.frames.then(|| hub.subscriber(&FRAME)).transpose()?,
            keyframes: wants.keyframes.then(|| KeyframeInbox::open(&hub)).transpose()?,
            graph: wants.graph.then(|| hub.subscriber(&GRAPH)).transpose()?,
            adjustments: wants.adjustments.then(|| hub.subscriber(&ADJUSTMENT)).transpose()?,
            _hub: hub,
        })
    }

    /// Events that wake a wait: poses and, if read, frames and keyframes. The rest is read along, or once a second.
    fn events(&self) -> Vec<&Events> {
        let frames = self.frames.as_ref().map(Subscriber::events);
        let keyframes = self.keyframes.as_ref().map(KeyframeInbox::events);
        [Some(self.poses.events()), frames, keyframes].into_iter().flatten().collect()
    }

    /// Whether tracker and mapper have finished: their last messages have arrived.
    fn is_over(&self) -> bool {
        let ends = self.has_finished.iter().zip(self.has_finished_before);
        ends.skip(1).all(|(now, before)| *now || before)
    }

    /// Whether the run is over and a process of the next one has reported.
    fn is_next_heard(&self) -> bool {
        self.is_over() && self.has_finished[1..].contains(&false)
    }

    /// Keyframes before poses: a pose names its keyframe.
    fn take_all(
        &mut self,
        refused: &mut u64,
        take: &mut dyn FnMut(Event),
    ) -> Result<(), ReceiveError> {
        self.has_finished_before = Default::default();
        for (place, (owner, port)) in self.health.iter().enumerate() {
            while let Some(message) = port.receive()? {
                for health in message.payload() {
                    let has_finished = health.state == ProcessState::Finished.code();
                    self.has_finished[place] = has_finished;
                    self.has_finished_before[place] |= has_finished;
                    take(Event::Health(owner, Box::new(*health)));
                }
            }
        }
        if let Some(inbox) = &mut self.keyframes {
            match inbox.newest() {
                Ok(Some(keyframe)) => take(Event::Keyframe(Arc::new(keyframe))),
                Ok(None) => {}
                Err(InboxError::Message(_)) => *refused += 1,
                Err(InboxError::Receive(error)) => return Err(error),
            }
        }
        if let Some(newest) = self.graph.as_ref().map(Subscriber::newest).transpose()?.flatten() {
            let poses: Result<Vec<_>, _> =
                newest.payload().iter().map(keyframe_pose_from_message).collect();
            match poses {
                Ok(poses) => {
                    take(Event::Graph(Arc::new(Graph { header: *newest.header(), poses })))
                }
                Err(_) => *refused += 1,
            }
        }
        if let Some(port) = &self.frames {
            while let Some(message) = port.receive()? {
                match frame_from_message(message.header(), message.payload()) {
                    Ok((FrameView { pixels, .. }, intrinsics)) => {
                        let (header, pixels) = (*message.header(), Arc::from(pixels));
                        take(Event::Frame(Arc::new(Frame { header, intrinsics, pixels })));
                    }
                    Err(_) => *refused += 1,
                }
            }
        }
        while let Some(message) = self.poses.receive()? {
            for message in message.payload() {
                match pose_from_message(message) {
                    Ok(estimate) => {
                        take(Event::Pose(Box::new(Pose { message: *message, estimate })))
                    }
                    Err(_) => *refused += 1,
                }
            }
        }
        if let Some(port) = &self.adjustments {
            while let Some(message) = port.receive()? {
                message.payload().iter().for_each(|m| take(Event::Adjustment(*m)));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
