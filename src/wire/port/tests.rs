//! Two members of one instance in one process, and late subscribers.

use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::Path as StdPath;
use std::time::Instant;

use super::*;
use crate::wire::message::{FrameHeader, PoseMessage};
use crate::wire::topic::{FRAME, GRAPH, KEYFRAME, POSE, WIRE_VERSION};

const LONG: Duration = Duration::from_secs(600);

struct Rig {
    _folder: tempfile::TempDir,
    place: Place,
}

impl Rig {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        Self { _folder: folder, place }
    }

    fn join(&self, name: &str) -> Hub {
        Hub::join(&self.place, name, Access::Member).unwrap()
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        self.place.tidy();
    }
}

fn header(sequence: u64) -> FrameHeader {
    FrameHeader { sequence, ..FrameHeader::default() }
}

#[test]
fn a_frame_is_written_in_place_and_wakes_its_reader() {
    let rig = Rig::new();
    let (sender, receiver) = (rig.join("capture"), rig.join("tracker"));
    let frames = sender.publisher::<u8, FrameHeader>(&FRAME, 12).unwrap();
    let reader = receiver.subscriber::<u8, FrameHeader>(&FRAME).unwrap();
    let mut loan = frames.loan(12).unwrap();
    loan.bytes_mut().copy_from_slice(b"twelve bytes");
    loan.send(header(7)).unwrap();
    wait(&[reader.events()], None, LONG).unwrap();
    let received = reader.receive().unwrap().unwrap();
    assert_eq!((received.header().sequence, received.payload()), (7, &b"twelve bytes"[..]));
    assert!(reader.receive().unwrap().is_none());
}

#[test]
fn a_slow_reader_loses_the_oldest_messages_and_blocks_no_publisher() {
    let rig = Rig::new();
    let hub = rig.join("capture");
    let frames = hub.publisher::<u8, FrameHeader>(&FRAME, 1).unwrap();
    let reader = hub.subscriber::<u8, FrameHeader>(&FRAME).unwrap();
    for sequence in 0..100 {
        frames.send(header(sequence), &[0]).unwrap();
    }
    let oldest = reader.receive().unwrap().unwrap().header().sequence;
    assert_eq!(oldest, 100 - FRAME.buffer as u64);
    assert_eq!(reader.newest().unwrap().unwrap().header().sequence, 99);
}

/// A reader that keeps all but one of the messages it may hold still receives the newest.
#[test]
fn a_reader_that_holds_messages_still_gets_the_newest() {
    let rig = Rig::new();
    let hub = rig.join("capture");
    let frames = hub.publisher::<u8, FrameHeader>(&FRAME, 1).unwrap();
    let reader = hub.subscriber::<u8, FrameHeader>(&FRAME).unwrap();
    let mut held = Vec::new();
    for round in 0..FRAME.borrowed as u64 {
        (0..3).for_each(|number| frames.send(header(10 * round + number), &[0]).unwrap());
        held.push(reader.newest().unwrap().unwrap());
        assert_eq!(held[round as usize].header().sequence, 10 * round + 2);
        assert!(reader.newest().unwrap().is_none(), "it has been read");
    }
    frames.send(header(100), &[0]).unwrap();
    let error = reader.newest().unwrap_err().to_string();
    assert!(error.contains("capture/frame") && error.contains("Borrow"), "{error}");
    held.clear();
    assert_eq!(reader.newest().unwrap().unwrap().header().sequence, 100);
    // Keyframe topics have no slot for a second message next to the newest.
    let graphs = hub.publisher::<u64, ()>(&GRAPH, 1).unwrap();
    let reader = hub.subscriber::<u64, ()>(&GRAPH).unwrap();
    for number in 0..9 {
        graphs.send((), &[number]).unwrap();
        assert_eq!(reader.newest().unwrap().unwrap().payload(), [number]);
    }
}

#[test]
fn a_reader_that_finds_the_topic_full_is_told_its_subscribers() {
    let rig = Rig::new();
    let hub = rig.join("mapper");
    let _keyframes = hub.publisher::<u64, ()>(&KEYFRAME, 1).unwrap();
    let observers: Vec<Hub> = (0..KEYFRAME.subscribers)
        .map(|number| Hub::join(&rig.place, &format!("view-{number}"), Access::Observer).unwrap())
        .collect();
    let subscribe = |hub: &Hub| hub.subscriber::<u64, ()>(&KEYFRAME);
    let mut open: Vec<_> = observers.iter().map(|hub| subscribe(hub).unwrap()).collect();
    for access in [Access::Observer, Access::Member] {
        let late = Hub::join(&rig.place, "late", access).unwrap();
        let error = subscribe(&late).unwrap_err();
        assert!(!error.is_absence(), "it runs: {error}");
        let text = error.to_string();
        let begin = format!(
            "topic rig/v{WIRE_VERSION}/mapper/keyframe already has its maximum of 6 subscribers: stop one of view-"
        );
        assert!(text.starts_with(&begin), "{text}");
        let own = format!("view-5 (process {})", std::process::id());
        assert!(text.contains(&own) && !text.contains("late"), "{text}");
    }
    open.pop();
    assert!(subscribe(&Hub::join(&rig.place, "late", Access::Observer).unwrap()).is_ok());
}

