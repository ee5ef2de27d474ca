//! Messages from a hostile program or another version are refused, and the next valid message is used.
#![cfg(feature = "zenoh")]

mod support;

use std::net::TcpListener;
use std::process::Command;

use semidense::service::health::{ProcessState, cause};
use semidense::wire::message::{
    FrameHeader, GraphHeader, HealthMessage, KeyframeHeader, KeyframeImageHeader, PoseMessage,
};
use semidense::wire::port::Subscriber;
use semidense::wire::topic::{POSE, TRACKER_HEALTH, WIRE_VERSION};
use semidense_bridge::zenoh::envelope::{Envelope, Origin, Packed, Packing, seal};
use semidense_bridge::zenoh::kind::Kind;
use semidense_bridge::zenoh::link::{Endpoints, open};
use semidense_bridge::zenoh::outlet::Presence;
use support::machines::{Root, Running, bridge};
use support::until;
use zenoh::{Session, Wait};
use zerocopy::{FromZeros, Immutable, IntoBytes};

const ORIGIN: Origin = Origin { sender: 7, run: 1, sent_nanos: 0, realtime_offset_nanos: 0 };

/// A port that was free a moment ago.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// The network between the receiver of an instance and the attacking program.
struct Attack {
    session: Session,
    poses: Subscriber<PoseMessage, ()>,
    health: Subscriber<HealthMessage, ()>,
    receiver: Running,
    _root: Root,
}

impl Attack {
    fn begin() -> Self {
        let root = Root::new("far");
        let endpoint = format!("tcp/127.0.0.1:{}", free_port());
        let mut command = Command::new(bridge());
        command.args(["zenoh", "receive", "--from", "rig", "--as", "far", "--listen", &endpoint]);
        let receiver = Running::start(command, root.path());
        let hub = root.observe();
        let poses = until("poses", || hub.subscriber(&POSE).ok());
        let health = until("health", || hub.subscriber(&TRACKER_HEALTH).ok());
        let connect = vec![endpoint.parse().unwrap()];
        let session = open(&Endpoints { connect, ..Endpoints::default() }).unwrap();
        let attack = Self { session, poses, health, receiver, _root: root };
        // Until the link is up, everything sent is lost.
        let publisher = attack.session.declare_publisher(Kind::Frame.key("rig")).wait().unwrap();
        until("the link", || publisher.matching_status().wait().unwrap().matching().then_some(()));
        drop(publisher);
        attack
    }

    fn put(&self, kind: Kind, bytes: Vec<u8>) {
        self.session.put(kind.key("rig"), bytes).wait().unwrap();
    }

    fn put_message<T: IntoBytes + Immutable>(
        &self,
        kind: Kind,
        number: u64,
        message: &T,
        payload: &Packed,
    ) {
        self.put(kind, seal(&ORIGIN, kind, number, message, payload));
    }

    /// Checks that a valid pose arrives, and none before it.
    fn assert_works(&self, number: u64) {
        let pose = valid_pose(number);
        self.put_message(Kind::Pose, number, &pose, &Packed::empty());
        let arrived = until("the right pose", || self.poses.receive().unwrap());
        assert_eq!(arrived.payload()[0].sequence, pose.sequence, "{}", self.receiver.said());
    }
}

fn valid_pose(number: u64) -> PoseMessage {
    let mut pose = PoseMessage::new_zeroed();
    pose.sequence = 1_000_000 + number;
    for transform in
        [&mut pose.world_from_camera, &mut pose.map_from_camera, &mut pose.keyframe_from_camera]
    {
        transform[3] = 1.0;
    }
    pose
}

