//! A frame's pose from ground truth, as a tracking result, so that the mapper can be run and evaluated alone.

use crate::slam::evaluation::MAX_DIFFERENCE_NANOS;
use crate::slam::evaluation::association::nearest;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::Keyframe;
use crate::slam::pose::{PoseEstimate, Quality, TrackingState};
use crate::slam::tracker::TrackerParams;
use crate::slam::trajectory::StampedPose;

/// The true poses relative to the camera of the first frame that has one, as in a map whose first keyframe is the
/// identity; empty where no pose is near `first_nanos` or later.
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

/// The true pose of `frame`, exact (covariance zero), relative to `keyframe`; `None` where no true pose is near enough
/// in time. Whether a keyframe is due follows from the geometry, with the tracker's weights.
pub fn given_pose(
    frame: &FrameView<'_>,
    keyframe: Option<&Keyframe>,
    ground_truth: &[StampedPose],
    tracker: &TrackerParams,
) -> Option<PoseEstimate> {
    let index = nearest(ground_truth, frame.capture_nanos, MAX_DIFFERENCE_NANOS)?;
    let world_from_camera = ground_truth[index].world_from_camera;
    let mut estimate = PoseEstimate {
        state: TrackingState::Tracking,
        world_from_camera,
        map_from_camera: world_from_camera,
        ..PoseEstimate::unknown(frame)
    };
    if let Some(keyframe) = keyframe {
        estimate.epoch = keyframe.epoch;
        (estimate.revision, estimate.map_revision) = (keyframe.revision, keyframe.map_revision);
        estimate.keyframe_id = keyframe.keyframe_id;
        estimate.keyframe_from_camera =
            keyframe.world_from_keyframe.inverse_transform_pose(&world_from_camera);
        estimate.map_from_camera =
            keyframe.map_from_keyframe.transform_pose(&estimate.keyframe_from_camera);
        (estimate.quality, estimate.proposes_keyframe) =
            view_of(keyframe, &estimate.keyframe_from_camera, tracker);
    }
    Some(estimate)
}

/// The quality that a tracker would find in its view of a keyframe, and whether it would propose another one.
fn view_of(
    keyframe: &Keyframe,
    keyframe_from_camera: &SE3,
    tracker: &TrackerParams,
) -> (Quality, bool) {
    let k = keyframe.intrinsics;
    let camera_from_keyframe = keyframe_from_camera.inverse();
    let rotation = camera_from_keyframe.rotation_matrix();
    let (right, bottom) = (k.width as f64 - 0.5, k.height as f64 - 0.5);
    let (mut in_view, mut squared_flow, mut inverse_depths) = (0u32, 0.0, 0.0);
    for point in &keyframe.points {
        let (u, v, d) = (f64::from(point.u), f64::from(point.v), f64::from(point.inverse_depth));
        inverse_depths += d;
        let ray = k.ray(u, v);
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
    let translation = keyframe_from_camera.translation.norm() * inverse_depths / points;
    let distance = tracker.keyframe_distance().distance(translation, in_view_ratio);
    let quality = Quality {
        in_view_ratio,
        inlier_ratio: 1.0,
        whitened_rmse: 1.0,
        points: in_view,
        mean_squared_flow: squared_flow / f64::from(in_view.max(1)),
        ..Quality::default()
    };
    (quality, distance > 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::DepthPoint;

    fn at(nanos: i64, x: f64) -> StampedPose {
        let mut world_from_camera = SE3::identity();
        world_from_camera.translation.x = x;
        StampedPose { nanos, world_from_camera }
    }

    /// A wall of points at 2 keyframe units; a keyframe unit is 2 m.
    fn keyframe() -> Keyframe {
        let points = (0..100).map(|i| DepthPoint {
            u: i % 10 * 10,
            v: i / 10 * 10,
            inverse_depth: 0.5,
            variance: 0.01,
            intensity: 0.0,
        });
        Keyframe {
            keyframe_id: 4,
            revision: 9,
            ..Keyframe::at(
                Sim3::new(SE3::identity(), 2.0),
                Intrinsics::pinhole(100, 100, 100.0),
                points.collect(),
                vec![0; 10_000],
            )
        }
    }

    #[test]
    fn a_given_pose_is_relative_to_the_keyframe_and_proposes_the_next() {
        let truth = [at(0, 0.0), at(1_000_000_000, 0.04), at(2_000_000_000, 2.0)];
        let frame = |nanos| FrameView {
            sequence: 1,
            capture_nanos: nanos,
            exposure_nanos: 0,
            width: 100,
            height: 100,
            pixels: &[],
        };
        let give =
            |nanos| given_pose(&frame(nanos), Some(&keyframe()), &truth, &TrackerParams::default());
        let near = give(1_010_000_000).unwrap();
        assert!((near.keyframe_from_camera.translation.x - 0.02).abs() < 1e-12);
        assert_eq!((near.keyframe_id, near.revision), (4, 9));
        // 0.02 units at 100 px / 2 units: one pixel to the left; the first column leaves the view.
        assert!((near.quality.mean_squared_flow - 1.0).abs() < 1e-9);
        assert!((near.quality.in_view_ratio - 0.9).abs() < 1e-9);
        assert!(!near.proposes_keyframe);
        assert!(give(2_000_000_000).unwrap().proposes_keyframe);
        assert!(give(500_000_000).is_none(), "no true pose is near");
    }

    #[test]
    fn the_first_camera_that_has_a_pose_is_the_world() {
        let truth = [at(0, 1.0), at(50_000_000, 4.0), at(90_000_000, 6.0)];
        let moved = truth_in_first_camera(&truth, 60_000_000);
        assert_eq!(moved[1].world_from_camera.translation.x, 0.0);
        assert_eq!(moved[2].world_from_camera.translation.x, 2.0);
        assert!(truth_in_first_camera(&truth, 500_000_000).is_empty());
        assert!(truth_in_first_camera(&[], 0).is_empty());
        let earlier = truth_in_first_camera(&truth, -500_000_000);
        assert_eq!(earlier[0].world_from_camera.translation.x, 0.0);
    }
}
