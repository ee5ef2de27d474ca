//! Reads the topics of the local instance and publishes them on Zenoh.
//!
//! Three threads: one reads shared memory and never waits for the network, one sends urgent messages (poses,
//! health), one packs and sends large ones. The queues between them keep the newest items.

use std::sync::Arc;
use std::time::{Duration, Instant};

use semidense::service::shutdown::Shutdown;
use semidense::slam::keyframe::Keyframe;
use semidense::wire::conversion::{keyframe_header, keyframe_image_header, keyframe_pose_message};
use semidense::wire::message::{
    AdjustmentMessage, HealthMessage, KeyframePoseMessage, PoseMessage,
};
use semidense::wire::place::Place;
use zenoh::pubsub::Publisher;
use zenoh::query::Query;
use zenoh::{Session as ZenohSession, Wait};
use zerocopy::{Immutable, IntoBytes};

use crate::jpeg;
use crate::session::{Event, Frame, Graph, Session, Wants};
use crate::slots::Slots;
use crate::zenoh::envelope::{Packed, Packing};
use crate::zenoh::error::ZenohError;
use crate::zenoh::kind::Kind;
use crate::zenoh::link::{Endpoints, declare_error, open, publisher, sender_id};
use crate::zenoh::outlet::Outlet;
use crate::zenoh::packing::{pack_image, pack_plain, pack_points};
use crate::zenoh::rate::{Latest, Rate};
use crate::zenoh::traffic::Traffic;

/// Upper limit for a wait for messages before due keyframes are checked.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Poses queued for the network: two seconds of a camera at 30 Hz. Older ones are useless at the other end.
const WAITING_POSES: usize = 60;
/// Health reports of each process queued for the network.
const WAITING_HEALTH: usize = 2;
/// Joint estimates queued for the network: those of a few seconds.
const WAITING_ADJUSTMENTS: usize = 16;

/// Settings for sending frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameOptions {
    /// Quality of the JPEG, 1 to 100.
    pub jpeg_quality: u8,
    /// Maximum rate of frames.
    pub rate_hz: f64,
}

/// What is sent, and where.
#[derive(Debug, Clone, PartialEq)]
pub struct SendOptions {
    /// Addresses of the links.
    pub endpoints: Endpoints,
    /// How frames are sent; `None` for no frames.
    pub frames: Option<FrameOptions>,
    /// Maximum rate of revisions of a keyframe's depth; a new keyframe is sent at once.
    pub keyframe_rate_hz: f64,
}

/// An item to send.
enum Item {
    Pose(Box<PoseMessage>),
    Health(Kind, Box<HealthMessage>),
    Adjustment(AdjustmentMessage),
    Graph(Arc<Graph>),
    Keyframe(Arc<Keyframe>),
    Frame(Arc<Frame>),
}

/// Sends until a signal arrives. Waits for an instance that is not running yet, and for the next one after it.
pub fn send(place: &Place, options: &SendOptions, shutdown: &Shutdown) -> Result<(), ZenohError> {
    let network = open(&options.endpoints)?;
    let outlet = Arc::new(Outlet::new(sender_id(&network)));
    declare_answers(&network, &place.instance, &outlet)?;
    // By kind; each queue leaves the slots of the other's kinds empty.
    let depths = Kind::ALL.map(|kind| match kind {
        Kind::Pose => WAITING_POSES,
        Kind::CaptureHealth | Kind::TrackerHealth | Kind::MapperHealth => WAITING_HEALTH,
        Kind::Adjustment => WAITING_ADJUSTMENTS,
        _ => 1,
    });
    let (urgent, large) = (Slots::new(&depths), Slots::new(&depths));
    let kinds = Kind::ALL.into_iter().filter(|kind| kind.topic().is_some());
    let publishers: Vec<Publisher<'static>> = kinds
        .map(|kind| publisher(&network, &place.instance, kind))
        .collect::<Result<_, ZenohError>>()?;
    let jpeg_quality = options.frames.map_or(0, |frames| frames.jpeg_quality);
    let putter =
        || Putter { publishers: &publishers, outlet: &outlet, jpeg_quality, image_of: None };
    let outcome = std::thread::scope(|scope| {
        let named = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let started = named("put-urgent")
            .spawn_scoped(scope, || putter().run(&urgent))
            .and_then(|_| named("put-large").spawn_scoped(scope, || putter().run(&large)));
        let reader = Reader {
            outlet: &outlet,
            urgent: &urgent,
            large: &large,
            frame_rate: Rate::new(options.frames.map_or(1.0, |frames| frames.rate_hz)),
            keyframes: Latest::new(options.keyframe_rate_hz),
        };
        let outcome = started
            .map_err(ZenohError::from)
            .and_then(|_| reader.run(place, options.frames.is_some(), shutdown));
        urgent.close();
        large.close();
        outcome
    });
    drop(publishers);
    // If this cannot be sent, the other side notices by its lease.
    let _ = network.close().wait();
    outcome
}

