//! The table of topics: publisher, content and number of subscribers, and the shared memory that they take.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{DepthPoint, MAX_KEYFRAME_POINTS};
use crate::wire::message::{
    AdjustmentMessage, FrameHeader, GraphHeader, HealthMessage, KeyframeHeader,
    KeyframeImageHeader, KeyframePoseMessage, PoseMessage, StepMessage,
};

/// Version in every topic's name; incremented when a message changes.
pub const WIRE_VERSION: u32 = 11;

/// Maximum number of keyframes in one message of `mapper/graph`; if there are more, the newest are sent.
pub const MAX_GRAPH_KEYFRAMES: usize = 4096;

/// One data topic with its quality of service. Its wake-up event has the same name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Topic {
    /// The process that publishes it.
    pub owner: &'static str,
    /// Its content, as named in the topic's name.
    pub noun: &'static str,
    /// Maximum number of subscribers: our own processes, and four observers (page, recorder, ROS 2, second machine);
    /// more for small messages.
    pub subscribers: usize,
    /// Unread messages that a subscriber buffers; the oldest are dropped first.
    pub buffer: usize,
    /// Messages a subscriber may hold at a time.
    pub borrowed: usize,
    /// Messages that a late subscriber still receives.
    pub history: usize,
    /// Messages that the publisher may write at a time.
    pub loans: usize,
}

/// Frames, for tracker, mapper and four observers: the mapper keeps some while their poses are computed.
pub const FRAME: Topic = Topic {
    owner: "capture",
    noun: "frame",
    subscribers: 6,
    buffer: 4,
    borrowed: 4,
    history: 0,
    loans: 2,
};
/// Poses, for mapper, journal, capture, four observers, `status` and one program of the user: small, so the buffer is
/// deep enough that a recorder that stalls for 30 s at 30 Hz loses none.
pub const POSE: Topic = Topic {
    owner: "tracker",
    noun: "pose",
    subscribers: 9,
    buffer: 900,
    borrowed: 2,
    history: 1,
    loans: 2,
};
/// Depth of the active keyframe, for tracker, journal and four observers: only the newest counts. It takes up to 1.6
/// MB, so a subscriber holds one at a time and copies it to keep it.
pub const KEYFRAME: Topic = Topic {
    owner: "mapper",
    noun: "keyframe",
    subscribers: 6,
    buffer: 1,
    borrowed: 1,
    history: 1,
    loans: 1,
};
/// Image of the active keyframe.
pub const KEYFRAME_IMAGE: Topic = Topic { noun: "keyframe_image", ..KEYFRAME };
/// Depth of a keyframe that is not the active one, for the one reader that requests it: whenever the map's graph has a
/// different revision of it than the reader.
pub const EARLIER_KEYFRAME: Topic =
    Topic { noun: "earlier_keyframe", subscribers: 1, history: 0, ..KEYFRAME };
/// Image of that keyframe.
pub const EARLIER_KEYFRAME_IMAGE: Topic =
    Topic { noun: "earlier_keyframe_image", ..EARLIER_KEYFRAME };
/// Frames that have entered the map, for capture, tracker, journal and three others.
pub const STEP: Topic = Topic { owner: "mapper", noun: "step", subscribers: 6, ..POSE };
/// Joint estimates of keyframes: a few per second.
pub const ADJUSTMENT: Topic = Topic { owner: "mapper", noun: "adjustment", buffer: 64, ..POSE };
/// Poses of all keyframes.
pub const GRAPH: Topic = Topic { noun: "graph", ..KEYFRAME };
/// Health of capture. Every health topic is for two of our own processes, supervisor, four observers and some that read it once.
pub const CAPTURE_HEALTH: Topic = Topic {
    owner: "capture",
    noun: "health",
    subscribers: 10,
    buffer: 4,
    borrowed: 2,
    history: 1,
    loans: 1,
};
/// Health of the tracker.
pub const TRACKER_HEALTH: Topic = Topic { owner: "tracker", ..CAPTURE_HEALTH };
/// Health of the mapper.
pub const MAPPER_HEALTH: Topic = Topic { owner: "mapper", ..CAPTURE_HEALTH };

/// The health topics of all processes, in the order of the pipeline.
pub const HEALTH_TOPICS: [Topic; 3] = [CAPTURE_HEALTH, TRACKER_HEALTH, MAPPER_HEALTH];

