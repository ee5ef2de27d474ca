//! What ROS has no messages for: the numbers as they are in shared memory, so that nothing is lost. Recordings carry
//! their definitions, by which every reader of `ros2msg` knows them. Poses are in our axes (x right, y down, z forward).

use semidense::slam::keyframe::Keyframe;
use semidense::wire::conversion::similarity_message;
use semidense::wire::message::{FrameHeader, PoseMessage};
use serde::{Deserialize, Serialize};
use serde_big_array::BigArray;

use crate::ros::message::Header;
use crate::session::Graph;

/// `semidense_msgs/Frame`: of an image what `sensor_msgs` has no place for. A recording is played with these stamps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Stamp and frame of the image.
    pub header: Header,
    /// Number of the frame at its source.
    pub sequence: u64,
    /// Its stamp, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    /// CLOCK_MONOTONIC instant that latency counts from.
    pub clock_nanos: i64,
    /// Exposure time in nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// Sensor gain, 0 where unknown.
    pub gain: f32,
}

impl FrameRecord {
    /// Of a frame's header.
    pub fn new(header: Header, frame: &FrameHeader) -> Self {
        let FrameHeader { sequence, capture_nanos, clock_nanos, exposure_nanos, gain, .. } = *frame;
        Self { header, sequence, capture_nanos, clock_nanos, exposure_nanos, gain }
    }
}

/// `semidense_msgs/Pose`: all of a pose, also of one that is not claimed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseRecord {
    /// Stamp of the frame.
    pub header: Header,
    /// Sequence of the frame.
    pub sequence: u64,
    /// Stamp of the frame, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    /// From the frame's instant to publication.
    pub latency_nanos: u64,
    /// Time that tracking took.
    pub track_nanos: u64,
    /// Keyframe it was tracked on.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// How often the map had been corrected.
    pub map_revision: u64,
    /// Life of the map.
    pub epoch: u32,
    /// 0 initializing, 1 tracking, 2 degraded, 3 lost.
    pub state: u32,
    /// Why, see `PoseMessage` in docs/topics.md.
    pub reason: u32,
    /// Odometry: quaternion x, y, z, w, then translation.
    pub world_from_camera: [f64; 7],
    /// In the map.
    pub map_from_camera: [f64; 7],
    /// Relative to the keyframe, in its unit.
    pub keyframe_from_camera: [f64; 7],
    /// Of the left increment of `current_from_keyframe`: upper triangle, row-major.
    #[serde(with = "BigArray")]
    pub covariance: [f64; 21],
    /// Of the left increment of `map_from_camera`.
    #[serde(with = "BigArray")]
    pub map_covariance: [f64; 21],
    /// 1 where the velocity is known.
    pub has_velocity: u32,
    /// Of the camera, in its axes, world units a second.
    pub linear_velocity: [f64; 3],
    /// Of the camera, in its axes, rad/s.
    pub angular_velocity: [f64; 3],
    /// Linear, then angular: upper triangle, row-major.
    #[serde(with = "BigArray")]
    pub velocity_covariance: [f64; 21],
    /// Brightness against the keyframe: a, b.
    pub brightness: [f64; 2],
    /// Share of the keyframe's points in view.
    pub in_view_ratio: f64,
    /// Share of those compared that are explained.
    pub inlier_ratio: f64,
    /// Residual in grey levels.
    pub residual_rmse: f64,
    /// Points compared.
    pub points: u32,
    /// Iterations, all levels.
    pub iterations: u32,
}

impl PoseRecord {
    /// Of a pose.
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

/// `semidense_msgs/Keyframe`: what a keyframe has besides its points.
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
    /// How often the map had been corrected.
    pub map_revision: u64,
    /// Life of the map.
    pub epoch: u32,
    /// Points with depth.
    pub points: u32,
    /// Where odometry has it: quaternion, translation, unit.
    pub world_from_keyframe: [f64; 8],
    /// Where the map has it.
    pub map_from_keyframe: [f64; 8],
    /// fx, fy, cx, cy, pixels.
    pub intrinsics: [f64; 4],
}

impl KeyframeRecord {
    /// Of a keyframe.
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

/// `semidense_msgs/Graph`: poses of all keyframes with what a `PoseArray` has no place for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GraphRecord {
    /// When it was read.
    pub header: Header,
    /// How often the map had been corrected.
    pub map_revision: u64,
    /// Life of the map.
    pub epoch: u32,
    /// Keyframes.
    pub keyframe_ids: Vec<u64>,
    /// Revision of the depth of each.
    pub revisions: Vec<u64>,
    /// Where the map has each: eight numbers, quaternion, translation, unit.
    pub map_from_keyframes: Vec<f64>,
}

impl GraphRecord {
    /// Of a graph.
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
