//! Conversion from our axes to ROS's, for poses and their covariances.
//!
//! Ours are those of the first camera: x right, y down, z forward. The frames `map` and `odom` follow REP
//! 103: x forward, y left, z up. Both take their orientation from the first camera: `z` is up only as far as
//! that was level. Lengths are in map units. A camera keeps its own axes, which ROS calls an optical frame.

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector3, Vector6};
use semidense::slam::geometry::se3::SE3;

use crate::ros::message;

/// The rotation from our axes to REP 103's: x forward is our z, y left our -x, z up our -y. As a quaternion
/// it is exact, so a pose keeps all its digits.
pub fn ros_from_world() -> SE3 {
    let half = 0.5;
    let quaternion = nalgebra::Quaternion::new(half, -half, half, -half);
    SE3 { rotation: UnitQuaternion::new_unchecked(quaternion), translation: Vector3::zeros() }
}

/// A pose as a message.
pub fn pose_message(pose: &SE3) -> message::Pose {
    let [x, y, z, w] = pose.quaternion_xyzw();
    let orientation = message::Quaternion { x, y, z, w };
    message::Pose { position: vector_message(&pose.translation), orientation }
}

/// A transform as a message.
pub fn transform_message(transform: &SE3) -> message::Transform {
    let message::Pose { position, orientation } = pose_message(transform);
    message::Transform { translation: position, rotation: orientation }
}

/// A vector as a message.
pub fn vector_message(vector: &Vector3<f64>) -> message::Vector3 {
    message::Vector3 { x: vector.x, y: vector.y, z: vector.z }
}

/// The symmetric matrix with this upper triangle, row-major.
fn matrix(upper: &[f64; 21]) -> Matrix6<f64> {
    let mut entries = upper.iter();
    let mut matrix = Matrix6::zeros();
    for row in 0..6 {
        for column in row..6 {
            let entry = entries.next().copied().unwrap_or_default();
            matrix[(row, column)] = entry;
            matrix[(column, row)] = entry;
        }
    }
    matrix
}

/// A covariance in ROS's layout: row-major. Exactly symmetric, as a filter may check.
fn row_major(covariance: &Matrix6<f64>) -> [f64; 36] {
    let symmetric = (covariance + covariance.transpose()) * 0.5;
    std::array::from_fn(|at| symmetric[(at / 6, at % 6)])
}

/// Rotates both three-vectors of a six-vector by `rotation`.
fn rotate_both(rotation: &Matrix3<f64>) -> Matrix6<f64> {
    let mut both = Matrix6::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation);
    both.fixed_view_mut::<3, 3>(3, 3).copy_from(rotation);
    both
}

/// Covariance of position and fixed-axis rotation in our axes, from that of a pose's left increment ξ, which
/// rotates about the origin: the error of a position p is ξ_t + ξ_ω × p.
pub fn place_covariance(position: &Vector3<f64>, left_increment: &[f64; 21]) -> Matrix6<f64> {
    let mut error_from_increment = Matrix6::identity();
    error_from_increment.fixed_view_mut::<3, 3>(0, 3).copy_from(&-position.cross_matrix());
    error_from_increment * matrix(left_increment) * error_from_increment.transpose()
}

/// The same in `map`, from the left increment of `map_from_camera`.
pub fn map_covariance(map_from_camera: &SE3, left_increment: &[f64; 21]) -> [f64; 36] {
    let turned = rotate_both(&ros_from_world().rotation_matrix());
    let covariance = place_covariance(&map_from_camera.translation, left_increment);
    row_major(&(turned * covariance * turned.transpose()))
}

/// Covariance of position and fixed-axis rotation in `odom`, from that of the left increment ξ of
/// `current_from_keyframe`, whose translation is in keyframe units of `unit` in the world. The pose of the camera is
/// then `world_from_camera · exp(-ξ)`. The error of the keyframe's own pose, and hence drift, is not included.
pub fn odometry_covariance(
    world_from_camera: &SE3,
    unit: f64,
    left_increment: &[f64; 21],
) -> [f64; 36] {
    let ros_from_camera = (ros_from_world() * *world_from_camera).rotation_matrix();
    let scale = Vector6::new(unit, unit, unit, 1.0, 1.0, 1.0);
    // The sign of the increment does not affect its covariance.
    let jacobian = rotate_both(&ros_from_camera) * Matrix6::from_diagonal(&scale);
    row_major(&(jacobian * matrix(left_increment) * jacobian.transpose()))
}

