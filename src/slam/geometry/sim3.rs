//! Similarity transforms Sim(3): a rigid transform and the scale gauge of a keyframe.

use std::ops::Mul;

use nalgebra::{Matrix6, Vector3};

use crate::slam::geometry::se3::SE3;

/// A similarity `point_in_a = scale * rotation * point_in_b + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sim3 {
    /// Rotation and translation; the translation is in the unit of the target frame.
    pub rigid: SE3,
    /// Length in the target frame of a unit length in the source frame; positive.
    pub scale: f64,
}

impl Sim3 {
    /// The similarity that moves nothing.
    pub fn identity() -> Self {
        Self { rigid: SE3::identity(), scale: 1.0 }
    }

    /// A similarity from its rigid part and its scale.
    pub fn new(rigid: SE3, scale: f64) -> Self {
        Self { rigid, scale }
    }

    /// The similarity of this scale that takes one rigid pose to another: `a_from_b` of `a_from_camera` and
    /// `b_from_camera`.
    pub fn between(b_from_camera: &SE3, a_from_camera: &SE3, scale: f64) -> Self {
        let rotation = a_from_camera.rotation * b_from_camera.rotation.inverse();
        let translation = a_from_camera.translation - rotation * b_from_camera.translation * scale;
        Self::new(SE3 { rotation, translation }, scale)
    }

    /// The inverse: `b_from_a` of `a_from_b`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rigid.rotation.inverse();
        let translation = -(rotation * self.rigid.translation) / self.scale;
        Self { rigid: SE3 { rotation, translation }, scale: 1.0 / self.scale }
    }

    /// The rigid pose in this similarity's target frame of a camera that stands at
    /// `keyframe_from_camera` (translation in keyframe units): `world_from_camera` for
    /// `world_from_keyframe`. A camera has no scale of its own, so the result is rigid.
    pub fn place(&self, keyframe_from_camera: &SE3) -> SE3 {
        let mut scaled = *keyframe_from_camera;
        scaled.translation *= self.scale;
        self.rigid * scaled
    }

    /// The opposite of [`Sim3::place`]: `keyframe_from_camera` in keyframe units, of a camera
    /// at `world_from_camera`.
    pub fn locate(&self, world_from_camera: &SE3) -> SE3 {
        let mut relative = self.rigid.inverse() * *world_from_camera;
        relative.translation /= self.scale;
        relative
    }

    /// What a left increment ξ of a rigid pose becomes where the pose is moved by this similarity: `self · exp(ξ) · pose`
    /// is `exp(rigid_adjoint · ξ) · self · pose`.
    pub fn rigid_adjoint(&self) -> Matrix6<f64> {
        let mut adjoint = self.rigid.adjoint();
        adjoint.fixed_view_mut::<3, 3>(0, 0).scale_mut(self.scale);
        adjoint
    }

    /// Whether every number is finite and the scale positive.
    pub fn is_valid(&self) -> bool {
        self.rigid.is_finite() && self.scale.is_finite() && self.scale > 0.0
    }
}

impl Mul for Sim3 {
    type Output = Sim3;
    fn mul(self, right: Sim3) -> Sim3 {
        Sim3 {
            rigid: SE3 {
                rotation: (self.rigid * right.rigid).rotation,
                translation: self * right.rigid.translation,
            },
            scale: self.scale * right.scale,
        }
    }
}

impl Mul<Vector3<f64>> for Sim3 {
    type Output = Vector3<f64>;
    fn mul(self, point: Vector3<f64>) -> Vector3<f64> {
        self.rigid.rotation * point * self.scale + self.rigid.translation
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;
    use proptest::prelude::*;

    use super::*;

    fn similarity() -> impl Strategy<Value = Sim3> {
        (proptest::array::uniform6(-1.5f64..1.5), 0.1f64..10.0)
            .prop_map(|(twist, scale)| Sim3::new(SE3::exp(&Vector6::from(twist)), scale))
    }

    proptest! {
        #[test]
        fn product_acts_as_composition(a in similarity(), b in similarity(), p in proptest::array::uniform3(-5.0f64..5.0)) {
            let p = Vector3::from(p);
            prop_assert!(((a * b) * p - a * (b * p)).norm() < 1e-8);
            prop_assert!((a.inverse() * (a * p) - p).norm() < 1e-8);
        }

        #[test]
        fn locate_inverts_place(world in similarity(), camera in similarity()) {
            let back = world.locate(&world.place(&camera.rigid));
            prop_assert!((back.inverse() * camera.rigid).log().norm() < 1e-8);
        }

        #[test]
        fn a_placed_camera_sees_the_same_rays(world in similarity(), camera in similarity(), p in proptest::array::uniform3(0.5f64..5.0)) {
            // A point of the keyframe, seen by the camera, keeps its direction when both are placed in the world.
            let p = Vector3::from(p);
            let in_camera = camera.rigid.inverse() * p;
            let in_world_camera = world.place(&camera.rigid).inverse() * (world * p);
            prop_assert!((in_camera * world.scale - in_world_camera).norm() < 1e-7);
        }
    }
}
