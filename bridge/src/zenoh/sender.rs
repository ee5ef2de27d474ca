//! Sending: reads the topics of the local instance and puts them on Zenoh.
//!
//! Three threads: one reads shared memory and never waits for the network, one puts what is urgent (poses, health), one
//! packs and puts what is large. Between them are queues in which the newest wins.

use std::sync::Arc;
use std::time::{Duration, Instant};

use semidense::service::shutdown::Shutdown;
use semidense::slam::keyframe::Keyframe;
use semidense::wire::conversion::{keyframe_header, keyframe_image_header, keyframe_pose_message};
use semidense::wire::message::{
    AdjustmentMessage, HealthMessage, KeyframePoseMessage, PoseMessage,
};
use semidense::wire::place::Place;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::query::Query;
use zenoh::{Session as ZenohSession, Wait};
use zerocopy::IntoBytes;

use crate::jpeg;
use crate::session::{Event, Frame, Graph, Session, Wants};
use crate::zenoh::envelope::{Packed, Packing};
use crate::zenoh::error::ZenohError;
use crate::zenoh::kind::Kind;
use crate::zenoh::link::{Endpoints, declare_error, open, publisher, sender_id};
use crate::zenoh::outlet::Outlet;
use crate::zenoh::packing::{pack_image, pack_plain, pack_points};
use crate::zenoh::rate::{Latest, Rate};
use crate::zenoh::slots::Slots;
use crate::zenoh::traffic::Traffic;

/// Longest wait for a message without a look at what is due.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Poses that wait for the network: two seconds of a camera of 30 Hz. Older ones are of no use at the other end.
const WAITING_POSES: usize = 60;
/// Of each process's health.
const WAITING_HEALTH: usize = 2;
/// Joint estimates that wait for the network: some seconds of them.
const WAITING_ADJUSTMENTS: usize = 16;

/// What is sent besides poses, health and the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameOptions {
    /// Quality of the JPEG, 1 to 100.
    pub jpeg_quality: u8,
    /// Most frames a second.
    pub rate_hz: f64,
}

/// What is sent where.
#[derive(Debug, Clone, PartialEq)]
pub struct SendOptions {
    /// Links.
    pub endpoints: Endpoints,
    /// Frames, where they are wanted.
    pub frames: Option<FrameOptions>,
    /// Most revisions of a keyframe's depth a second; a new keyframe goes out at once.
    pub keyframe_rate_hz: f64,
}

/// Something to be put.
enum Item {
    Pose(Box<PoseMessage>),
    Health(Kind, Box<HealthMessage>),
    Adjustment(AdjustmentMessage),
    Graph(Arc<Graph>),
    Keyframe(Arc<Keyframe>),
    Frame(Arc<Frame>),
}

/// Sends until the signal. Waits for an instance that does not run yet, and for the next one after it.
pub fn send(place: &Place, options: &SendOptions, shutdown: &Shutdown) -> Result<(), ZenohError> {
    let network = open(&options.endpoints)?;
    let outlet = Arc::new(Outlet::new(sender_id(&network)));
    declare_answers(&network, &place.instance, &outlet)?;
    let urgent = Slots::new(&[WAITING_POSES, WAITING_HEALTH, WAITING_HEALTH, WAITING_HEALTH]);
    let large = Slots::new(&[WAITING_ADJUSTMENTS, 1, 1, 1]);
    let publishers = |kinds: &[Kind]| -> Result<Vec<Publisher<'static>>, ZenohError> {
        kinds.iter().map(|kind| publisher(&network, &place.instance, *kind)).collect()
    };
    let kinds: Vec<Kind> = Kind::ALL.into_iter().filter(|kind| kind.topic().is_some()).collect();
    let (of_urgent, of_large) = (publishers(&kinds)?, publishers(&kinds)?);
    let quality = options.frames.map_or(0, |frames| frames.jpeg_quality);
    let outcome = std::thread::scope(|scope| {
        let named = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let started = named("put-urgent")
            .spawn_scoped(scope, || put_urgent(&urgent, &of_urgent, &outlet))
            .and_then(|_| {
                named("put-large")
                    .spawn_scoped(scope, || put_large(&large, &of_large, &outlet, quality))
            });
        let read = || {
            read(
                place,
                options,
                shutdown,
                &Reader { outlet: &outlet, urgent: &urgent, large: &large },
            )
        };
        let outcome = started.map_err(ZenohError::from).and_then(|_| read());
        urgent.close();
        large.close();
        outcome
    });
    drop((of_urgent, of_large));
    // What cannot be told any more is noticed by the other side's lease.
    let _ = network.close().wait();
    outcome
}