/// Reads shared memory and passes messages to the other threads.
struct Reader<'a> {
    outlet: &'a Outlet,
    urgent: &'a Slots<Item>,
    large: &'a Slots<Item>,
    frame_rate: Rate,
    keyframes: Latest,
}

impl Reader<'_> {
    fn run(mut self, place: &Place, frames: bool, shutdown: &Shutdown) -> Result<(), ZenohError> {
        let wants = Wants { frames, keyframes: true, graph: true, adjustments: true };
        let mut session = Session::new(place.clone(), "zenoh-send", wants);
        let mut traffic = Traffic::default();
        while !shutdown.is_requested() {
            session.read(Some(shutdown.descriptor()), WAKE_PERIOD, |event| self.take(event))?;
            if let Some(keyframe) = self.keyframes.due(Instant::now()) {
                self.put(Kind::Keyframe, Item::Keyframe(keyframe));
            }
            traffic.log_if_due(self.outlet, || self.dropped(), session.refused());
        }
        Ok(())
    }

    /// Messages dropped because the network was too slow, as named in the log.
    fn dropped(&self) -> [(&'static str, u64); 5] {
        let urgent = |kind: &Kind| self.urgent.dropped(*kind as usize);
        let large = |kind: Kind| self.large.dropped(kind as usize);
        [
            ("poses", urgent(&Kind::Pose)),
            ("health", Kind::HEALTH.iter().map(urgent).sum()),
            ("graphs", large(Kind::Graph)),
            ("keyframes", large(Kind::Keyframe)),
            ("frames", large(Kind::Frame)),
        ]
    }

    fn put(&self, kind: Kind, item: Item) {
        let queue = if kind.is_urgent() { self.urgent } else { self.large };
        queue.put(kind as usize, item);
    }

    fn take(&mut self, event: Event) {
        match event {
            Event::Joined => {
                tracing::info!("joined the instance");
                self.outlet.begin_run();
            }
            Event::Left => {
                tracing::info!("the instance has ended");
                self.outlet.end_run();
                self.keyframes.forget();
            }
            Event::Pose(pose) => self.put(Kind::Pose, Item::Pose(Box::new(pose.message))),
            Event::Health(owner, health) => {
                if let Some(kind) = Kind::of_health(owner) {
                    self.put(kind, Item::Health(kind, health));
                }
            }
            Event::Adjustment(message) => self.put(Kind::Adjustment, Item::Adjustment(message)),
            Event::Graph(graph) => self.put(Kind::Graph, Item::Graph(graph)),
            Event::Keyframe(keyframe) => self.keyframes.take(keyframe),
            Event::Frame(frame) => {
                if self.frame_rate.is_due(Instant::now()) {
                    self.put(Kind::Frame, Item::Frame(frame));
                }
            }
        }
    }
}

