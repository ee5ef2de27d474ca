//! A frame's pose from ground truth, in the words of the tracker, so that the mapper can be run and
//! judged alone.

use nalgebra::Vector3;

use crate::slam::evaluation::MAX_DIFFERENCE_NANOS;
use crate::slam::evaluation::association::nearest;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::Keyframe;
use crate::slam::pose::{Brightness, NO_KEYFRAME, PoseEstimate, Quality, TrackingState};
use crate::slam::trajectory::StampedPose;

/// Weight of the distance in the choice of a keyframe: a third of the mean depth makes one
/// (Engel, Schöps, Cremers 2014, §3.2).
const DISTANCE_WEIGHT: f64 = 3.0;

/// Weight of the share of points out of view: a quarter makes one.
const USAGE_WEIGHT: f64 = 4.0;

/// The true poses with the camera of the first frame that has one as the world, as a map has it
/// whose first keyframe is the identity; empty where no pose is near `first_nanos` or later.
pub fn truth_in_first_camera(ground_truth: &[StampedPose], first_nanos: i64) -> Vec<StampedPose> {
    let earliest = first_nanos.saturating_sub(MAX_DIFFERENCE_NANOS);
    let later = ground_truth.partition_point(|pose| pose.nanos < earliest);
    let first = nearest(ground_truth, first_nanos, MAX_DIFFERENCE_NANOS).unwrap_or(later);
    let Some(world) = ground_truth.get(first) else { return Vec::new() };
    let camera_from_world = world.world_from_camera.inverse();
    let place = |pose: &StampedPose| StampedPose {
        nanos: pose.nanos,
        world_from_camera: camera_from_world * pose.world_from_camera,
    };
    ground_truth.iter().map(place).collect()
}

/// The true pose of `frame`, exact (covariance zero), relative to `keyframe`; `None` where no true
/// pose is near enough in time. Whether a keyframe is due is judged from the geometry.
pub fn given_pose(
    frame: &FrameView<'_>,
    keyframe: Option<&Keyframe>,
    ground_truth: &[StampedPose],
) -> Option<PoseEstimate> {
    let index = nearest(ground_truth, frame.capture_nanos, MAX_DIFFERENCE_NANOS)?;
    let world_from_camera = ground_truth[index].world_from_camera;
    let mut estimate = PoseEstimate {
        sequence: frame.sequence,
        capture_nanos: frame.capture_nanos,
        epoch: 0,
        revision: 0,
        keyframe_id: NO_KEYFRAME,
        state: TrackingState::Tracking,
        world_from_camera,
        keyframe_from_camera: SE3::identity(),
        covariance: [0.0; 21],
        brightness: Brightness::default(),
        quality: Quality::default(),
        proposes_keyframe: false,
    };
    if let Some(keyframe) = keyframe {
        estimate.epoch = keyframe.epoch;
        estimate.revision = keyframe.revision;
        estimate.keyframe_id = keyframe.keyframe_id;
        estimate.keyframe_from_camera = keyframe.world_from_keyframe.locate(&world_from_camera);
        let view = view_of(keyframe, &estimate.keyframe_from_camera);
        estimate.quality = view.quality;
        estimate.proposes_keyframe = view.proposes_keyframe;
    }
    Some(estimate)
}

/// How a camera sees a keyframe's points.
struct View {
    quality: Quality,
    proposes_keyframe: bool,
}

fn view_of(keyframe: &Keyframe, keyframe_from_camera: &SE3) -> View {
    let k = keyframe.intrinsics;
    let camera_from_keyframe = keyframe_from_camera.inverse();
    let rotation = camera_from_keyframe.rotation_matrix();
    let (right, bottom) = (k.width as f64 - 0.5, k.height as f64 - 0.5);
    let (mut in_view, mut squared_flow, mut inverse_depths) = (0u32, 0.0, 0.0);
    for point in &keyframe.points {
        let (u, v, d) = (f64::from(point.u), f64::from(point.v), f64::from(point.inverse_depth));
        inverse_depths += d;
        let ray = Vector3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0);
        let in_camera = rotation * ray + camera_from_keyframe.translation * d;
        if in_camera.z <= 0.0 {
            continue;
        }
        let (x, y) =
            (k.fx * in_camera.x / in_camera.z + k.cx, k.fy * in_camera.y / in_camera.z + k.cy);
        if x > -0.5 && y > -0.5 && x < right && y < bottom {
            in_view += 1;
            squared_flow += (x - u).powi(2) + (y - v).powi(2);
        }
    }
    let points = keyframe.points.len().max(1) as f64;
    let in_view_ratio = f64::from(in_view) / points;
    let distance =
        DISTANCE_WEIGHT * keyframe_from_camera.translation.norm() * inverse_depths / points;
    let unused = USAGE_WEIGHT * (1.0 - in_view_ratio);
    View {
        quality: Quality {
            in_view_ratio,
            inlier_ratio: 1.0,
            whitened_rmse: 1.0,
            points: in_view,
            mean_squared_flow: squared_flow / f64::from(in_view.max(1)),
            ..Quality::default()
        },
        proposes_keyframe: distance.powi(2) + unused.powi(2) > 1.0,
    }
}
