//! The quality of service of a topic as `rosbag2` notes it in a recording, so that `ros2 bag play` offers the same.

use crate::ros::topic::{Durability, Reliability, RosTopic};

/// The note of a topic, YAML, with the numbers of `rmw`'s enumerations. Distributions since Jazzy write names, and read
/// numbers where the recording has a metadata record `rosbag2` without a version of its own.
pub fn offered_qos_profiles(topic: &RosTopic) -> String {
    /// `rmw`'s numbers: keep the last messages.
    const KEEP_LAST: u32 = 1;
    /// Liveliness by the middleware itself.
    const AUTOMATIC: u32 = 1;
    let reliability = match topic.reliability {
        Reliability::Reliable => 1,
        Reliability::BestEffort => 2,
    };
    let durability = match topic.durability {
        Durability::TransientLocal => 1,
        Durability::Volatile => 2,
    };
    let unlimited = "\n    sec: 9223372036\n    nsec: 854775807";
    format!(
        "- history: {KEEP_LAST}\n  depth: {}\n  reliability: {reliability}\n  durability: {durability}\n  \
         deadline:{unlimited}\n  lifespan:{unlimited}\n  liveliness: {AUTOMATIC}\n  \
         liveliness_lease_duration:{unlimited}\n  avoid_ros_namespace_conventions: false",
        topic.depth
    )
}
