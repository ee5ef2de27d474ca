//! Rigid transforms SE(3) with their exponential map.
//!
//! A transform is named `a_from_b` and maps `point_in_a = a_from_b * point_in_b`. A twist is
//! `(translation, rotation)`; increments act from the **left**: `exp(twist) * a_from_b`.

use std::ops::Mul;

use nalgebra::{Matrix3, Matrix6, Quaternion, UnitQuaternion, Vector3, Vector6};

/// Rotation angle (radians) below which series replace the closed forms: their truncation error, O(angle⁴), is then
/// below the rounding of f64.
const SMALL_ANGLE_RAD: f64 = 1e-4;

/// A rigid transform.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SE3 {
    /// Rotation part.
    pub rotation: UnitQuaternion<f64>,
    /// Translation part, in the unit of the target frame.
    pub translation: Vector3<f64>,
}

impl SE3 {
    /// The identity.
    pub fn identity() -> Self {
        Self { rotation: UnitQuaternion::identity(), translation: Vector3::zeros() }
    }

    /// From a quaternion `(x, y, z, w)` and a translation; the quaternion is normalised.
    /// `None` if a number is not finite or the quaternion is too short to have a direction.
    pub fn try_from_parts(quaternion_xyzw: [f64; 4], translation: [f64; 3]) -> Option<Self> {
        let [x, y, z, w] = quaternion_xyzw;
        let quaternion = Quaternion::new(w, x, y, z);
        let norm = quaternion.norm();
        let finite = norm.is_finite() && translation.iter().all(|t| t.is_finite());
        // A unit quaternion written with few digits stays far above this length.
        const SHORTEST_QUATERNION: f64 = 1e-3;
        (finite && norm > SHORTEST_QUATERNION).then(|| Self {
            rotation: UnitQuaternion::from_quaternion(quaternion),
            translation: Vector3::from(translation),
        })
    }

    /// The quaternion as `(x, y, z, w)`.
    pub fn quaternion_xyzw(&self) -> [f64; 4] {
        let q = self.rotation.quaternion();
        [q.i, q.j, q.k, q.w]
    }

    /// The rotation as a matrix (faster than the quaternion in inner loops).
    pub fn rotation_matrix(&self) -> Matrix3<f64> {
        *self.rotation.to_rotation_matrix().matrix()
    }

    /// The inverse transform: `b_from_a` of `a_from_b`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// The exponential of a twist `(translation, rotation)`.
    pub fn exp(twist: &Vector6<f64>) -> Self {
        let upsilon = Vector3::new(twist[0], twist[1], twist[2]);
        let omega = Vector3::new(twist[3], twist[4], twist[5]);
        Self {
            rotation: UnitQuaternion::from_scaled_axis(omega),
            translation: left_jacobian(&omega) * upsilon,
        }
    }

    /// The twist whose exponential this is; the rotation angle lies in [0, π].
    pub fn log(&self) -> Vector6<f64> {
        let omega = self.rotation.scaled_axis();
        let upsilon = left_jacobian_inverse(&omega) * self.translation;
        Vector6::new(upsilon.x, upsilon.y, upsilon.z, omega.x, omega.y, omega.z)
    }

    /// The adjoint: `exp(adjoint * twist) = self * exp(twist) * self⁻¹`.
    pub fn adjoint(&self) -> Matrix6<f64> {
        let rotation = self.rotation_matrix();
        let mut adjoint = Matrix6::zeros();
        adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
        adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
        adjoint
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&(self.translation.cross_matrix() * rotation));
        adjoint
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.translation.iter().all(|t| t.is_finite())
            && self.rotation.coords.iter().all(|q| q.is_finite())
    }
}

impl Mul for SE3 {
    type Output = SE3;
    fn mul(self, right: SE3) -> SE3 {
        SE3 {
            // Renormalised so that long chains of products stay rotations.
            rotation: UnitQuaternion::new_normalize((self.rotation * right.rotation).into_inner()),
            translation: self.rotation * right.translation + self.translation,
        }
    }
}

impl Mul<Vector3<f64>> for SE3 {
    type Output = Vector3<f64>;
    fn mul(self, point: Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }
}

/// Left Jacobian of SO(3): carries the translation part of a twist to the translation.
fn left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle = omega.norm();
    let hat = omega.cross_matrix();
    let (first, second) = if angle < SMALL_ANGLE_RAD {
        (0.5 - angle * angle / 24.0, 1.0 / 6.0 - angle * angle / 120.0)
    } else {
        ((1.0 - angle.cos()) / (angle * angle), (angle - angle.sin()) / angle.powi(3))
    };
    Matrix3::identity() + hat * first + hat * hat * second
}

/// Inverse of [`left_jacobian`].
fn left_jacobian_inverse(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle = omega.norm();
    let hat = omega.cross_matrix();
    let second = if angle < SMALL_ANGLE_RAD {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        let half = 0.5 * angle;
        (1.0 - half / half.tan()) / (angle * angle)
    };
    Matrix3::identity() - hat * 0.5 + hat * hat * second
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn twist() -> impl Strategy<Value = Vector6<f64>> {
        // Angles up to 3 rad keep away from the branch of the logarithm at π.
        proptest::array::uniform6(-1.7f64..1.7).prop_map(Vector6::from)
    }

    fn near(a: &SE3, b: &SE3) -> bool {
        (a.inverse() * *b).log().norm() < 1e-9
    }

    proptest! {
        #[test]
        fn log_inverts_exp(xi in twist()) {
            prop_assert!((SE3::exp(&xi).log() - xi).norm() < 1e-9);
        }

        #[test]
        fn small_twists_keep_their_digits(xi in twist(), exponent in -12.0f64..-2.0) {
            let xi = xi * 10f64.powf(exponent);
            prop_assert!((SE3::exp(&xi).log() - xi).norm() < 1e-12 * (1.0 + xi.norm()));
        }

        #[test]
        fn product_is_associative_and_inverse_cancels(a in twist(), b in twist(), c in twist()) {
            let (a, b, c) = (SE3::exp(&a), SE3::exp(&b), SE3::exp(&c));
            prop_assert!(near(&((a * b) * c), &(a * (b * c))));
            prop_assert!(near(&(a * a.inverse()), &SE3::identity()));
        }

        #[test]
        fn adjoint_moves_a_twist_to_the_left(a in twist(), xi in twist()) {
            let (transform, xi) = (SE3::exp(&a), xi * 0.3);
            let left = SE3::exp(&(transform.adjoint() * xi)) * transform;
            prop_assert!(near(&left, &(transform * SE3::exp(&xi))));
        }

        #[test]
        fn product_acts_as_composition(a in twist(), b in twist(), p in proptest::array::uniform3(-5.0f64..5.0)) {
            let (a, b, p) = (SE3::exp(&a), SE3::exp(&b), Vector3::from(p));
            prop_assert!(((a * b) * p - a * (b * p)).norm() < 1e-9);
        }
    }

    #[test]
    fn invalid_parts_are_rejected() {
        assert!(SE3::try_from_parts([0.0, 0.0, 0.0, 0.0], [0.0; 3]).is_none());
        assert!(SE3::try_from_parts([f64::NAN, 0.0, 0.0, 1.0], [0.0; 3]).is_none());
        assert!(SE3::try_from_parts([0.0, 0.0, 0.0, 1.0], [f64::INFINITY, 0.0, 0.0]).is_none());
        assert!(SE3::try_from_parts([0.0, 0.0, 0.0, 2.0], [1.0, 2.0, 3.0]).is_some());
    }
}
