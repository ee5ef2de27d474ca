//! Messages that ROS lacks: the values of shared memory without loss. Recordings carry their definitions,
//! from which every reader of `ros2msg` decodes them. Poses are in our axes (x right, y down, z forward).

use semidense::slam::keyframe::Keyframe;
use semidense::wire::conversion::similarity_message;
use semidense::wire::message::{FrameHeader, PoseMessage};
use serde::{Deserialize, Serialize};
use serde_big_array::BigArray;

use crate::ros::message::Header;
use crate::session::Graph;

/// `semidense_msgs/Frame`: properties of an image that `sensor_msgs` lacks. Replaying a recording uses these stamps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Stamp and frame of the image.
    pub header: Header,
    /// Number of the frame at its source.
    pub sequence: u64,
    /// Its stamp, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    /// CLOCK_MONOTONIC instant from which latency is measured.
    pub clock_nanos: i64,
    /// Exposure time in nanoseconds, 0 if unknown.
    pub exposure_nanos: u64,
    /// Sensor gain, 0 if unknown.
    pub gain: f32,
}

impl FrameRecord {
    /// Converts a frame's header.
    pub fn new(header: Header, frame: &FrameHeader) -> Self {
        let FrameHeader { sequence, capture_nanos, clock_nanos, exposure_nanos, gain, .. } = *frame;
        Self { header, sequence, capture_nanos, clock_nanos, exposure_nanos, gain }
    }
}

/// `semidense_msgs/Pose`: all fields of a pose, including one that is not claimed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseRecord {
    /// Stamp of the frame.
    pub header: Header,
    /// Sequence of the frame.
    pub sequence: u64,
    /// Stamp of the frame, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    /// Time from the frame's instant to publication.
    pub latency_nanos: u64,
    /// Time that tracking took.
    pub track_nanos: u64,
    /// Keyframe it was tracked on.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// Number of corrections of the map.
    pub map_revision: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// 0 initializing, 1 tracking, 2 degraded, 3 lost.
    pub state: u32,
    /// The reason, see `PoseMessage` in docs/topics.md.
    pub reason: u32,
    /// Odometry: quaternion x, y, z, w, then translation.
    pub world_from_camera: [f64; 7],
    /// In the map.
    pub map_from_camera: [f64; 7],
    /// Relative to the keyframe, in its unit.
    pub keyframe_from_camera: [f64; 7],
    /// Covariance of the left increment of `current_from_keyframe`: upper triangle, row-major.
    #[serde(with = "BigArray")]
    pub covariance: [f64; 21],
    /// Covariance of the left increment of `map_from_camera`.
    #[serde(with = "BigArray")]
    pub map_covariance: [f64; 21],
    /// 1 if the velocity is known.
    pub has_velocity: u32,
    /// Linear velocity of the camera in its own axes, world units per second.
    pub linear_velocity: [f64; 3],
    /// Angular velocity of the camera in its own axes, rad/s.
    pub angular_velocity: [f64; 3],
    /// Covariance of linear, then angular velocity: upper triangle, row-major.
    #[serde(with = "BigArray")]
    pub velocity_covariance: [f64; 21],
    /// Brightness relative to the keyframe: a, b.
    pub brightness: [f64; 2],
    /// Share of the keyframe's points in view.
    pub in_view_ratio: f64,
    /// Share of the compared points that are inliers.
    pub inlier_ratio: f64,
    /// Residual in grey levels.
    pub residual_rmse: f64,
    /// Points compared.
    pub points: u32,
    /// Iterations, all levels.
    pub iterations: u32,
}

impl PoseRecord {
    /// Converts a pose.
    pub fn new(header: Header, pose: &PoseMessage) -> Self {
        Self {
            header,
            sequence: pose.sequence,
            capture_nanos: pose.capture_nanos,
            latency_nanos: pose.latency_nanos,
            track_nanos: pose.track_nanos,
            keyframe_id: pose.keyframe_id,
            revision: pose.revision,
            map_revision: pose.map_revision,
            epoch: pose.epoch,
            state: pose.state,
            reason: pose.reason,
            world_from_camera: pose.world_from_camera,
            map_from_camera: pose.map_from_camera,
            keyframe_from_camera: pose.keyframe_from_camera,
            covariance: pose.covariance,
            map_covariance: pose.map_covariance,
            has_velocity: pose.has_velocity,
            linear_velocity: pose.linear_velocity,
            angular_velocity: pose.angular_velocity,
            velocity_covariance: pose.velocity_covariance,
            brightness: pose.brightness,
            in_view_ratio: pose.in_view_ratio,
            inlier_ratio: pose.inlier_ratio,
            residual_rmse: pose.residual_rmse,
            points: pose.points,
            iterations: pose.iterations,
        }
    }
}

/// `semidense_msgs/Keyframe`: the properties of a keyframe besides its points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeyframeRecord {
    /// Stamp of its frame.
    pub header: Header,
    /// Its id.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// Sequence of its frame.
    pub sequence: u64,
    /// Number of corrections of the map.
    pub map_revision: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// Points with depth.
    pub points: u32,
    /// Pose in the odometry world: quaternion, translation, unit.
    pub world_from_keyframe: [f64; 8],
    /// Pose in the map.
    pub map_from_keyframe: [f64; 8],
    /// fx, fy, cx, cy, pixels.
    pub intrinsics: [f64; 4],
}

impl KeyframeRecord {
    /// Converts a keyframe.
    pub fn new(header: Header, keyframe: &Keyframe) -> Self {
        let k = &keyframe.intrinsics;
        Self {
            header,
            keyframe_id: keyframe.keyframe_id,
            revision: keyframe.revision,
            sequence: keyframe.sequence,
            map_revision: keyframe.map_revision,
            epoch: keyframe.epoch,
            points: keyframe.points.len() as u32,
            world_from_keyframe: similarity_message(&keyframe.world_from_keyframe),
            map_from_keyframe: similarity_message(&keyframe.map_from_keyframe),
            intrinsics: [k.fx, k.fy, k.cx, k.cy],
        }
    }
}

/// `semidense_msgs/Graph`: poses of all keyframes, with the properties that do not fit into a `PoseArray`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GraphRecord {
    /// When it was read.
    pub header: Header,
    /// Number of corrections of the map.
    pub map_revision: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// Ids of the keyframes.
    pub keyframe_ids: Vec<u64>,
    /// Revision of the depth of each.
    pub revisions: Vec<u64>,
    /// Pose of each in the map: eight numbers, quaternion, translation, unit.
    pub map_from_keyframes: Vec<f64>,
}

impl GraphRecord {
    /// Converts a graph.
    pub fn new(header: Header, graph: &Graph) -> Self {
        let poses = graph.poses.iter();
        Self {
            header,
            map_revision: graph.header.map_revision,
            epoch: graph.header.epoch,
            keyframe_ids: poses.clone().map(|pose| pose.keyframe_id).collect(),
            revisions: poses.clone().map(|pose| pose.revision).collect(),
            map_from_keyframes: poses
                .flat_map(|pose| similarity_message(&pose.map_from_keyframe))
                .collect(),
        }
    }
}
