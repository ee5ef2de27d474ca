//! Publishes the events of a session: one thread reads and converts, another hands messages to the network.

use std::collections::HashSet;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use ros2_client::dds::Publisher;
use semidense::service::clock::now_nanos;
use semidense::slam::keyframe::Keyframe;

use crate::last_time::LastTime;
use crate::ros::axes::{ros_from_world, transform_message};
use crate::ros::converter::{Converter, PoseMessages};
use crate::ros::diagnostics::{figure, report};
use crate::ros::encoder::realtime_nanos;
use crate::ros::frame_ids::FrameIds;
use crate::ros::message::{
    CameraInfo, DiagnosticArray, Header, Image, Odometry, PointCloud2, PoseArray,
    PoseWithCovarianceStamped, RosMessage, TfMessage, Time, TransformStamped,
};
use crate::ros::topic::{self, Reliability, RosTopic};
use crate::ros2::node::{NodeError, RosNode, dds_name};
use crate::ros2::outbox::{Outgoing, outbox, slot};
use crate::session::{Event, Graph, Session, SessionError};
use crate::slots::Slots;

/// Interval at which readers are counted.
const READERS_PERIOD: Duration = Duration::from_millis(500);
/// Period of this node's own reports, and minimum time between two keyframe graphs: the map changes about as often.
const REPORT_PERIOD: Duration = Duration::from_secs(1);
/// Upper limit for a wait for messages, hence the delay until a signal is noticed.
const WAIT: Duration = Duration::from_millis(100);

/// What is published, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishParams {
    /// The instance to read.
    pub instance: String,
    /// Namespace of the topics, beginning with `/`.
    pub namespace: String,
    /// Names of the frames.
    pub frames: FrameIds,
    /// Frame id of the camera body with x forward, for `/tf_static`; `None` to omit it.
    pub camera_link: Option<String>,
    /// Whether transforms are published.
    pub tf: bool,
    /// Minimum time between two images; `None` for no images.
    pub image_period: Option<Duration>,
    /// Minimum time between two clouds; `None` for no clouds.
    pub points_period: Option<Duration>,
    /// Whether images and clouds are reliable too.
    pub reliable_sensors: bool,
}

/// Number of readers, at the last check, of messages that are costly to make.
#[derive(Debug, Default)]
struct Demand {
    images: AtomicU64,
    points: AtomicU64,
}

/// The publishers of one node.
pub struct Publishers {
    params: PublishParams,
    pose: Publisher<PoseWithCovarianceStamped>,
    odometry: Publisher<Odometry>,
    tf: Option<Publisher<TfMessage>>,
    /// Kept alive: its message is for late subscribers.
    _tf_static: Option<Publisher<TfMessage>>,
    images: Option<(Publisher<Image>, Publisher<CameraInfo>)>,
    points: Option<Publisher<PointCloud2>>,
    keyframes: Publisher<PoseArray>,
    diagnostics: Publisher<DiagnosticArray>,
    outbox: Arc<Slots<Outgoing>>,
    demand: Arc<Demand>,
    /// Topics whose readers cannot be served: each is reported once.
    named: HashSet<String>,
    published: u64,
    refused: u64,
    longest: Duration,
    /// Dropped last: the publishers sign off through it.
    node: RosNode,
}

/// An image or cloud topic of this node, with the requested reliability.
fn sensor(params: &PublishParams, topic: RosTopic) -> RosTopic {
    let reliability =
        if params.reliable_sensors { Reliability::Reliable } else { topic.reliability };
    RosTopic { reliability, ..topic }
}

/// From the camera's optical axes to x forward, y left, z up.
fn camera_link_transform(params: &PublishParams, camera_link: &str) -> TfMessage {
    let header = Header::new(Time::from_nanos(realtime_nanos()), &params.frames.camera);
    let transform = transform_message(&ros_from_world().inverse());
    let child_frame_id = camera_link.to_owned();
    TfMessage { transforms: vec![TransformStamped { header, child_frame_id, transform }] }
}

