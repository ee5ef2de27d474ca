//! Viewing directions of a trajectory: from above and from the side.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use crate::slam::trajectory::StampedPose;
use crate::slam::up::up_direction;

/// Orthonormal directions of a drawing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Views {
    /// Level, along the largest extent of the trajectory.
    right: Vector3<f64>,
    /// Level, into the side view.
    forward: Vector3<f64>,
    /// Up, as far as it is known.
    up: Vector3<f64>,
}

impl Views {
    /// Directions for these poses, with `up` if it is known, else with the mean up direction of the cameras. Where the
    /// cameras do not agree on one (a camera that looks straight down may turn freely) only the extent of their path is
    /// used.
    pub fn of(poses: &[StampedPose], up: Option<Vector3<f64>>) -> Self {
        let extent = extent_axes(poses);
        let up = up.or_else(|| up_direction(poses.iter(), std::iter::empty()));
        let up = up.unwrap_or(extent[2]);
        let level = |axis: &Vector3<f64>| axis - up * up.dot(axis);
        // At most one of the extent's axes is along `up`; the largest other one gives the width.
        let right = extent.iter().map(level).find(|axis| axis.norm() > 0.5);
        let right = right.map_or_else(Vector3::x, |axis| axis.normalize());
        Self { right, forward: up.cross(&right), up }
    }

    /// The same views in a coordinate frame that is turned against this one.
    pub fn turned(self, rotation: &UnitQuaternion<f64>) -> Self {
        let [right, forward, up] = [self.right, self.forward, self.up].map(|axis| rotation * axis);
        Self { right, forward, up }
    }

    /// Right and forward: seen from above.
    pub fn seen_from_above(&self, position: &Vector3<f64>) -> [f64; 2] {
        [self.right.dot(position), self.forward.dot(position)]
    }

    /// Right and up: seen from the side.
    pub fn seen_from_side(&self, position: &Vector3<f64>) -> [f64; 2] {
        [self.right.dot(position), self.up.dot(position)]
    }
}

/// Principal axes of the positions, the longest first; each points to its larger coordinate.
fn extent_axes(poses: &[StampedPose]) -> [Vector3<f64>; 3] {
    let positions = || poses.iter().map(|pose| pose.world_from_camera.translation);
    let count = poses.len().max(1) as f64;
    let mean = positions().sum::<Vector3<f64>>() / count;
    let covariance: Matrix3<f64> =
        positions().map(|position| (position - mean) * (position - mean).transpose() / count).sum();
    if !covariance.iter().all(|c| c.is_finite()) {
        return [Vector3::x(), Vector3::z(), -Vector3::y()];
    }
    let eigen = covariance.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    order.map(|i| {
        let axis: Vector3<f64> = eigen.eigenvectors.column(i).into();
        if axis[axis.iamax()] < 0.0 { -axis } else { axis }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;

    #[test]
    fn an_upright_camera_on_the_floor_is_seen_flat_from_the_side() {
        // Optical axes: y is down, so the floor is the x–z plane.
        let poses: Vec<StampedPose> = (0..50)
            .map(|i| {
                let t = f64::from(i) * 0.1;
                let mut world_from_camera = SE3::identity();
                world_from_camera.translation = Vector3::new(t.sin(), 0.0, 3.0 * t);
                StampedPose { nanos: i64::from(i), world_from_camera }
            })
            .collect();
        let views = Views::of(&poses, None);
        for pose in &poses {
            assert!(views.seen_from_side(&pose.world_from_camera.translation)[1].abs() < 1e-12);
        }
        let [x, y] = views.seen_from_above(&Vector3::new(0.0, 0.0, 1.0));
        assert!(x > 0.9 && y.abs() < 0.5, "the long way lies along x");
        let slope = Views::of(&poses, Some(-Vector3::x()));
        assert!((slope.seen_from_side(&-Vector3::x())[1] - 1.0).abs() < 1e-12, "up is as given");
        assert!(slope.seen_from_above(&Vector3::x()).iter().all(|c| c.abs() < 1e-12));
        let _ = Views::of(&[], None);
        let _ = Views::of(&poses[..1], None);
    }
}
