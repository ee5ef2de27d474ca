//! Converts a session's events to ROS messages.

use std::collections::HashMap;

use semidense::slam::keyframe::Keyframe;
use semidense::wire::message::{FrameHeader, HealthMessage, PoseMessage};

use crate::ros::axes::{
    map_covariance, odometry_covariance, pose_message, ros_from_world, transform_message,
    vector_message, velocity_covariance,
};
use crate::ros::diagnostics::diagnostics;
use crate::ros::frame_ids::FrameIds;
use crate::ros::keyframe_cloud::keyframe_cloud;
use crate::ros::message::{
    CameraInfo, DiagnosticArray, Header, Image, Odometry, PointCloud2, PoseArray,
    PoseWithCovariance, PoseWithCovarianceStamped, RegionOfInterest, TfMessage, Time,
    TransformStamped, Twist, TwistWithCovariance,
};
use crate::session::{Event, Frame, Graph, Pose};

/// Variance of an unknown velocity: so large that filters, which have no marker for unknown, ignore it.
const UNKNOWN_VARIANCE: f64 = 1e6;

/// The messages of a claimed pose.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseMessages {
    /// The best estimate, in the map.
    pub pose: PoseWithCovarianceStamped,
    /// Odometry.
    pub odometry: Odometry,
    /// map → odom → camera.
    pub transforms: TfMessage,
}

/// Converts the events of one instance. It must see every event, in order, through [`Converter::observe`].
#[derive(Debug, Clone)]
pub struct Converter {
    instance: String,
    frames: FrameIds,
    /// The unit of each keyframe in the world.
    units: HashMap<u64, f64>,
    /// Offset from frame stamps to CLOCK_REALTIME, nanoseconds; 0 if unknown.
    realtime_from_capture: i64,
}

impl Converter {
    /// A converter for an instance, with the names of its frames.
    pub fn new(instance: &str, frames: FrameIds) -> Self {
        let instance = instance.to_owned();
        Self { instance, frames, units: HashMap::new(), realtime_from_capture: 0 }
    }

    /// Stores what later messages need: units of keyframes, clocks.
    pub fn observe(&mut self, event: &Event) {
        match event {
            Event::Joined => {
                self.units.clear();
                self.realtime_from_capture = 0;
            }
            Event::Keyframe(keyframe) => {
                self.units.insert(keyframe.keyframe_id, keyframe.world_from_keyframe.scale);
            }
            // For keyframes from before the session only the map's unit is known, which equals the world's
            // except for corrections of the scale since.
            Event::Graph(graph) => graph.poses.iter().for_each(|pose| {
                self.units.entry(pose.keyframe_id).or_insert(pose.map_from_keyframe.scale);
            }),
            Event::Frame(frame) => {
                self.set_clock(frame.header.capture_nanos, frame.header.realtime_nanos);
            }
            Event::Pose(pose) => {
                self.set_clock(pose.message.capture_nanos, pose.message.realtime_nanos);
            }
            Event::Left | Event::Health(..) | Event::Adjustment(_) => {}
        }
    }

    fn set_clock(&mut self, capture_nanos: i64, realtime_nanos: i64) {
        if realtime_nanos != 0 {
            self.realtime_from_capture = realtime_nanos.saturating_sub(capture_nanos);
        }
    }

    /// The ROS stamp of a frame: CLOCK_REALTIME of its exposure if known, else the stamp of its source.
    pub fn stamp(&self, capture_nanos: i64) -> Time {
        Time::from_nanos(capture_nanos.saturating_add(self.realtime_from_capture))
    }

    /// Stamp and frame id of a camera's message; `realtime_nanos` is 0 if unknown.
    fn camera_header(&self, capture_nanos: i64, realtime_nanos: i64) -> Header {
        let stamp = match realtime_nanos {
            0 => self.stamp(capture_nanos),
            nanos => Time::from_nanos(nanos),
        };
        Header::new(stamp, &self.frames.camera)
    }

    /// Stamp of a pose, and the frame id of its camera.
    pub fn pose_header(&self, pose: &Pose) -> Header {
        self.camera_header(pose.message.capture_nanos, pose.message.realtime_nanos)
    }

    /// A header in the map.
    pub fn map_header(&self, stamp: Time) -> Header {
        Header::new(stamp, &self.frames.map)
    }