impl Publishers {
    /// Opens all topics of a node.
    pub fn open(mut node: RosNode, params: PublishParams) -> Result<Self, NodeError> {
        let tf_static = match &params.camera_link {
            Some(link) if params.tf => {
                let publisher = node.publisher(&topic::TF_STATIC)?;
                // The only message on this topic, so there is room for it.
                let _ = publisher.publish(camera_link_transform(&params, link));
                Some(publisher)
            }
            _ => None,
        };
        let tf = params.tf.then(|| node.publisher(&topic::TF)).transpose()?;
        let images = match params.image_period {
            Some(_) => Some((
                node.publisher(&sensor(&params, topic::IMAGE))?,
                node.publisher(&sensor(&params, topic::CAMERA_INFO))?,
            )),
            None => None,
        };
        let points = params.points_period.map(|_| node.publisher(&sensor(&params, topic::POINTS)));
        Ok(Self {
            pose: node.publisher(&topic::POSE)?,
            odometry: node.publisher(&topic::ODOMETRY)?,
            keyframes: node.publisher(&topic::KEYFRAMES)?,
            diagnostics: node.publisher(&topic::DIAGNOSTICS)?,
            tf,
            _tf_static: tf_static,
            images,
            points: points.transpose()?,
            node,
            params,
            outbox: Arc::new(outbox()),
            demand: Arc::default(),
            named: HashSet::new(),
            published: 0,
            refused: 0,
            longest: Duration::ZERO,
        })
    }

    /// The part that runs on the reading thread.
    pub fn reader(&self) -> Reader {
        Reader {
            converter: Converter::new(&self.params.instance, self.params.frames.clone()),
            params: self.params.clone(),
            outbox: Arc::clone(&self.outbox),
            demand: Arc::clone(&self.demand),
            keyframe: None,
            keyframe_is_new: false,
            points_readers: 0,
            image_sent: LastTime::default(),
            points_sent: LastTime::default(),
            graph: None,
            graph_sent: LastTime::default(),
        }
    }

    /// Publishes until the outbox is closed.
    pub fn run(mut self) {
        let (mut looked, mut reported) = (LastTime::default(), LastTime::now());
        while let Ok(message) = self.outbox.take_within(WAIT) {
            if let Some(message) = message {
                self.publish(message);
            }
            if looked.is_due(READERS_PERIOD) {
                self.count_readers();
            }
            if reported.is_due(REPORT_PERIOD) {
                let report = self.report();
                self.publish(Outgoing::Diagnostics(Box::new(report)));
            }
        }
    }

    fn publish(&mut self, message: Outgoing) {
        let begin = Instant::now();
        let is_sent = match message {
            Outgoing::Pose(messages) => {
                let PoseMessages { pose, odometry, transforms } = *messages;
                send(&self.odometry, odometry)
                    & send(&self.pose, pose)
                    & self.tf.as_ref().is_none_or(|tf| send(tf, transforms))
            }
            Outgoing::Diagnostics(message) => send(&self.diagnostics, *message),
            Outgoing::Image(pair) => self.images.as_ref().is_none_or(|(images, infos)| {
                let (image, info) = *pair;
                send(infos, info) & send(images, image)
            }),
            Outgoing::Points(message) => {
                self.points.as_ref().is_none_or(|points| send(points, *message))
            }
            Outgoing::Keyframes(message) => send(&self.keyframes, *message),
        };
        match is_sent {
            true => self.published += 1,
            false => self.refused += 1,
        }
        self.longest = self.longest.max(begin.elapsed());
    }

    /// Counts the readers of costly messages, and reports those that receive nothing.
    fn count_readers(&mut self) {
        let name_of = |topic: RosTopic| dds_name(&topic.name_in(&self.params.namespace));
        let (Ok(image), Ok(info), Ok(points)) =
            (name_of(topic::IMAGE), name_of(topic::CAMERA_INFO), name_of(topic::POINTS))
        else {
            return;
        };
        let (mut images, mut clouds) = (0, 0);
        for reader in self.node.remote_readers() {
            let is_image = reader.topic == image || reader.topic == info;
            let is_points = reader.topic == points;
            if (is_image || is_points) && reader.wants_reliable && !self.params.reliable_sensors {
                if self.named.insert(reader.topic.clone()) {
                    tracing::warn!(
                        "a subscriber of {} requests reliable delivery and receives nothing: set it to best effort, or start this program with --reliable-sensors",
                        reader.topic.trim_start_matches("rt")
                    );
                }
                continue;
            }
            images += u64::from(is_image);
            clouds += u64::from(is_points);
        }
        self.demand.images.store(images, Ordering::Relaxed);
        self.demand.points.store(clouds, Ordering::Relaxed);
    }

