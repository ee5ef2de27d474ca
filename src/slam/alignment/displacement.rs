//! Distance in the image between a keyframe's points under two poses: the size of a pose error in pixels.

use nalgebra::Vector3;

use crate::slam::alignment::reference::Reference;
use crate::slam::geometry::se3::SE3;

/// Mean distance between the projections of the reference's points under two `current_from_keyframe` (translation in
/// keyframe units), pixels of level 0, over every `stride`-th point of the finest level that is in front of the camera
/// in both; infinite if there are none.
pub fn mean_displacement_px(reference: &Reference, one: &SE3, other: &SE3, stride: usize) -> f64 {
    let k = reference.intrinsics();
    let rotations = [one.rotation_matrix(), other.rotation_matrix()];
    let (mut sum, mut count) = (0.0, 0_u32);
    for point in reference.level(reference.finest_level()).iter().step_by(stride.max(1)) {
        let ray = Vector3::new(f64::from(point.ray_x), f64::from(point.ray_y), 1.0);
        let d = f64::from(point.inverse_depth);
        let a = rotations[0] * ray + one.translation * d;
        let b = rotations[1] * ray + other.translation * d;
        if a.z > 0.0 && b.z > 0.0 {
            let (dx, dy) = (a.x / a.z - b.x / b.z, a.y / a.z - b.y / b.z);
            sum += (k.fx * dx).hypot(k.fy * dy);
            count += 1;
        }
    }
    if count == 0 { f64::INFINITY } else { sum / f64::from(count) }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::alignment::scene::{small_camera, small_plane};

    #[test]
    fn a_small_rotation_moves_the_image_by_focal_length_times_angle() {
        let reference = Reference::prepare(&small_plane().keyframe(&small_camera(), 4, 0.0));
        let pose = |axis: usize, size: f64| {
            let mut twist = Vector6::zeros();
            twist[axis] = size;
            SE3::exp(&twist)
        };
        let still = SE3::identity();
        let distance = |pose: &SE3| mean_displacement_px(&reference, pose, &still, 1);
        assert_eq!(distance(&still), 0.0);
        // tan changes faster off the axis: the image moves by f (1 + x²), with x up to 0.6.
        let turned = distance(&pose(4, 0.01));
        assert!(turned > 2.6 && turned < 1.2 * 2.6, "{turned}");
        let moved = distance(&pose(0, 0.01));
        let expected = 2.6 * reference.mean_inverse_depth();
        assert!((moved / expected - 1.0).abs() < 0.05, "{moved}, {expected}");
        assert_eq!(distance(&pose(2, -100.0)), f64::INFINITY, "all points behind the camera");
    }
}
