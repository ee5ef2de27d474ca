//! The instance at the receiving end: the robot's topics in shared memory, under an instance name of this machine.
//!
//! The names of its processes are claimed, so that neither a second receiver nor a pipeline of this machine
//! can publish on the same topics.

use semidense::service::clock::now_nanos;
use semidense::service::health::ProcessState;
use semidense::slam::keyframe::{DepthPoint, MAX_KEYFRAME_POINTS};
use semidense::wire::command::text_bytes;
use semidense::wire::message::{
    AdjustmentMessage, FrameHeader, GraphHeader, HealthMessage, KeyframeHeader,
    KeyframeImageHeader, KeyframePoseMessage, PoseMessage,
};
use semidense::wire::place::{Claim, Place};
use semidense::wire::port::{Access, Hub, Publisher};
use semidense::wire::topic::{
    ADJUSTMENT, FRAME, GRAPH, HEALTH_TOPICS, KEYFRAME, KEYFRAME_IMAGE, MAX_GRAPH_KEYFRAMES, POSE,
};
use zerocopy::FromZeros;

use crate::zenoh::error::ZenohError;
use crate::zenoh::kind::Kind;
use crate::zenoh::unpack::Arrival;

/// Period of reports during a silence, nanoseconds: that of the processes' reports.
const REPORT_PERIOD_NANOS: i64 = 1_000_000_000;
/// How long a finished process stays finished, nanoseconds: readers that are there learn of the end of the run within a
/// second, and those that come later are to wait for the next run.
const END_PERIOD_NANOS: i64 = 3_000_000_000;
/// Name that the supervisor of a run claims.
const SUPERVISOR: &str = "supervisor";

/// The topics of the mirrored instance.
pub struct Mirror {
    poses: Publisher<PoseMessage, ()>,
    adjustments: Publisher<AdjustmentMessage, ()>,
    graphs: Publisher<KeyframePoseMessage, GraphHeader>,
    keyframes: Publisher<DepthPoint, KeyframeHeader>,
    /// Publishers with their capacity in pixels.
    images: (usize, Publisher<u8, KeyframeImageHeader>),
    frames: (usize, Publisher<u8, FrameHeader>),
    health: [Reported; 3],
    /// Whether anything but health was published since the last run was over.
    has_content: bool,
    hub: Hub,
    _claims: Vec<Claim>,
}

/// The health of one process.
struct Reported {
    publisher: Publisher<HealthMessage, ()>,
    /// The last report, with stamps of this machine.
    last: HealthMessage,
    /// CLOCK_MONOTONIC of its publication here.
    told_nanos: i64,
    /// CLOCK_MONOTONIC of its arrival.
    heard_nanos: i64,
    is_silent: bool,
}

impl Mirror {
    /// Claims the names of the processes and opens the topics.
    pub fn open(place: &Place) -> Result<Self, ZenohError> {
        let names = HEALTH_TOPICS.iter().map(|topic| topic.owner);
        let claims: Result<Vec<Claim>, _> =
            std::iter::once(SUPERVISOR).chain(names).map(|name| place.claim(name)).collect();
        let claims = claims?;
        let hub = Hub::join(place, "zenoh-receive", Access::Member)?;
        let reported = |place: usize| -> Result<Reported, ZenohError> {
            Ok(Reported {
                publisher: hub.publisher(&HEALTH_TOPICS[place], 1)?,
                last: HealthMessage::new_zeroed(),
                told_nanos: i64::MIN,
                heard_nanos: i64::MIN,
                is_silent: false,
            })
        };
        let mirror = Self {
            poses: hub.publisher(&POSE, 1)?,
            adjustments: hub.publisher(&ADJUSTMENT, 1)?,
            graphs: hub.publisher(&GRAPH, MAX_GRAPH_KEYFRAMES)?,
            keyframes: hub.publisher(&KEYFRAME, MAX_KEYFRAME_POINTS)?,
            // Subscribers find the topics at once; their size is known with the first image.
            images: (1, hub.publisher(&KEYFRAME_IMAGE, 1)?),
            frames: (1, hub.publisher(&FRAME, 1)?),
            health: [reported(0)?, reported(1)?, reported(2)?],
            has_content: false,
            hub,
            _claims: claims,
        };
        mirror.hub.reserve()?;
        Ok(mirror)
    }