/// The covariance of velocities in the camera's axes, linear then angular: only its layout changes.
pub fn velocity_covariance(upper: &[f64; 21]) -> [f64; 36] {
    row_major(&matrix(upper))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A covariance without symmetry between axes.
    fn covariance() -> ([f64; 21], Matrix6<f64>) {
        let root = Matrix6::from_fn(|r, c| ((r * 7 + c * 3) % 5) as f64 * 0.3 - 0.4);
        let full = root * root.transpose() + Matrix6::identity() * 0.1;
        let pairs = (0..6).flat_map(|r| (r..6).map(move |c| (r, c)));
        let upper: Vec<f64> = pairs.map(|(r, c)| full[(r, c)]).collect();
        (upper.try_into().unwrap(), full)
    }

    fn somewhere() -> SE3 {
        SE3::exp(&Vector6::new(3.0, -2.0, 5.0, 0.4, -0.9, 0.3))
    }

    /// The error between two poses as ROS defines it: position, and the rotation about fixed axes that takes
    /// one orientation to the other.
    fn ros_error(from: &SE3, to: &SE3) -> Vector6<f64> {
        let (from, to) = (ros_from_world() * *from, ros_from_world() * *to);
        let position = to.translation - from.translation;
        let rotation = (to.rotation * from.rotation.inverse()).scaled_axis();
        Vector6::new(position.x, position.y, position.z, rotation.x, rotation.y, rotation.z)
    }

    /// The covariance in ROS of `full`, by finite differences: `moved` is the pose after an increment.
    fn by_differences(moved: impl Fn(&Vector6<f64>) -> SE3, full: &Matrix6<f64>) -> Matrix6<f64> {
        const STEP: f64 = 1e-6;
        let mut jacobian = Matrix6::zeros();
        for column in 0..6 {
            let mut step = Vector6::zeros();
            step[column] = STEP;
            let difference = ros_error(&moved(&-step), &moved(&step)) / (2.0 * STEP);
            jacobian.set_column(column, &difference);
        }
        jacobian * full * jacobian.transpose()
    }

    fn assert_same(found: &[f64; 36], expected: &Matrix6<f64>) {
        for (at, found) in found.iter().enumerate() {
            let expected = expected[(at / 6, at % 6)];
            assert!((found - expected).abs() < 1e-7 * expected.abs().max(1.0), "{at}: {found}");
        }
    }

    #[test]
    fn axes_are_forward_left_up() {
        let turned = |x, y, z| ros_from_world() * Vector3::new(x, y, z);
        assert_eq!(turned(0.0, 0.0, 1.0), Vector3::x());
        assert_eq!(turned(-1.0, 0.0, 0.0), Vector3::y());
        assert_eq!(turned(0.0, -1.0, 0.0), Vector3::z());
    }

    #[test]
    fn the_covariance_in_the_map_matches_finite_differences() {
        let (upper, full) = covariance();
        let expected = by_differences(|xi| SE3::exp(xi) * somewhere(), &full);
        assert_same(&map_covariance(&somewhere(), &upper), &expected);
    }

    #[test]
    fn the_covariance_of_odometry_matches_finite_differences() {
        const UNIT: f64 = 2.5;
        let (upper, full) = covariance();
        let world_from_keyframe = SE3::exp(&Vector6::new(-1.0, 2.0, 0.5, -0.7, 0.2, 1.1));
        let current_from_keyframe = SE3::exp(&Vector6::new(0.3, 0.1, -0.2, 0.1, 0.2, -0.3));
        let placed = |xi: &Vector6<f64>| {
            let mut keyframe_from_camera = (SE3::exp(xi) * current_from_keyframe).inverse();
            keyframe_from_camera.translation *= UNIT;
            world_from_keyframe * keyframe_from_camera
        };
        let expected = by_differences(placed, &full);
        assert_same(&odometry_covariance(&placed(&Vector6::zeros()), UNIT, &upper), &expected);
    }

    #[test]
    fn a_velocity_keeps_its_axes() {
        let (upper, full) = covariance();
        assert_same(&velocity_covariance(&upper), &full);
    }
}