#[test]
fn an_observer_with_other_types_is_not_told_that_nothing_runs() {
    let rig = Rig::new();
    let hub = rig.join("tracker");
    let _poses = hub.publisher::<PoseMessage, ()>(&POSE, 1).unwrap();
    let observer = Hub::join(&rig.place, "observer", Access::Observer).unwrap();
    let error = observer.subscriber::<u64, ()>(&POSE).unwrap_err();
    assert!(!error.is_absence() && error.to_string().contains("IncompatibleTypes"), "{error}");
    let absent = observer.subscriber::<u64, ()>(&KEYFRAME).unwrap_err();
    assert!(absent.is_absence(), "{absent}");
}

#[test]
fn a_late_subscriber_gets_the_history() {
    let rig = Rig::new();
    let hub = rig.join("tracker");
    let poses = hub.publisher::<u64, ()>(&POSE, 1).unwrap();
    poses.send((), &[1]).unwrap();
    poses.send((), &[2]).unwrap();
    let observer = Hub::join(&rig.place, "observer", Access::Observer).unwrap();
    let late = observer.subscriber::<u64, ()>(&POSE).unwrap();
    poses.serve_late_joiners();
    assert_eq!(late.receive().unwrap().unwrap().payload(), [2]);
}

#[test]
fn other_types_and_absent_services_are_refused() {
    let rig = Rig::new();
    let observer = Hub::join(&rig.place, "observer", Access::Observer);
    assert!(matches!(observer, Err(OpenError::NotRunning { .. })));
    let hub = rig.join("tracker");
    let _poses = hub.publisher::<PoseMessage, ()>(&POSE, 1).unwrap();
    let other = hub.subscriber::<u64, ()>(&POSE).unwrap_err().to_string();
    assert!(other.starts_with(&format!("topic rig/v{WIRE_VERSION}/tracker/pose")), "{other}");
}

#[test]
fn another_wire_version_is_refused_with_both_versions() {
    let rig = Rig::new();
    let hub = rig.join("tracker");
    let name = ServiceName::new("rig/v1/tracker/pose").unwrap();
    let service = hub.node.service_builder(&name).publish_subscribe::<[u64]>().open_or_create();
    for access in [Access::Member, Access::Observer] {
        let error = Hub::join(&rig.place, "observer", access).unwrap_err().to_string();
        assert!(
            error.contains(&format!("uses wire version 1, this program {WIRE_VERSION}")),
            "{error}"
        );
    }
    drop(service);
    assert!(Hub::join(&rig.place, "observer", Access::Member).is_ok());
}

#[test]
fn an_interrupt_ends_the_wait() {
    let (readable, writable) = UnixStream::pair().unwrap();
    drop(writable);
    let start = Instant::now();
    wait(&[], Some(readable.as_fd()), LONG).unwrap();
    assert!(start.elapsed() < LONG / 2, "it waited for the timeout");
}

#[test]
fn nothing_is_left_behind() {
    let rig = Rig::new();
    let hub = rig.join("capture");
    let frames = hub.publisher::<u8, FrameHeader>(&FRAME, 1).unwrap();
    frames.send(header(0), &[0]).unwrap();
    rig.place.tidy();
    assert!(shared_memory(&rig.place) > 0, "it is still in use");
    drop((hub, frames));
    rig.place.tidy();
    assert_eq!(shared_memory(&rig.place), 0);
    assert_eq!(std::fs::read_dir(&rig.place.root).unwrap().count(), 0);
}

/// Files of this place in shared memory.
fn shared_memory(place: &Place) -> usize {
    let names = std::fs::read_dir(StdPath::new(crate::wire::folders::SHARED_MEMORY)).unwrap();
    let ours = |name: &str| name.starts_with(&place.prefix);
    names.filter(|name| ours(&name.as_ref().unwrap().file_name().to_string_lossy())).count()
}

#[test]
fn the_configuration_file_for_other_tools_matches_ours() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/config/iceoryx2.toml");
    let file = Config::from_file(&FilePath::new(path.as_bytes()).unwrap()).unwrap();
    let place = Place::new("semidense", crate::wire::folders::SYSTEM_ROOT).unwrap();
    assert_eq!(file, place.transport_config().unwrap());
}