    /// Publishes an arrival, whose stamps are already those of this machine.
    pub fn publish(&mut self, arrival: &Arrival) -> Result<(), ZenohError> {
        self.has_content |= !matches!(arrival, Arrival::Health(..) | Arrival::Presence(_));
        match arrival {
            Arrival::Pose(message) => self.poses.send((), &[**message])?,
            Arrival::Health(kind, message) => self.publish_health(*kind, message)?,
            Arrival::Adjustment(message) => self.adjustments.send((), &[*message])?,
            Arrival::Graph(header, poses) => self.graphs.send(*header, poses)?,
            Arrival::Keyframe(header, points) => self.keyframes.send(**header, points)?,
            Arrival::KeyframeImage(header, pixels) => {
                if pixels.len() > self.images.0 {
                    self.images =
                        (pixels.len(), self.hub.publisher(&KEYFRAME_IMAGE, pixels.len())?);
                    self.hub.reserve()?;
                }
                self.images.1.send(*header, pixels)?;
            }
            Arrival::Frame(header, pixels) => {
                if pixels.len() > self.frames.0 {
                    self.frames = (pixels.len(), self.hub.publisher(&FRAME, pixels.len())?);
                    self.hub.reserve()?;
                }
                self.frames.1.send(*header, pixels)?;
            }
            Arrival::Presence(_) => {}
        }
        Ok(())
    }

    /// Sends the last keyframe, graph, pose and health to late subscribers.
    pub fn serve_late_joiners(&self) {
        self.poses.serve_late_joiners();
        self.adjustments.serve_late_joiners();
        self.graphs.serve_late_joiners();
        self.keyframes.serve_late_joiners();
        self.images.1.serve_late_joiners();
        self.frames.1.serve_late_joiners();
        self.health.iter().for_each(|reported| reported.publisher.serve_late_joiners());
    }

    /// Reports the cause of a silence once a second, as stale health. A finished process stays finished for a while.
    pub fn report_silence(&mut self, cause: &str) -> Result<(), ZenohError> {
        self.forget_run_that_is_over()?;
        let now = now_nanos();
        for reported in &mut self.health {
            let since = now.saturating_sub(reported.told_nanos);
            if reported.is_silent && since < REPORT_PERIOD_NANOS {
                continue;
            }
            let mut message = reported.last;
            let has_ended = matches!(
                ProcessState::from_code(message.state),
                Some(ProcessState::Finished | ProcessState::Failed)
            );
            let is_recent = now.saturating_sub(reported.heard_nanos) < END_PERIOD_NANOS;
            if !(has_ended && is_recent) {
                message.state = ProcessState::Stale.code();
                (message.cause, message.cause_bytes) = text_bytes(cause);
                message.rate_hz = 0.0;
            }
            message.published_nanos = now;
            message.process_id = std::process::id();
            reported.publisher.send((), &[message])?;
            (reported.told_nanos, reported.is_silent) = (now, true);
        }
        Ok(())
    }

    /// Publishes health with this program's process id: the robot's means nothing to liveness checks on this machine.
    fn publish_health(&mut self, kind: Kind, message: &HealthMessage) -> Result<(), ZenohError> {
        let place = Kind::HEALTH.iter().position(|of| *of == kind);
        let Some(reported) = place.and_then(|place| self.health.get_mut(place)) else {
            return Ok(());
        };
        reported.last = HealthMessage { process_id: std::process::id(), ..*message };
        reported.publisher.send((), &[reported.last])?;
        let now = now_nanos();
        (reported.told_nanos, reported.heard_nanos, reported.is_silent) = (now, now, false);
        self.forget_run_that_is_over()
    }

