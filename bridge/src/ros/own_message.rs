//! Messages that ROS lacks: the values of shared memory without loss. Recordings carry their definitions,
//! from which every reader of `ros2msg` decodes them. Poses are in our axes (x right, y down, z forward).

use semidense::slam::keyframe::Keyframe;
use semidense::wire::conversion::similarity_message;
use semidense::wire::message::{FrameHeader, PoseMessage};
use serde::{Deserialize, Serialize};
use serde_big_array::BigArray;

use crate::ros::message::{Header, messages};
use crate::session::Graph;

messages! {
    OWN_MESSAGES:

    /// `semidense_msgs/Frame`: properties of an image that `sensor_msgs` lacks; a replay of a recording uses its stamps.
    "semidense_msgs/Frame" FrameRecord {
        /// Stamp and frame of the image.
        header: Header,
        /// Number of the frame at its source.
        sequence: u64,
        /// Its stamp, nanoseconds of the source's clock.
        capture_nanos: i64,
        /// CLOCK_MONOTONIC instant from which latency is measured.
        clock_nanos: i64,
        /// Exposure time in nanoseconds, 0 if unknown.
        exposure_nanos: u64,
        /// Sensor gain, 0 if unknown.
        gain: f32,
    }

    /// `semidense_msgs/Pose`: all fields of a pose, including one that is not claimed.
    "semidense_msgs/Pose" PoseRecord {
        /// Stamp of the frame.
        header: Header,
        /// Sequence of the frame.
        sequence: u64,
        /// Stamp of the frame, nanoseconds of the source's clock.
        capture_nanos: i64,
        /// Time from the frame's instant to publication.
        latency_nanos: u64,
        /// Time that tracking took.
        track_nanos: u64,
        /// Keyframe it was tracked on.
        keyframe_id: u64,
        /// Revision of its depth.
        revision: u64,
        /// Number of corrections of the map.
        map_revision: u64,
        /// Epoch of the map.
        epoch: u32,
        /// 0 initializing, 1 tracking, 2 degraded, 3 lost.
        state: u32,
        /// The reason, see `PoseMessage` in docs/topics.md.
        reason: u32,
        /// Odometry: quaternion x, y, z, w, then translation.
        world_from_camera: [f64; 7],
        /// In the map.
        map_from_camera: [f64; 7],
        /// Relative to the keyframe, in its unit.
        keyframe_from_camera: [f64; 7],
        /// Covariance of the left increment of `current_from_keyframe`: upper triangle, row-major.
        #[serde(with = "BigArray")]
        covariance: [f64; 21],
        /// Covariance of the left increment of `map_from_camera`.
        #[serde(with = "BigArray")]
        map_covariance: [f64; 21],
        /// 1 if the velocity is known.
        has_velocity: u32,
        /// Linear velocity of the camera in its own axes, world units per second.
        linear_velocity: [f64; 3],
        /// Angular velocity of the camera in its own axes, rad/s.
        angular_velocity: [f64; 3],
        /// Covariance of linear, then angular velocity: upper triangle, row-major.
        #[serde(with = "BigArray")]
        velocity_covariance: [f64; 21],
        /// Brightness relative to the keyframe: a, b.
        brightness: [f64; 2],
        /// Share of the keyframe's points in view.
        in_view_ratio: f64,
        /// Share of the compared points that are inliers.
        inlier_ratio: f64,
        /// Residual in grey levels.
        residual_rmse: f64,
        /// Points compared.
        points: u32,
        /// Iterations, all levels.
        iterations: u32,
    }

    /// `semidense_msgs/Keyframe`: the properties of a keyframe besides its points.
    "semidense_msgs/Keyframe" KeyframeRecord {
        /// Stamp of its frame.
        header: Header,
        /// Its id.
        keyframe_id: u64,
        /// Revision of its depth.
        revision: u64,
        /// Sequence of its frame.
        sequence: u64,
        /// Number of corrections of the map.
        map_revision: u64,
        /// Epoch of the map.
        epoch: u32,
        /// Points with depth.
        points: u32,
        /// Pose in the odometry world: quaternion, translation, unit.
        world_from_keyframe: [f64; 8],
        /// Pose in the map.
        map_from_keyframe: [f64; 8],
        /// fx, fy, cx, cy, pixels.
        intrinsics: [f64; 4],
    }

    /// `semidense_msgs/Graph`: poses of all keyframes, with the properties that do not fit into a `PoseArray`.
    "semidense_msgs/Graph" GraphRecord {
        /// When it was read.
        header: Header,
        /// Number of corrections of the map.
        map_revision: u64,
        /// Epoch of the map.
        epoch: u32,
        /// Ids of the keyframes.
        keyframe_ids: Vec<u64>,
        /// Revision of the depth of each.
        revisions: Vec<u64>,
        /// Pose of each in the map: eight numbers, quaternion, translation, unit.
        map_from_keyframes: Vec<f64>,
    }
}

/// Converts a message of shared memory: a record has these fields of it, besides the header.
macro_rules! copies {
    ($record:ident of $message:ty: $($field:ident)*) => {
        impl $record {
            /// Converts a message of shared memory.
            pub fn new(header: Header, message: &$message) -> Self {
                Self { header, $($field: message.$field),* }
            }
        }
    };
}

copies! { FrameRecord of FrameHeader: sequence capture_nanos clock_nanos exposure_nanos gain }

copies! { PoseRecord of PoseMessage:
    sequence capture_nanos latency_nanos track_nanos keyframe_id revision map_revision epoch state
    reason world_from_camera map_from_camera keyframe_from_camera covariance map_covariance
    has_velocity linear_velocity angular_velocity velocity_covariance brightness in_view_ratio
    inlier_ratio residual_rmse points iterations
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