/// What the reading thread gives to the others.
struct Reader<'a> {
    outlet: &'a Outlet,
    urgent: &'a Slots<Item>,
    large: &'a Slots<Item>,
}

fn read(
    place: &Place,
    options: &SendOptions,
    shutdown: &Shutdown,
    to: &Reader<'_>,
) -> Result<(), ZenohError> {
    let wants =
        Wants { frames: options.frames.is_some(), keyframes: true, graph: true, adjustments: true };
    let mut session = Session::new(place.clone(), "zenoh-send", wants);
    let mut frame_rate = Rate::new(options.frames.map_or(1.0, |frames| frames.rate_hz));
    let mut keyframes = Latest::new(options.keyframe_rate_hz);
    let mut traffic = Traffic::default();
    while !shutdown.is_requested() {
        session.read(Some(shutdown.descriptor()), WAKE_PERIOD, |event| {
            to.take(event, &mut frame_rate, &mut keyframes);
        })?;
        if let Some(keyframe) = keyframes.due(Instant::now()) {
            to.large.put(2, Item::Keyframe(keyframe));
        }
        traffic.tell(to.outlet, || dropped(to), session.refused());
    }
    Ok(())
}

/// Messages that the network did not take in time, as the log names them.
fn dropped(to: &Reader<'_>) -> [(&'static str, u64); 5] {
    [
        ("poses", to.urgent.dropped(0)),
        ("health", (1..=3).map(|slot| to.urgent.dropped(slot)).sum()),
        ("graphs", to.large.dropped(1)),
        ("keyframes", to.large.dropped(2)),
        ("frames", to.large.dropped(3)),
    ]
}

impl Reader<'_> {
    fn take(&self, event: Event, frame_rate: &mut Rate, keyframes: &mut Latest) {
        match event {
            Event::Joined => {
                tracing::info!("joined the instance");
                self.outlet.begin_run();
            }
            Event::Left => {
                tracing::info!("the instance is gone");
                self.outlet.end_run();
                keyframes.forget();
            }
            Event::Pose(pose) => self.urgent.put(0, Item::Pose(Box::new(pose.message))),
            Event::Health(owner, health) => {
                let place =
                    Kind::HEALTH.iter().position(|kind| Some(*kind) == Kind::of_health(owner));
                if let Some(place) = place {
                    self.urgent.put(1 + place, Item::Health(Kind::HEALTH[place], health));
                }
            }
            Event::Adjustment(message) => self.large.put(0, Item::Adjustment(message)),
            Event::Graph(graph) => self.large.put(1, Item::Graph(graph)),
            Event::Keyframe(keyframe) => keyframes.take(keyframe),
            Event::Frame(frame) => {
                if frame_rate.is_due(Instant::now()) {
                    self.large.put(3, Item::Frame(frame));
                }
            }
        }
    }
}

/// Answers who asks for presence, or for the last message of a kind.
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
                // Who asked may be gone.
                let _ = query.reply(query.key_expr().clone(), bytes).express(true).wait();
            }
        };
        let declared = network.declare_queryable(key.clone()).callback(answer).background().wait();
        declared.map_err(|error| declare_error(&key, &error))?;
    }
    Ok(())
}