    /// Once tracker and mapper have finished, opens the other topics anew: programs that have joined keep what they have
    /// not read yet, and those that join later get nothing of a run that is over.
    fn forget_run_that_is_over(&mut self) -> Result<(), ZenohError> {
        let finished = ProcessState::Finished.code();
        let is_over = self.health[1..].iter().all(|reported| reported.last.state == finished);
        if !(is_over && std::mem::take(&mut self.has_content)) {
            return Ok(());
        }
        // Whoever has joined just now is still to get them.
        self.serve_late_joiners();
        let hub = &self.hub;
        self.poses = hub.publisher(&POSE, 1)?;
        self.adjustments = hub.publisher(&ADJUSTMENT, 1)?;
        self.graphs = hub.publisher(&GRAPH, MAX_GRAPH_KEYFRAMES)?;
        self.keyframes = hub.publisher(&KEYFRAME, MAX_KEYFRAME_POINTS)?;
        self.images.1 = hub.publisher(&KEYFRAME_IMAGE, self.images.0)?;
        self.frames.1 = hub.publisher(&FRAME, self.frames.0)?;
        Ok(hub.reserve()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use semidense::service::peers::Peer;
    use semidense::wire::port::Subscriber;
    use semidense::wire::topic::TRACKER_HEALTH;

    #[test]
    fn a_finished_process_stays_finished_for_three_seconds_and_is_stale_then() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let mut mirror = Mirror::open(&place).unwrap();
        let hub = Hub::join(&place, "reader", Access::Observer).unwrap();
        let mut tracker = Peer::open(&hub, &TRACKER_HEALTH).unwrap();
        let finished =
            HealthMessage { state: ProcessState::Finished.code(), ..HealthMessage::new_zeroed() };
        mirror.publish(&Arrival::Health(Kind::TrackerHealth, Box::new(finished))).unwrap();
        // By the age of its last report; a second is left for a slow machine.
        let expected = [
            (REPORT_PERIOD_NANOS, ProcessState::Finished),
            (END_PERIOD_NANOS - REPORT_PERIOD_NANOS, ProcessState::Finished),
            (END_PERIOD_NANOS, ProcessState::Stale),
        ];
        for (age_nanos, state) in expected {
            let reported = &mut mirror.health[1];
            reported.heard_nanos = now_nanos() - age_nanos;
            reported.told_nanos = i64::MIN;
            mirror.report_silence("the link is gone").unwrap();
            tracker.update().unwrap();
            assert_eq!(tracker.state(), Some(state), "{age_nanos}");
        }
        drop((tracker, hub, mirror));
        place.tidy();
    }

    #[test]
    fn a_program_that_joins_after_the_end_gets_no_pose_of_the_run() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let mut mirror = Mirror::open(&place).unwrap();
        let hub = Hub::join(&place, "reader", Access::Observer).unwrap();
        let join = || -> Subscriber<PoseMessage, ()> { hub.subscriber(&POSE).unwrap() };
        let numbers = |port: &Subscriber<PoseMessage, ()>| {
            let next = || port.receive().unwrap().map(|message| message.payload()[0].sequence);
            std::iter::from_fn(next).collect::<Vec<u64>>()
        };
        let pose = |sequence| {
            Arrival::Pose(Box::new(PoseMessage { sequence, ..PoseMessage::new_zeroed() }))
        };
        let health = |kind, state: ProcessState| {
            let message = HealthMessage { state: state.code(), ..HealthMessage::new_zeroed() };
            Arrival::Health(kind, Box::new(message))
        };
        let early = join();
        for arrival in [
            health(Kind::MapperHealth, ProcessState::Running),
            health(Kind::TrackerHealth, ProcessState::Running),
            pose(7),
            health(Kind::TrackerHealth, ProcessState::Finished),
        ] {
            mirror.publish(&arrival).unwrap();
        }
        // Behind a cut link, or while the mapper still works, the last pose counts.
        mirror.report_silence("the link is gone").unwrap();
        let late = join();
        mirror.serve_late_joiners();
        assert_eq!(numbers(&late), [7]);
        mirror.publish(&health(Kind::MapperHealth, ProcessState::Finished)).unwrap();
        let too_late = join();
        mirror.serve_late_joiners();
        assert_eq!((numbers(&early), numbers(&too_late)), (vec![7], vec![]));
        // Nor does the next run begin with it, or with one that arrives after the end.
        mirror.publish(&pose(8)).unwrap();
        mirror.report_silence("its instance is not running").unwrap();
        let of_next = join();
        mirror.publish(&health(Kind::TrackerHealth, ProcessState::Running)).unwrap();
        mirror.publish(&pose(1)).unwrap();
        assert_eq!(numbers(&of_next), [1]);
        drop((early, late, too_late, of_next, hub, mirror));
        place.tidy();
    }
}
