//! A topic's quality of service as `rosbag2` stores it in a recording, so that `ros2 bag play` offers the same.

use crate::ros::topic::{Durability, Reliability, RosTopic};

/// The profile of a topic as YAML, with the numbers of `rmw`'s enumerations. Distributions since Jazzy write
/// names, and read numbers if the recording has a metadata record `rosbag2` without its own version.
pub fn offered_qos_profiles(topic: &RosTopic) -> String {
    /// `rmw`'s number for keeping the last messages.
    const KEEP_LAST: u32 = 1;
    /// `rmw`'s number for liveliness asserted by the middleware.
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
