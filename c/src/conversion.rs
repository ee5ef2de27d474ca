//! Converts messages, after checking them, to the structures of the header.

use std::mem::offset_of;

use semidense::slam::geometry::intrinsics::Intrinsics as CoreIntrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::{DepthPoint as CorePoint, KeyframePose as CorePose};
use semidense::slam::pose::{DegradedReason, LostReason, PoseEstimate, TrackingState};
use semidense::wire::conversion::{MessageError, pose_from_message};
use semidense::wire::message::PoseMessage;

use crate::types::{DepthPoint, Intrinsics, KeyframePose, Pose, Reason, State, Transform};

// Points are read in place.
const _: () = assert!(size_of::<DepthPoint>() == size_of::<CorePoint>());
const _: () = assert!(align_of::<DepthPoint>() == align_of::<CorePoint>());
const _: () = assert!(offset_of!(DepthPoint, u) == offset_of!(CorePoint, u));
const _: () = assert!(offset_of!(DepthPoint, v) == offset_of!(CorePoint, v));
const _: () =
    assert!(offset_of!(DepthPoint, inverse_depth) == offset_of!(CorePoint, inverse_depth));
const _: () = assert!(offset_of!(DepthPoint, variance) == offset_of!(CorePoint, variance));
const _: () = assert!(offset_of!(DepthPoint, intensity) == offset_of!(CorePoint, intensity));

/// Points in shared memory as points of the header.
pub fn points(points: &[CorePoint]) -> *const DepthPoint {
    points.as_ptr().cast()
}

fn rigid(transform: &SE3) -> Transform {
    Transform {
        quaternion: transform.quaternion_xyzw(),
        translation: transform.translation.into(),
        scale: 1.0,
    }
}

/// Converts a similarity.
pub fn similarity(similarity: &Sim3) -> Transform {
    Transform { scale: similarity.scale, ..rigid(&similarity.rigid) }
}

/// Converts focal lengths and principal point.
pub fn intrinsics(k: &CoreIntrinsics) -> Intrinsics {
    Intrinsics { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy }
}

/// Converts the pose of a keyframe.
pub fn keyframe_pose(pose: &CorePose) -> KeyframePose {
    KeyframePose {
        keyframe_id: pose.keyframe_id,
        revision: pose.revision,
        map_from_keyframe: similarity(&pose.map_from_keyframe),
    }
}

/// Expands the upper triangle of a symmetric 6×6 matrix, row by row.
fn symmetric(upper_triangle: &[f64; 21]) -> [f64; 36] {
    let mut matrix = [0.0; 36];
    let mut entries = upper_triangle.iter();
    for row in 0..6 {
        for (column, entry) in (row..6).zip(&mut entries) {
            matrix[6 * row + column] = *entry;
            matrix[6 * column + row] = *entry;
        }
    }
    matrix
}

fn codes(state: TrackingState) -> (State, Reason) {
    match state {
        TrackingState::Initializing => (State::Initializing, Reason::None),
        TrackingState::Tracking => (State::Tracking, Reason::None),
        TrackingState::Degraded(reason) => (
            State::Degraded,
            match reason {
                DegradedReason::Budget => Reason::Budget,
                DegradedReason::LowOverlap => Reason::LowOverlap,
                DegradedReason::HighResidual => Reason::HighResidual,
                DegradedReason::Gap => Reason::Gap,
                DegradedReason::Turning => Reason::Turning,
            },
        ),
        TrackingState::Lost(reason) => (
            State::Lost,
            match reason {
                LostReason::Diverged => Reason::Diverged,
                LostReason::TooFewInliers => Reason::TooFewInliers,
                LostReason::NoPoints => Reason::NoPoints,
                LostReason::UnusableFrame => Reason::UnusableFrame,
                LostReason::MapRejected => Reason::MapRejected,
            },
        ),
    }
}

/// Checks a message and converts its pose.
pub fn pose(message: &PoseMessage) -> Result<Pose, MessageError> {
    let estimate: PoseEstimate = pose_from_message(message)?;
    let (state, reason) = codes(estimate.state);
    Ok(Pose {
        sequence: estimate.sequence,
        capture_nanos: estimate.capture_nanos,
        realtime_nanos: message.realtime_nanos,
        published_nanos: message.published_nanos,
        latency_nanos: message.latency_nanos,
        keyframe_id: estimate.keyframe_id,
        keyframe_revision: estimate.revision,
        map_revision: estimate.map_revision,
        epoch: estimate.epoch,
        state,
        reason,
        has_velocity: u32::from(estimate.velocity.is_some()),
        world_from_camera: rigid(&estimate.world_from_camera),
        map_from_camera: rigid(&estimate.map_from_camera),
        keyframe_from_camera: rigid(&estimate.keyframe_from_camera),
        covariance: symmetric(&estimate.covariance),
        map_covariance: symmetric(&estimate.map_covariance),
        linear_velocity: estimate.velocity.map_or([0.0; 3], |velocity| velocity.linear.into()),
        angular_velocity: estimate.velocity.map_or([0.0; 3], |velocity| velocity.angular.into()),
        velocity_covariance: symmetric(&estimate.velocity.map_or([0.0; 21], |v| v.covariance)),
        brightness: [estimate.brightness.a, estimate.brightness.b],
        in_view_ratio: estimate.quality.in_view_ratio,
        inlier_ratio: estimate.quality.inlier_ratio,
        residual_rmse: estimate.quality.residual_rmse,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_upper_triangle_expands_to_a_symmetric_matrix() {
        let matrix = symmetric(&std::array::from_fn(|entry| entry as f64));
        assert_eq!(matrix[..6], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!((matrix[7], matrix[35]), (6.0, 20.0));
        assert!((0..36).all(|entry| matrix[entry] == matrix[6 * (entry % 6) + entry / 6]));
    }
}
