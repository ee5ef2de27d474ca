//! The stream to one page, over its WebSocket.
//!
//! A page receives the newest state when there is room for it: small messages at once, images and keyframes
//! only while few earlier ones are unacknowledged. A page that accepts nothing for some time is disconnected.

use std::collections::HashMap;
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use semidense::service::results::report::scene::framed;
use serde::Deserialize;
use serde_json::{Value, json};
use tungstenite::{Error, Message, WebSocket};

use crate::last_time::LastTime;
use crate::ros::images::jpeg;
use crate::web::packing::Packed;
use crate::web::scene::{NewestFrame, Scene, State};
use crate::web::words::{health_json, pose_json};

/// Upper limit for unacknowledged large messages: enough to fill a link, few enough to keep what arrives new.
const MAX_UNANSWERED: usize = 4;
/// Interval at which acknowledgements and the end are checked while there is nothing to send.
const QUIET_PERIOD: Duration = Duration::from_millis(100);
/// The same while there is more to send.
const BUSY_PERIOD: Duration = Duration::from_millis(4);
/// Upper limit for one check for acknowledgements.
const READ_TIME: Duration = Duration::from_millis(1);
/// Upper limit for the time that a page may accept nothing.
const LONGEST_WRITE: Duration = Duration::from_secs(10);
/// Period of updates of the path.
const PATH_PERIOD: Duration = Duration::from_millis(200);
/// Period of the tables of all keyframes' poses, 40 bytes each.
const PLACES_PERIOD: Duration = Duration::from_millis(200);
/// Minimum time between two revisions of the same keyframe.
const REVISION_PERIOD: Duration = Duration::from_secs(1);
/// Images wider than this are halved: the page shows them no larger.
const MAX_IMAGE_WIDTH: usize = 800;

/// Settings of a stream.
#[derive(Debug, Clone)]
pub struct StreamOptions {
    /// Name of the instance.
    pub instance: String,
    /// Maximum rate of images.
    pub image_rate_hz: f64,
}

/// A message from a page.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct PageMessage {
    /// Large messages received since its last message.
    ack: usize,
    /// Whether it shows images.
    frames: Option<bool>,
}

/// Sends until the page is closed, accepts nothing for too long, or `is_over`.
pub fn serve(
    mut socket: WebSocket<TcpStream>,
    scene: &Scene,
    options: &StreamOptions,
    is_over: &AtomicBool,
) -> Result<(), Error> {
    socket.get_ref().set_read_timeout(Some(READ_TIME))?;
    socket.get_ref().set_write_timeout(Some(LONGEST_WRITE))?;
    socket.get_ref().set_nodelay(true)?;
    let hello = json!({ "kind": "hello", "version": env!("CARGO_PKG_VERSION"), "protocol": 1, "instance": options.instance });
    socket.send(text(&hello))?;
    let mut sent = Sent { shows_frames: true, ..Sent::default() };
    let mut version = u64::MAX;
    let mut period = BUSY_PERIOD;
    while !is_over.load(Ordering::Relaxed) {
        if !listen(&mut socket, &mut sent)? {
            return Ok(());
        }
        let mut outgoing = Vec::new();
        {
            let state = scene.wait(version, period);
            version = state.version;
            sent.collect(&state, options, &mut outgoing);
        }
        period = if outgoing.is_empty() && !sent.has_more { QUIET_PERIOD } else { BUSY_PERIOD };
        for message in outgoing {
            let Some(message) = message.encode() else { continue };
            socket.send(message)?;
        }
    }
    socket.close(None)?;
    socket.flush()
}

/// Reads the page's messages; `false` once it is closed.
fn listen(socket: &mut WebSocket<TcpStream>, sent: &mut Sent) -> Result<bool, Error> {
    loop {
        match socket.read() {
            Ok(Message::Text(said)) => {
                // An unknown message is treated as empty.
                let said: PageMessage = serde_json::from_str(said.as_str()).unwrap_or_default();
                sent.unanswered = sent.unanswered.saturating_sub(said.ack);
                sent.shows_frames = said.frames.unwrap_or(sent.shows_frames);
            }
            Ok(Message::Close(_)) => return Ok(false),
            Ok(_) => {}
            Err(Error::ConnectionClosed | Error::AlreadyClosed) => return Ok(false),
            Err(Error::Io(error)) if error.kind() == std::io::ErrorKind::WouldBlock => {
                return Ok(true);
            }
            Err(error) => return Err(error),
        }
    }
}

/// A message that consists of a header only.
fn text(header: &Value) -> Message {
    Message::text(header.to_string())
}

/// Something to send; encoded after the lock on the scene is released.
enum Outgoing {
    Text(Value),
    Bytes(Value, Vec<u8>),
    Keyframe(Arc<Packed>),
    Frame(NewestFrame),
}

impl Outgoing {
    fn encode(self) -> Option<Message> {
        match self {
            Self::Text(header) => Some(text(&header)),
            Self::Bytes(header, bytes) => Some(Message::binary(framed(&header, &bytes))),
            Self::Keyframe(packed) => Some(Message::binary(framed(&packed.header, &packed.points))),
            Self::Frame(newest) => {
                let image = newest.jpeg.get_or_init(|| jpeg_of(&newest));
                let header = &newest.frame.header;
                (!image.is_empty()).then(|| {
                    let header = json!({
                        "kind": "frame",
                        "sequence": header.sequence,
                        "t": header.capture_nanos as f64 * 1e-9,
                        "k": header.intrinsics,
                        "size": [header.width, header.height],
                        "pose": newest.pose.as_deref().map(pose_json),
                    });
                    Message::binary(framed(&header, image))
                })
            }
        }
    }
}