/// Answers queries for presence and for the last message of a kind.
fn declare_answers(
    network: &ZenohSession,
    instance: &str,
    outlet: &Arc<Outlet>,
) -> Result<(), ZenohError> {
    for kind in Kind::ALL.into_iter().filter(|kind| kind.is_kept() || *kind == Kind::Presence) {
        let key = kind.key(instance);
        let outlet = Arc::clone(outlet);
        let answer = move |query: Query| {
            let bytes = match kind {
                Kind::Presence => Some(outlet.presence()),
                _ => outlet.last(kind),
            };
            if let Some(bytes) = bytes {
                // The querier may have gone.
                let _ = query.reply(query.key_expr().clone(), bytes).express(true).wait();
            }
        };
        let declared = network.declare_queryable(key.clone()).callback(answer).background().wait();
        declared.map_err(|error| declare_error(&key, &error))?;
    }
    Ok(())
}

/// Packs, numbers and sends messages.
struct Putter<'a> {
    publishers: &'a [Publisher<'static>],
    outlet: &'a Outlet,
    jpeg_quality: u8,
    /// Run, epoch and id of the keyframe whose image was sent last.
    image_of: Option<(u64, u32, u64)>,
}

impl Putter<'_> {
    /// Sends queued items until the queue is closed.
    fn run(mut self, items: &Slots<Item>) {
        while let Some(item) = items.take() {
            match item {
                Item::Pose(message) => self.put(Kind::Pose, &*message, &Packed::empty()),
                Item::Health(kind, message) => self.put(kind, &*message, &Packed::empty()),
                Item::Adjustment(message) => self.put(Kind::Adjustment, &message, &Packed::empty()),
                Item::Graph(graph) => {
                    let poses: Vec<KeyframePoseMessage> =
                        graph.poses.iter().map(keyframe_pose_message).collect();
                    let payload = pack_plain(poses.as_slice().as_bytes());
                    self.put(Kind::Graph, &graph.header, &payload);
                }
                Item::Keyframe(keyframe) => self.put_keyframe(&keyframe),
                Item::Frame(frame) => self.put_frame(&frame),
            }
        }
    }

    fn put<T: IntoBytes + Immutable>(&self, kind: Kind, message: &T, payload: &Packed) {
        let bytes = self.outlet.seal(kind, message, payload);
        // Dropped on a congested link: receivers notice by the numbers.
        if let Err(error) = self.publishers[kind as usize].put(bytes).wait() {
            tracing::debug!("{error}");
        }
    }

    /// Sends the image before the depth, and only once: it serves every revision.
    fn put_keyframe(&mut self, keyframe: &Keyframe) {
        let (id, revision) = (keyframe.keyframe_id, keyframe.revision);
        let image_of = Some((self.outlet.run(), keyframe.epoch, id));
        if self.image_of != image_of {
            self.image_of = image_of;
            let header = keyframe_image_header(keyframe);
            match pack_image(&keyframe.image, header.width, header.height) {
                Ok(payload) => self.put(Kind::KeyframeImage, &header, &payload),
                Err(error) => tracing::debug!("keyframe {id}: {error}"),
            }
        }
        let payload = pack_points(&keyframe.points);
        let (packed, unpacked) = (payload.bytes.len(), payload.unpacked_bytes);
        tracing::debug!("keyframe {id} revision {revision}: {packed} bytes for {unpacked}");
        self.put(Kind::Keyframe, &keyframe_header(keyframe), &payload);
    }

    /// Sends a frame if it has a subscriber; otherwise it is not even packed.
    fn put_frame(&self, frame: &Frame) {
        let status = self.publishers[Kind::Frame as usize].matching_status().wait();
        if !status.is_ok_and(|status| status.matching()) {
            return;
        }
        let size = [frame.intrinsics.width, frame.intrinsics.height];
        match jpeg::encode_gray(&frame.pixels, size, self.jpeg_quality) {
            Ok(bytes) => {
                let unpacked_bytes = frame.pixels.len();
                let payload = Packed { packing: Packing::Jpeg, unpacked_bytes, bytes };
                self.put(Kind::Frame, &frame.header, &payload);
            }
            Err(error) => tracing::debug!("frame {}: {error}", frame.header.sequence),
        }
    }
}