/// The request/response service of the mapper.
pub const MAPPER_COMMAND: &str = "mapper/command";

/// Bytes that iceoryx2 adds to each message: its own header and alignment.
const CHUNK_OVERHEAD_BYTES: usize = 128;

impl Topic {
    /// Number of messages that the publisher reserves room for.
    pub fn chunks(&self) -> usize {
        self.subscribers * (self.buffer + self.borrowed) + self.history + self.loans
    }

    /// Shared memory of the topic, bytes, for messages of `message_bytes`.
    pub fn bytes(&self, message_bytes: usize) -> u64 {
        (self.chunks() * (message_bytes + CHUNK_OVERHEAD_BYTES)) as u64
    }

    /// Name of the service: `<instance>/v<wire version>/<owner>/<noun>`.
    pub fn service_name(&self, instance: &str) -> String {
        service_name(instance, &format!("{}/{}", self.owner, self.noun))
    }
}

/// Name of a service: `<instance>/v<wire version>/<path>`.
pub fn service_name(instance: &str, path: &str) -> String {
    format!("{instance}/v{WIRE_VERSION}/{path}")
}

/// Every data topic with the bytes of its largest message, for images of this size.
pub fn table(intrinsics: &Intrinsics) -> Vec<(Topic, usize)> {
    let image = intrinsics.width * intrinsics.height;
    let points = MAX_KEYFRAME_POINTS * size_of::<DepthPoint>();
    let graph = MAX_GRAPH_KEYFRAMES * size_of::<KeyframePoseMessage>();
    vec![
        (FRAME, size_of::<FrameHeader>() + image),
        (POSE, size_of::<PoseMessage>()),
        (KEYFRAME, size_of::<KeyframeHeader>() + points),
        (KEYFRAME_IMAGE, size_of::<KeyframeImageHeader>() + image),
        (EARLIER_KEYFRAME, size_of::<KeyframeHeader>() + points),
        (EARLIER_KEYFRAME_IMAGE, size_of::<KeyframeImageHeader>() + image),
        (STEP, size_of::<StepMessage>()),
        (ADJUSTMENT, size_of::<AdjustmentMessage>()),
        (GRAPH, size_of::<GraphHeader>() + graph),
        (CAPTURE_HEALTH, size_of::<HealthMessage>()),
        (TRACKER_HEALTH, size_of::<HealthMessage>()),
        (MAPPER_HEALTH, size_of::<HealthMessage>()),
    ]
}

/// Shared memory of the topics of `owner`, bytes, for images of this size; of all topics for `None`.
pub fn shared_memory_bytes(intrinsics: &Intrinsics, owner: Option<&str>) -> u64 {
    let wanted = |topic: &Topic| owner.is_none_or(|owner| topic.owner == owner);
    table(intrinsics).iter().filter(|(t, _)| wanted(t)).map(|(t, bytes)| t.bytes(*bytes)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn intrinsics(width: usize, height: usize) -> Intrinsics {
        Intrinsics { fx: 500.0, fy: 500.0, cx: 300.0, cy: 200.0, width, height }
    }

    #[test]
    fn a_common_camera_fits_into_the_smallest_common_shared_memory() {
        // A container gets 64 MiB.
        let sum = shared_memory_bytes(&intrinsics(640, 480), None);
        assert!(sum < 64 << 20, "{sum} bytes");
        let large = shared_memory_bytes(&intrinsics(1280, 720), None);
        assert!(large < 128 << 20, "{large} bytes");
        // The figures in docs/operations.md and of `semidense doctor`.
        assert_eq!([sum, large].map(|bytes| (bytes >> 20) + 1), [62, 101]);
    }

    #[test]
    fn names_are_unique_and_carry_the_version() {
        let mut names: Vec<_> =
            table(&intrinsics(640, 480)).iter().map(|(t, _)| t.service_name("rig1")).collect();
        assert!(names.contains(&format!("rig1/v{WIRE_VERSION}/capture/frame")));
        names.sort();
        names.dedup();
        assert_eq!(names.len(), 12);
    }

    #[test]
    fn a_buffer_holds_the_history() {
        for (topic, _) in table(&intrinsics(640, 480)) {
            assert!(topic.buffer >= topic.history, "{topic:?}");
        }
    }
}