/// The image as JPEG, halved if wide; empty if it cannot be encoded.
fn jpeg_of(newest: &NewestFrame) -> Vec<u8> {
    let header = &newest.frame.header;
    let (mut width, mut height) = (header.width as usize, header.height as usize);
    let mut pixels: Vec<u8> = newest.frame.pixels.to_vec();
    while width > MAX_IMAGE_WIDTH {
        pixels = halved(&pixels, width, height);
        (width, height) = (width / 2, height / 2);
    }
    jpeg(width as u32, height as u32, &pixels)
        .inspect_err(|error| tracing::debug!("{error}"))
        .unwrap_or_default()
}

/// An image of half the size, each pixel the mean of four.
fn halved(pixels: &[u8], width: usize, height: usize) -> Vec<u8> {
    let at = |x: usize, y: usize| u16::from(pixels[y * width + x]);
    let mean = |x: usize, y: usize| {
        (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1)).div_euclid(4) as u8
    };
    (0..height / 2).flat_map(|y| (0..width / 2).map(move |x| mean(2 * x, 2 * y))).collect()
}

/// What a page has received so far.
#[derive(Debug, Default)]
struct Sent {
    run: Option<u64>,
    run_text: Option<Value>,
    pose: u64,
    reports: u64,
    placed: u64,
    placed_at: LastTime,
    path: (u64, usize),
    path_at: LastTime,
    frame: u64,
    frame_at: LastTime,
    /// Revision of each keyframe, and when it was sent.
    keyframes: HashMap<u64, (u64, Instant)>,
    unanswered: usize,
    shows_frames: bool,
    has_more: bool,
}

impl Sent {
    /// Collects what is new for the page, most urgent first, with at most one keyframe.
    fn collect(&mut self, state: &State, options: &StreamOptions, out: &mut Vec<Outgoing>) {
        if self.run != Some(state.run) {
            // The page's state belongs to another run.
            let (unanswered, shows_frames) = (self.unanswered, self.shows_frames);
            *self = Self { run: Some(state.run), unanswered, shows_frames, ..Self::default() };
        }
        let run = state.run_json();
        if self.run_text.as_ref() != Some(&run) {
            out.push(Outgoing::Text(run.clone()));
            self.run_text = Some(run);
        }
        if self.reports != state.reports {
            self.reports = state.reports;
            let processes: Vec<Value> =
                state.health.iter().map(|(process, health)| health_json(process, health)).collect();
            out.push(Outgoing::Text(json!({ "kind": "health", "processes": processes })));
        }
        if let Some((number, pose)) = &state.pose
            && *number != self.pose
        {
            self.pose = *number;
            out.push(Outgoing::Text(pose_json(pose)));
        }
        self.collect_places(state, out);
        self.collect_frame(state, options, out);
        self.collect_keyframe(state, out);
    }

    fn collect_places(&mut self, state: &State, out: &mut Vec<Outgoing>) {
        if self.placed != state.placed && self.placed_at.is_due(PLACES_PERIOD) {
            self.placed = state.placed;
            out.push(Outgoing::Bytes(json!({ "kind": "places" }), state.places_bytes()));
        }
        let (generation, length) = self.path;
        let is_void = generation != state.path.generation;
        if (is_void || length != state.path.num_poses()) && self.path_at.is_due(PATH_PERIOD) {
            let from = if is_void { 0 } else { length };
            let header = json!({ "kind": "path", "from": from });
            out.push(Outgoing::Bytes(header, state.path.bytes_from(from)));
            self.path = (state.path.generation, state.path.num_poses());
        }
    }

    fn collect_frame(&mut self, state: &State, options: &StreamOptions, out: &mut Vec<Outgoing>) {
        let Some(newest) = &state.frame else { return };
        let period = Duration::from_secs_f64(1.0 / options.image_rate_hz);
        let is_new = newest.number != self.frame && self.unanswered < MAX_UNANSWERED;
        if self.shows_frames && is_new && self.frame_at.is_due(period) {
            self.frame = newest.number;
            self.unanswered += 1;
            out.push(Outgoing::Frame(newest.clone()));
        }
    }

    fn collect_keyframe(&mut self, state: &State, out: &mut Vec<Outgoing>) {
        self.keyframes.retain(|id, _| state.keyframes.contains_key(id));
        // The active one first, then the newest.
        let active = state.active_id.and_then(|id| state.keyframes.get(&id));
        let all = active.into_iter().chain(state.keyframes.values().rev());
        let mut wanted = all.filter(|packed| match self.keyframes.get(&packed.keyframe_id) {
            None => true,
            Some((revision, at)) => *revision != packed.revision && at.elapsed() >= REVISION_PERIOD,
        });
        let next = wanted.next().map(Arc::clone);
        self.has_more = next.is_some();
        if let Some(packed) = next
            && self.unanswered < MAX_UNANSWERED
        {
            self.unanswered += 1;
            self.keyframes.insert(packed.keyframe_id, (packed.revision, Instant::now()));
            out.push(Outgoing::Keyframe(packed));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_is_halved_by_averaging() {
        assert_eq!(halved(&[0, 4, 9, 8, 12, 9], 3, 2), [6]);
        assert_eq!(halved(&[1; 16], 4, 4), [1; 4]);
    }
}