    /// The messages of a pose; `None` if it is not claimed (initializing, lost), or is on a keyframe whose
    /// unit is not known yet.
    pub fn pose(&self, pose: &Pose) -> Option<PoseMessages> {
        let Pose { message, estimate } = pose;
        if !estimate.state.is_tracked() {
            return None;
        }
        let unit = *self.units.get(&estimate.keyframe_id)?;
        let stamp = self.pose_header(pose).stamp;
        let (in_map, in_world) = (estimate.map_from_camera, estimate.world_from_camera);
        let map_from_camera = ros_from_world() * in_map;
        let odom_from_camera = ros_from_world() * in_world;
        let map_pose = PoseWithCovariance {
            pose: pose_message(&map_from_camera),
            covariance: map_covariance(&in_map, &estimate.map_covariance),
        };
        let odometry_pose = PoseWithCovariance {
            pose: pose_message(&odom_from_camera),
            covariance: odometry_covariance(&in_world, unit, &estimate.covariance),
        };
        let transform = |parent: &str, child: &str, parent_from_child| TransformStamped {
            header: Header::new(stamp, parent),
            child_frame_id: child.to_owned(),
            transform: transform_message(&parent_from_child),
        };
        let FrameIds { map, odom, camera } = &self.frames;
        let map_from_odom = map_from_camera * odom_from_camera.inverse();
        let transforms =
            vec![transform(map, odom, map_from_odom), transform(odom, camera, odom_from_camera)];
        Some(PoseMessages {
            pose: PoseWithCovarianceStamped { header: Header::new(stamp, map), pose: map_pose },
            odometry: Odometry {
                header: Header::new(stamp, odom),
                child_frame_id: camera.clone(),
                pose: odometry_pose,
                twist: twist(message),
            },
            transforms: TfMessage { transforms },
        })
    }

    /// The depth of a keyframe as points in the map.
    pub fn points(&self, keyframe: &Keyframe) -> PointCloud2 {
        let stamp = self.stamp(keyframe.capture_nanos);
        keyframe_cloud(keyframe, self.map_header(stamp))
    }

    /// Poses of all keyframes in the map, ordered by id; `stamp` is when the graph was read.
    pub fn keyframes(&self, graph: &Graph, stamp: Time) -> PoseArray {
        let place = |pose: &semidense::slam::keyframe::KeyframePose| {
            pose_message(&(ros_from_world() * pose.map_from_keyframe.rigid))
        };
        let poses = graph.poses.iter().map(place).collect();
        PoseArray { header: Header::new(stamp, &self.frames.map), poses }
    }

    /// Stamp and optical frame of an image.
    pub fn image_header(&self, frame: &Frame) -> Header {
        self.camera_header(frame.header.capture_nanos, frame.header.realtime_nanos)
    }

    /// The image as `mono8`.
    pub fn image(&self, frame: &Frame) -> Image {
        let FrameHeader { width, height, stride, .. } = frame.header;
        Image {
            header: self.image_header(frame),
            height,
            width,
            encoding: "mono8".to_owned(),
            is_bigendian: 0,
            step: stride,
            data: frame.pixels.to_vec(),
        }
    }

    /// The camera of the image: rectified, hence without a lens.
    pub fn camera_info(&self, frame: &Frame) -> CameraInfo {
        let FrameHeader { width, height, intrinsics: [fx, fy, cx, cy], .. } = frame.header;
        CameraInfo {
            header: self.image_header(frame),
            height,
            width,
            distortion_model: "plumb_bob".to_owned(),
            d: vec![0.0; 5],
            k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            binning_x: 0,
            binning_y: 0,
            roi: RegionOfInterest::default(),
        }
    }

    /// Health of the process `owner`; `stamp` is when it was read.
    pub fn diagnostics(&self, owner: &str, health: &HealthMessage, stamp: Time) -> DiagnosticArray {
        diagnostics(&self.instance, owner, health, stamp)
    }
}

/// Velocities of the camera in its own axes.
fn twist(message: &PoseMessage) -> TwistWithCovariance {
    if message.has_velocity == 0 {
        let covariance = std::array::from_fn(|at| if at % 7 == 0 { UNKNOWN_VARIANCE } else { 0.0 });
        return TwistWithCovariance { twist: Twist::default(), covariance };
    }
    let twist = Twist {
        linear: vector_message(&message.linear_velocity.into()),
        angular: vector_message(&message.angular_velocity.into()),
    };
    TwistWithCovariance { twist, covariance: velocity_covariance(&message.velocity_covariance) }
}
