//! Frames that are malformed, repeated, out of order or from an unusable camera: tracker and mapper count them, live
//! on, and process the valid ones that follow.

use crate::support::{Rig, end, signal, until};
use rustix::process::Signal;
use semidense::service::health::ProcessState;
use semidense::service::peers::Peer;
use semidense::wire::message::{FrameHeader, HealthMessage};
use semidense::wire::port::{Access, Hub, Publisher};
use semidense::wire::topic::{FRAME, MAPPER_HEALTH, TRACKER_HEALTH};

const SIDE: usize = 64;
/// Smaller than the mapper can use, yet a valid camera.
const SMALL_SIDE: usize = 16;

/// Substitute for capture.
struct Sender {
    frames: Publisher<u8, FrameHeader>,
    peers: [Peer; 2],
    _hub: Hub,
}

fn header(sequence: u64, side: usize) -> FrameHeader {
    FrameHeader {
        sequence,
        capture_nanos: 33_000_000 * sequence as i64,
        clock_nanos: 0,
        realtime_nanos: i64::MIN,
        sent_nanos: 0,
        exposure_nanos: 0,
        intrinsics: [50.0, 50.0, 0.5 * side as f64, 0.5 * side as f64],
        width: side as u32,
        height: side as u32,
        stride: side as u32,
        gain: 0.0,
    }
}

impl Sender {
    fn new(rig: &Rig) -> Self {
        let hub = Hub::join(&rig.place(), "capture", Access::Member).unwrap();
        let open = |topic| Peer::open(&hub, topic).unwrap();
        let peers = [open(&TRACKER_HEALTH), open(&MAPPER_HEALTH)];
        Self { frames: hub.publisher(&FRAME, SIDE * SIDE).unwrap(), peers, _hub: hub }
    }

    /// Sends one frame, and waits until the health of both processes satisfies `count`.
    fn send(
        &mut self,
        header: FrameHeader,
        bytes: usize,
        what: &str,
        count: impl Fn(&HealthMessage) -> bool,
    ) {
        self.frames.send(header, &vec![128; bytes]).unwrap();
        for peer in &mut self.peers {
            let name = peer.name();
            until(&format!("{name}: {what}"), || {
                peer.update().unwrap().is_some_and(&count).then_some(())
            });
        }
    }
}

#[test]
fn invalid_frames_are_counted_and_the_next_valid_one_is_used() {
    let rig = Rig::new();
    let children =
        ["tracker", "mapper"].map(|name| rig.command(&[name, "--live"]).spawn().unwrap());
    let mut sender = Sender::new(&rig);
    for peer in &mut sender.peers {
        until("a process", || {
            peer.update().unwrap();
            peer.is_ready().then_some(())
        });
    }
    let good = |sequence| header(sequence, SIDE);
    let size = SIDE * SIDE;
    sender.send(good(10), size, "the first frame", |health| health.frames == 1);
    let nan = FrameHeader { intrinsics: [f64::NAN; 4], ..good(11) };
    sender.send(nan, size, "NaN", |health| health.refused == 1);
    let short = FrameHeader { height: u32::MAX, ..good(12) };
    sender.send(short, size, "a size that is not there", |health| health.refused == 2);
    sender.send(good(11), 7, "seven bytes", |health| health.refused == 3);
    sender.send(good(11), size, "what follows", |health| health.frames == 2);
    sender.send(good(11), size, "the same again", |health| health.disordered == 1);
    sender.send(good(9), size, "an older one", |health| health.disordered == 2);
    let leap = FrameHeader { capture_nanos: i64::MAX, ..good(12) };
    sender.send(leap, size, "a leap of the clock", |health| health.disordered == 3);
    sender.send(good(13), size, "and back", |health| health.disordered == 4 && health.frames == 4);
    // The tracker accepts it, the mapper reports why it does not.
    let small = header(14, SMALL_SIDE);
    let bytes = SMALL_SIDE * SMALL_SIDE;
    sender.send(small, bytes, "a tiny camera", |health| health.frames + health.refused >= 8);
    sender.send(good(15), size, "the camera before", |health| health.frames >= 5);
    for peer in &mut sender.peers {
        peer.update().unwrap();
        // Stale if the next frame has been waited for too long already.
        let state = peer.state();
        let lives = matches!(state, Some(ProcessState::Running | ProcessState::Stale));
        assert!(lives, "{}: {state:?}", peer.name());
    }
    drop(sender);
    for child in children {
        signal(&child, Signal::TERM);
        let ended = end(child);
        assert!(ended.status.success(), "{}", ended.stderr);
    }
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}