#[test]
fn malformed_messages_are_refused_and_valid_ones_still_arrive() {
    let mut attack = Attack::begin();
    let payload =
        |bytes: Vec<u8>, unpacked_bytes, packing| Packed { packing, unpacked_bytes, bytes };
    for length in [0, 1, 7, 8, 63, 64, 65, 100_000] {
        Kind::ALL.iter().for_each(|kind| attack.put(*kind, vec![0xA5; length]));
    }
    let mut pose = PoseMessage::new_zeroed();
    attack.put_message(Kind::Pose, 1, &pose, &Packed::empty());
    pose.world_from_camera = [f64::NAN; 7];
    attack.put_message(Kind::Pose, 2, &pose, &Packed::empty());
    attack.put_message(Kind::Pose, 3, &[0_u64; 3], &Packed::empty());
    let mut health = HealthMessage::new_zeroed();
    (health.state, health.cause_bytes) = (77, u32::MAX);
    attack.put_message(Kind::TrackerHealth, 1, &health, &Packed::empty());
    let large =
        KeyframeImageHeader { width: 8192, height: 8192, stride: 8192, ..Default::default() };
    let bomb = payload(vec![0xFF; 1 << 20], 8192 * 8192, Packing::Lz4);
    attack.put_message(Kind::KeyframeImage, 1, &large, &bomb);
    let endless =
        KeyframeImageHeader { width: u32::MAX, height: u32::MAX, stride: u32::MAX, ..large };
    attack.put_message(Kind::KeyframeImage, 2, &endless, &bomb);
    let points = payload(vec![1; 5000], 16 * 90_000, Packing::Lz4);
    attack.put_message(Kind::Keyframe, 1, &KeyframeHeader::default(), &points);
    let jpeg = payload(b"\xFF\xD8\xFF\xD9".to_vec(), 64 * 48, Packing::Jpeg);
    let frame = FrameHeader { width: 64, height: 48, stride: 64, ..Default::default() };
    attack.put_message(Kind::Frame, 1, &frame, &jpeg);
    let poses = payload(vec![0xFF; 80 * 3 + 1], 80 * 3 + 1, Packing::Plain);
    attack.put_message(Kind::Graph, 1, &GraphHeader::default(), &poses);
    attack.assert_works(10);
    // A message of another kind than its key, and one of a program that is not the current sender.
    attack
        .put(Kind::Pose, seal(&ORIGIN, Kind::Graph, 11, &GraphHeader::default(), &Packed::empty()));
    let other = Origin { sender: 8, ..ORIGIN };
    attack.put(Kind::Pose, seal(&other, Kind::Pose, 12, &valid_pose(12), &Packed::empty()));
    attack.assert_works(13);
    assert!(attack.receiver.interrupt(), "{}", attack.receiver.said());
}

#[test]
fn another_wire_version_is_refused_with_both_named() {
    let attack = Attack::begin();
    let other = WIRE_VERSION + 1;
    let presence = Presence { is_joined: 1, newest: [1; Kind::COUNT] };
    let mut bytes = seal(&ORIGIN, Kind::Presence, 0, &presence, &Packed::empty());
    bytes[size_of::<u32>()..2 * size_of::<u32>()].copy_from_slice(&other.to_le_bytes());
    // Whatever follows the version in that version.
    bytes.truncate(size_of::<Envelope>() - 8);
    let answer = move |query: zenoh::query::Query| {
        let _ = query.reply(query.key_expr().clone(), bytes.clone()).wait();
    };
    let key = Kind::Presence.key("rig");
    attack.session.declare_queryable(key).callback(answer).background().wait().unwrap();
    let both = format!("the robot uses wire version {other}, this program {WIRE_VERSION}");
    until(&both, || {
        let health = attack.health.newest().unwrap()?.payload()[0];
        (health.state == ProcessState::Stale.code() && cause(&health).starts_with(&both))
            .then_some(())
    });
    attack.receiver.wait_for(&both);
}

#[test]
fn peers_without_the_password_are_refused() {
    use std::os::unix::fs::PermissionsExt;
    let root = Root::new("far");
    let file = |name: &str, line: &str| {
        let path = root.path().join(name);
        std::fs::write(&path, line).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        path
    };
    let (right, wrong) = (file("right", "robot:correct\n"), file("wrong", "robot:guessed\n"));
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let mut command = Command::new(bridge());
    command.args(["zenoh", "receive", "--from", "rig", "--as", "far", "--listen", &endpoint]);
    command.arg("--password-file").arg(&right);
    let mut receiver = Running::start(command, root.path());
    let session = |password_file| {
        let connect = vec![endpoint.parse().unwrap()];
        open(&Endpoints { connect, password_file, ..Endpoints::default() }).unwrap()
    };
    let sessions = [session(None), session(Some(wrong)), session(Some(right.clone()))];
    let publishers = sessions
        .each_ref()
        .map(|session| session.declare_publisher(Kind::Pose.key("rig")).wait().unwrap());
    let is_linked = |place: usize| publishers[place].matching_status().wait().unwrap().matching();
    until("the link of who knows it", || is_linked(2).then_some(()));
    assert!(!is_linked(0) && !is_linked(1));
    assert!(receiver.interrupt(), "{}", receiver.said());
}
