//! The topics, with the quality of service that ROS users expect.

use crate::ros::message::{
    CameraInfo, CompressedImage, DiagnosticArray, Image, Odometry, PointCloud2, PoseArray,
    PoseWithCovarianceStamped, RosMessage, TfMessage,
};
use crate::ros::own_message::{FrameRecord, GraphRecord, KeyframeRecord, PoseRecord};

/// Whether messages are resent until they arrive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reliability {
    /// Messages are resent.
    Reliable,
    /// Messages are not resent: the next one is newer anyway.
    BestEffort,
}

/// What a late subscriber receives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Durability {
    /// Only later messages.
    Volatile,
    /// Also the last message.
    TransientLocal,
}

/// A ROS topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RosTopic {
    /// Name; one that begins with `/` is the same for every instance, others are below the instance's name.
    pub name: &'static str,
    /// Type, such as `nav_msgs/Odometry`.
    pub message_type: &'static str,
    /// Whether messages are resent until they arrive.
    pub reliability: Reliability,
    /// What a late subscriber receives.
    pub durability: Durability,
    /// Queue depth for a slow subscriber, messages.
    pub depth: usize,
}

impl RosTopic {
    /// The full name for an instance.
    pub fn full_name(&self, instance: &str) -> String {
        self.name_in(&namespace(instance))
    }

    /// The full name in a namespace, which begins with `/`.
    pub fn name_in(&self, namespace: &str) -> String {
        if self.name.starts_with('/') {
            self.name.to_owned()
        } else {
            format!("{}/{}", namespace.trim_end_matches('/'), self.name)
        }
    }
}

/// The namespace of an instance's topics: ROS allows letters, digits and `_`, but no leading digit.
pub fn namespace(instance: &str) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    let name: String = instance.chars().map(allowed).collect();
    let is_whole = name.starts_with(|c: char| c.is_ascii_alphabetic());
    format!("/{}{name}", if is_whole { "" } else { "rig_" })
}

const fn sensor<T: RosMessage>(name: &'static str, depth: usize) -> RosTopic {
    RosTopic { reliability: Reliability::BestEffort, ..reliable::<T>(name, depth) }
}

const fn reliable<T: RosMessage>(name: &'static str, depth: usize) -> RosTopic {
    let (reliability, durability) = (Reliability::Reliable, Durability::Volatile);
    RosTopic { name, message_type: T::TYPE, reliability, durability, depth }
}

/// A topic whose last message is kept for late subscribers.
const fn latched<T: RosMessage>(name: &'static str) -> RosTopic {
    RosTopic { durability: Durability::TransientLocal, ..reliable::<T>(name, 1) }
}

/// Queue depth of camera topics: ROS's profile for sensor data.
const SENSOR_DEPTH: usize = 5;
/// Queue depth of transforms: that of tf2.
const TF_DEPTH: usize = 100;
/// Queue depth of poses and others: ROS's default.
const DEFAULT_DEPTH: usize = 10;

/// The pose in the map, with covariance: the best estimate, may step when the map is revised.
pub const POSE: RosTopic = reliable::<PoseWithCovarianceStamped>("pose", DEFAULT_DEPTH);
/// Odometry: never jumps within an epoch, drifts.
pub const ODOMETRY: RosTopic = reliable::<Odometry>("odom", DEFAULT_DEPTH);
/// map → odom → camera.
pub const TF: RosTopic = reliable::<TfMessage>("/tf", TF_DEPTH);
/// The camera's body axes in its optical frame; never changes.
pub const TF_STATIC: RosTopic = latched::<TfMessage>("/tf_static");
/// The active keyframe's depth as points in the map.
pub const POINTS: RosTopic = sensor::<PointCloud2>("points", SENSOR_DEPTH);
/// The camera's image, rectified, grey.
pub const IMAGE: RosTopic = sensor::<Image>("image_rect", SENSOR_DEPTH);
/// The same, as JPEG or PNG.
pub const COMPRESSED_IMAGE: RosTopic =
    sensor::<CompressedImage>("image_rect/compressed", SENSOR_DEPTH);
/// Intrinsics of the image.
pub const CAMERA_INFO: RosTopic = sensor::<CameraInfo>("camera_info", SENSOR_DEPTH);
/// Poses of all keyframes in the map; a late subscriber receives the last message.
pub const KEYFRAMES: RosTopic = latched::<PoseArray>("keyframes");
/// Health of the three processes.
pub const DIAGNOSTICS: RosTopic = reliable::<DiagnosticArray>("/diagnostics", DEFAULT_DEPTH);

/// The properties of each image that do not fit into `sensor_msgs`.
pub const FRAME_RECORDS: RosTopic = reliable::<FrameRecord>("details/frame", DEFAULT_DEPTH);
/// All fields of each pose.
pub const POSE_RECORDS: RosTopic = reliable::<PoseRecord>("details/pose", DEFAULT_DEPTH);
/// The properties of a keyframe besides its points.
pub const KEYFRAME_RECORDS: RosTopic =
    reliable::<KeyframeRecord>("details/keyframe", DEFAULT_DEPTH);
/// The properties of the map's graph besides poses.
pub const GRAPH_RECORDS: RosTopic = reliable::<GraphRecord>("details/graph", DEFAULT_DEPTH);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::schema::{schema, type_hash};

    /// The topics whose types are ROS's.
    const TOPICS: [RosTopic; 9] =
        [POSE, ODOMETRY, TF, POINTS, IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, KEYFRAMES, DIAGNOSTICS];

    #[test]
    fn names_follow_the_rules_of_ros_and_types_are_known() {
        assert_eq!(POSE.full_name("semidense"), "/semidense/pose");
        assert_eq!(POSE.full_name("2-left"), "/rig_2_left/pose");
        assert_eq!(TF.full_name("left"), "/tf");
        for topic in TOPICS {
            assert!(schema(topic.message_type).is_some(), "{}", topic.name);
            assert!(type_hash(topic.message_type).is_some(), "{}", topic.name);
        }
    }
}