    /// The state of this node as a diagnostic message.
    fn report(&mut self) -> DiagnosticArray {
        let longest_ms = std::mem::take(&mut self.longest).as_secs_f64() * 1e3;
        let dropped = |slot| self.outbox.dropped(slot);
        let lost = dropped(slot::POSE) + self.refused;
        let message =
            if lost == 0 { "publishing" } else { "publishing; some messages were dropped" };
        let values = vec![
            figure("published", self.published),
            figure("dropped_poses", dropped(slot::POSE)),
            figure("dropped_images", dropped(slot::IMAGE)),
            figure("dropped_points", dropped(slot::POINTS)),
            figure("refused_by_slow_readers", self.refused),
            figure("longest_publish_ms", format!("{longest_ms:.3}")),
        ];
        let stamp = Time::from_nanos(realtime_nanos());
        report(&self.params.instance, "ros2", stamp, (0, message.to_owned()), values)
    }
}

/// Whether a message was accepted: a topic whose reliable readers confirm nothing refuses messages after a while.
fn send<M: RosMessage>(publisher: &Publisher<M>, message: M) -> bool {
    publisher.publish(message).inspect_err(|_| tracing::debug!("{} was refused", M::TYPE)).is_ok()
}

/// Reads a session and converts its events to messages.
pub struct Reader {
    converter: Converter,
    params: PublishParams,
    outbox: Arc<Slots<Outgoing>>,
    demand: Arc<Demand>,
    /// The active keyframe, for late subscribers.
    keyframe: Option<Arc<Keyframe>>,
    keyframe_is_new: bool,
    points_readers: u64,
    image_sent: LastTime,
    points_sent: LastTime,
    /// The newest graph until it is sent.
    graph: Option<Arc<Graph>>,
    graph_sent: LastTime,
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.outbox.close();
    }
}

impl Reader {
    /// Reads pending events; see [`Session::read`].
    pub fn read(
        &mut self,
        session: &mut Session,
        interrupt: Option<BorrowedFd<'_>>,
    ) -> Result<(), SessionError> {
        session.read(interrupt, WAIT, |event| self.take(&event))?;
        self.put_points_if_due();
        self.put_graph_if_due();
        Ok(())
    }

    fn take(&mut self, event: &Event) {
        self.converter.observe(event);
        match event {
            Event::Joined => {
                tracing::info!("joined instance {}", self.params.instance);
                self.keyframe = None;
            }
            Event::Left => tracing::warn!(
                "instance {} has ended; waiting for the next one of that name",
                self.params.instance
            ),
            Event::Pose(pose) => {
                if let Some(messages) = self.converter.pose(pose) {
                    self.outbox.put(slot::POSE, Outgoing::Pose(Box::new(messages)));
                }
            }
            Event::Frame(frame) => {
                let has_readers = self.demand.images.load(Ordering::Relaxed) > 0;
                let Some(period) = self.params.image_period.filter(|_| has_readers) else { return };
                if self.image_sent.is_due(period) {
                    let pair = (self.converter.image(frame), self.converter.camera_info(frame));
                    self.outbox.put(slot::IMAGE, Outgoing::Image(Box::new(pair)));
                }
            }
            Event::Keyframe(keyframe) => {
                self.keyframe = Some(Arc::clone(keyframe));
                self.keyframe_is_new = true;
            }
            Event::Graph(graph) => self.graph = Some(Arc::clone(graph)),
            Event::Health(owner, health) => {
                // Stamped with the time at which the process wrote it.
                let age = now_nanos().saturating_sub(health.published_nanos);
                let stamp = Time::from_nanos(realtime_nanos().saturating_sub(age));
                let report = self.converter.diagnostics(owner, health, stamp);
                self.outbox.put(slot::DIAGNOSTICS, Outgoing::Diagnostics(Box::new(report)));
            }
            Event::Adjustment(_) => {}
        }
    }

    /// Sends the newest revision of the keyframe, at most once per period, and again for a new subscriber.
    fn put_points_if_due(&mut self) {
        let readers = self.demand.points.load(Ordering::Relaxed);
        let has_new_reader = readers > self.points_readers;
        self.points_readers = readers;
        self.keyframe_is_new |= has_new_reader;
        let (Some(period), Some(keyframe)) = (self.params.points_period, &self.keyframe) else {
            return;
        };
        if readers > 0 && self.keyframe_is_new && self.points_sent.is_due(period) {
            self.keyframe_is_new = false;
            let points = self.converter.points(keyframe);
            self.outbox.put(slot::POINTS, Outgoing::Points(Box::new(points)));
        }
    }

    /// Sends the newest graph, at most once a second.
    fn put_graph_if_due(&mut self) {
        if let Some(graph) = self.graph.take_if(|_| self.graph_sent.is_due(REPORT_PERIOD)) {
            let keyframes = self.converter.keyframes(&graph, Time::from_nanos(realtime_nanos()));
            self.outbox.put(slot::KEYFRAMES, Outgoing::Keyframes(Box::new(keyframes)));
        }
    }
}
