//! The kinds of messages on the network: one for each topic, and the sender's presence.

use semidense::wire::topic::{
    ADJUSTMENT, CAPTURE_HEALTH, FRAME, GRAPH, KEYFRAME, KEYFRAME_IMAGE, MAPPER_HEALTH, POSE,
    TRACKER_HEALTH, Topic,
};
use zenoh::qos::Priority;

/// First part of every key.
pub const KEY_PREFIX: &str = "semidense";

/// The kind of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `tracker/pose`.
    Pose,
    /// `capture/health`.
    CaptureHealth,
    /// `tracker/health`.
    TrackerHealth,
    /// `mapper/health`.
    MapperHealth,
    /// `mapper/adjustment`.
    Adjustment,
    /// `mapper/graph`.
    Graph,
    /// `mapper/keyframe_image`.
    KeyframeImage,
    /// `mapper/keyframe`.
    Keyframe,
    /// `capture/frame`, as JPEG.
    Frame,
    /// The sender's presence, its clock, and the number of the newest message of each kind.
    Presence,
}

impl Kind {
    /// All kinds, by code.
    pub const ALL: [Self; 10] = [
        Self::Pose,
        Self::CaptureHealth,
        Self::TrackerHealth,
        Self::MapperHealth,
        Self::Adjustment,
        Self::Graph,
        Self::KeyframeImage,
        Self::Keyframe,
        Self::Frame,
        Self::Presence,
    ];
    /// The number of kinds.
    pub const COUNT: usize = Self::ALL.len();
    /// Health of each process, in pipeline order.
    pub const HEALTH: [Self; 3] = [Self::CaptureHealth, Self::TrackerHealth, Self::MapperHealth];

    /// The code of this kind in an envelope.
    pub fn code(self) -> u32 {
        self as u32
    }

    /// The kind with this code; `None` for an unknown code.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.get(code as usize).copied()
    }

    /// The health kind of the process with this name.
    pub fn of_health(owner: &str) -> Option<Self> {
        Self::HEALTH.into_iter().find(|kind| kind.topic().is_some_and(|t| t.owner == owner))
    }

    /// The topic in shared memory; `None` for presence.
    pub fn topic(self) -> Option<Topic> {
        Some(match self {
            Self::Pose => POSE,
            Self::CaptureHealth => CAPTURE_HEALTH,
            Self::TrackerHealth => TRACKER_HEALTH,
            Self::MapperHealth => MAPPER_HEALTH,
            Self::Adjustment => ADJUSTMENT,
            Self::Graph => GRAPH,
            Self::KeyframeImage => KEYFRAME_IMAGE,
            Self::Keyframe => KEYFRAME,
            Self::Frame => FRAME,
            Self::Presence => return None,
        })
    }

    /// Key of this kind for `instance`: `semidense/INSTANCE/OWNER/NOUN`. The wire version is in the envelope,
    /// so that another version is refused explicitly and not silently missed.
    pub fn key(self, instance: &str) -> String {
        match self.topic() {
            Some(topic) => format!("{KEY_PREFIX}/{instance}/{}/{}", topic.owner, topic.noun),
            None => format!("{KEY_PREFIX}/{instance}/presence"),
        }
    }

    /// Whether the last message is kept for receivers that start late or lost it.
    pub fn is_kept(self) -> bool {
        Self::HEALTH.contains(&self)
            || matches!(self, Self::Graph | Self::KeyframeImage | Self::Keyframe)
    }

    /// Whether it is sent at once, on a thread that never packs large messages.
    pub fn is_urgent(self) -> bool {
        self == Self::Pose || Self::HEALTH.contains(&self)
    }

    /// Priority of this kind on the network.
    pub fn priority(self) -> Priority {
        match self {
            Self::Pose | Self::Presence => Priority::RealTime,
            Self::CaptureHealth | Self::TrackerHealth | Self::MapperHealth => {
                Priority::InteractiveHigh
            }
            Self::Adjustment | Self::Graph => Priority::Data,
            Self::KeyframeImage | Self::Keyframe => Priority::DataLow,
            Self::Frame => Priority::Background,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_and_keys_match_the_topics() {
        for (code, kind) in Kind::ALL.into_iter().enumerate() {
            assert_eq!((kind.code() as usize, Kind::from_code(kind.code())), (code, Some(kind)));
        }
        assert_eq!(Kind::from_code(Kind::COUNT as u32), None);
        assert_eq!(Kind::Pose.key("rig"), "semidense/rig/tracker/pose");
        assert_eq!(Kind::Presence.key("rig"), "semidense/rig/presence");
        assert_eq!(Kind::of_health("mapper"), Some(Kind::MapperHealth));
    }
}