fn put(publishers: &[Publisher<'static>], kind: Kind, bytes: ZBytes) {
    // Dropped on a congested link: receivers see it by the numbers.
    if let Err(error) = publishers[kind as usize].put(bytes).wait() {
        tracing::debug!("{error}");
    }
}

fn put_urgent(items: &Slots<Item>, publishers: &[Publisher<'static>], outlet: &Outlet) {
    while let Some(item) = items.take() {
        match item {
            Item::Pose(message) => {
                let bytes = outlet.seal(Kind::Pose, &*message, &Packed::empty());
                put(publishers, Kind::Pose, bytes);
            }
            Item::Health(kind, message) => {
                put(publishers, kind, outlet.seal(kind, &*message, &Packed::empty()));
            }
            _ => {}
        }
    }
}

fn put_large(
    items: &Slots<Item>,
    publishers: &[Publisher<'static>],
    outlet: &Outlet,
    jpeg_quality: u8,
) {
    let mut image_of = None;
    while let Some(item) = items.take() {
        match item {
            Item::Adjustment(message) => {
                let bytes = outlet.seal(Kind::Adjustment, &message, &Packed::empty());
                put(publishers, Kind::Adjustment, bytes);
            }
            Item::Graph(graph) => {
                let poses: Vec<KeyframePoseMessage> =
                    graph.poses.iter().map(keyframe_pose_message).collect();
                let payload = pack_plain(poses.as_slice().as_bytes());
                put(publishers, Kind::Graph, outlet.seal(Kind::Graph, &graph.header, &payload));
            }
            Item::Keyframe(keyframe) => {
                // Image before depth, and once: it serves every revision.
                let id = Some((outlet.run(), keyframe.epoch, keyframe.keyframe_id));
                if image_of != id {
                    image_of = id;
                    put_keyframe_image(&keyframe, publishers, outlet);
                }
                put_depth(&keyframe, publishers, outlet);
            }
            Item::Frame(frame) => put_frame(&frame, publishers, outlet, jpeg_quality),
            _ => {}
        }
    }
}

fn put_keyframe_image(keyframe: &Keyframe, publishers: &[Publisher<'static>], outlet: &Outlet) {
    let header = keyframe_image_header(keyframe);
    match pack_image(&keyframe.image, header.width, header.height) {
        Ok(payload) => {
            let bytes = outlet.seal(Kind::KeyframeImage, &header, &payload);
            put(publishers, Kind::KeyframeImage, bytes);
        }
        Err(error) => tracing::debug!("keyframe {}: {error}", keyframe.keyframe_id),
    }
}

fn put_depth(keyframe: &Keyframe, publishers: &[Publisher<'static>], outlet: &Outlet) {
    let payload = pack_points(&keyframe.points);
    let (id, revision) = (keyframe.keyframe_id, keyframe.revision);
    let (packed, unpacked) = (payload.bytes.len(), payload.unpacked_bytes);
    tracing::debug!("keyframe {id} revision {revision}: {packed} bytes for {unpacked}");
    let bytes = outlet.seal(Kind::Keyframe, &keyframe_header(keyframe), &payload);
    put(publishers, Kind::Keyframe, bytes);
}

/// Frames are packed only where somebody takes them.
fn put_frame(frame: &Frame, publishers: &[Publisher<'static>], outlet: &Outlet, quality: u8) {
    let status = publishers[Kind::Frame as usize].matching_status().wait();
    if !status.is_ok_and(|status| status.matching()) {
        return;
    }
    let size = [frame.intrinsics.width, frame.intrinsics.height];
    match jpeg::encode_gray(&frame.pixels, size, quality) {
        Ok(bytes) => {
            let unpacked_bytes = frame.pixels.len();
            let payload = Packed { packing: Packing::Jpeg, unpacked_bytes, bytes };
            put(publishers, Kind::Frame, outlet.seal(Kind::Frame, &frame.header, &payload));
        }
        Err(error) => tracing::debug!("frame {}: {error}", frame.header.sequence),
    }
}
