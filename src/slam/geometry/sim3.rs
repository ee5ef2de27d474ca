//! Similarity transforms Sim(3): a rigid transform and the scale gauge of a keyframe.
//!
//! A twist is `(translation, rotation, log scale)`: the velocity of a point p is υ + ω × p + λ p. Increments act from
//! the **left**: `exp(twist) * a_from_b`.

use std::ops::Mul;

use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, UnitQuaternion, Vector3};

use crate::slam::geometry::se3::SE3;

/// A twist of Sim(3): translation, rotation, log scale.
pub type Twist7 = SVector<f64, 7>;
/// A matrix over twists of Sim(3).
pub type Matrix7 = SMatrix<f64, 7, 7>;

/// Maximum number of terms of a series. A twist with an angle of π and a scale of e^5 needs 40; a residual needs five
/// to ten.
const MAX_TERMS: u32 = 60;

/// A similarity `point_in_a = scale * rotation * point_in_b + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sim3 {
    /// Rotation and translation; the translation is in the unit of the target frame.
    pub rigid: SE3,
    /// Length in the target frame of a unit length in the source frame; positive.
    pub scale: f64,
}

impl Sim3 {
    /// The identity.
    pub fn identity() -> Self {
        Self { rigid: SE3::identity(), scale: 1.0 }
    }

    /// A similarity from its rigid part and its scale.
    pub fn new(rigid: SE3, scale: f64) -> Self {
        Self { rigid, scale }
    }

    /// The similarity of this scale that maps one rigid pose to another: `a_from_b` from `a_from_camera` and
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

    /// The rigid pose, in this similarity's target frame, of a camera at `keyframe_from_camera` (translation in
    /// keyframe units): `world_from_camera` for `world_from_keyframe`. A camera has no scale, so the result is rigid.
    pub fn transform_pose(&self, keyframe_from_camera: &SE3) -> SE3 {
        let mut scaled = *keyframe_from_camera;
        scaled.translation *= self.scale;
        self.rigid * scaled
    }

    /// The inverse of [`Sim3::transform_pose`]: `keyframe_from_camera`, in keyframe units, of a camera at
    /// `world_from_camera`.
    pub fn inverse_transform_pose(&self, world_from_camera: &SE3) -> SE3 {
        let mut relative = self.rigid.inverse() * *world_from_camera;
        relative.translation /= self.scale;
        relative
    }

    /// The exponential of a twist.
    pub fn exp(twist: &Twist7) -> Self {
        let (upsilon, omega, log_scale) = parts(twist);
        let translation = translation_jacobian(&omega, log_scale) * upsilon;
        let rotation = UnitQuaternion::from_scaled_axis(omega);
        Self::new(SE3 { rotation, translation }, log_scale.exp())
    }

    /// The twist whose exponential this is; the rotation angle lies in [0, π]. Not finite if the similarity is invalid.
    pub fn log(&self) -> Twist7 {
        let (omega, log_scale) = (self.rigid.rotation.scaled_axis(), self.scale.ln());
        // The eigenvalues of the Jacobian are (e^z − 1)/z at z = λ and λ ± iθ: not 0 for angles below 2π.
        let inverse = translation_jacobian(&omega, log_scale).try_inverse();
        let upsilon = inverse.unwrap_or(Matrix3::repeat(f64::NAN)) * self.rigid.translation;
        let mut twist = Twist7::zeros();
        twist.fixed_rows_mut::<3>(0).copy_from(&upsilon);
        twist.fixed_rows_mut::<3>(3).copy_from(&omega);
        twist[6] = log_scale;
        twist
    }

    /// The adjoint: `exp(adjoint * twist) = self * exp(twist) * self⁻¹`.
    pub fn adjoint(&self) -> Matrix7 {
        let mut adjoint = Matrix7::zeros();
        adjoint.fixed_view_mut::<6, 6>(0, 0).copy_from(&self.rigid_adjoint());
        adjoint.fixed_view_mut::<3, 1>(0, 6).copy_from(&-self.rigid.translation);
        adjoint[(6, 6)] = 1.0;
        adjoint
    }

    /// Maps a left increment ξ of a rigid pose to that of the pose moved by this similarity: `self · exp(ξ) · pose` is
    /// `exp(rigid_adjoint · ξ) · self · pose`.
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

/// The translation, rotation and log scale of a twist.
fn parts(twist: &Twist7) -> (Vector3<f64>, Vector3<f64>, f64) {
    (twist.fixed_rows::<3>(0).into_owned(), twist.fixed_rows::<3>(3).into_owned(), twist[6])
}

/// ∫₀¹ exp(τ(λI + ω^)) dτ, which maps the translation part of a twist to the translation: Σ Mᵏ/(k+1)! with M = λI + ω^.
/// The series needs no special case for small angles, small scales or both.
fn translation_jacobian(omega: &Vector3<f64>, log_scale: f64) -> Matrix3<f64> {
    let generator = omega.cross_matrix() + Matrix3::identity() * log_scale;
    let (mut term, mut sum) = (Matrix3::identity(), Matrix3::identity());
    for k in 1..MAX_TERMS {
        term = generator * term / f64::from(k + 1);
        sum += term;
        if term.norm_squared() < f64::EPSILON.powi(2) * sum.norm_squared() {
            break;
        }
    }
    sum
}

/// The inverse of the left Jacobian J of Sim(3), exp(ξ + δ) ≈ exp(J δ) exp(ξ): log(exp(δ) exp(ξ)) ≈ ξ + J⁻¹ δ.
///
/// J = Σ adᵏ/(k+1)! with ad = [M, υ^, −υ; 0, ω^, 0; 0, 0, 0]. Its powers keep that shape,
/// [Mᵏ, X, y; 0, ω^ᵏ, 0; 0, 0, 0], so only the upper blocks are summed, and the inverse is blockwise too. NaN if the
/// twist is not finite.
pub fn left_jacobian_inverse(twist: &Twist7) -> Matrix7 {
    let (upsilon, omega, log_scale) = parts(twist);
    let (upsilon_hat, omega_hat) = (upsilon.cross_matrix(), omega.cross_matrix());
    let generator = omega_hat + Matrix3::identity() * log_scale;
    // adᵏ/(k+1)!, and the sum over k; k = 1 here.
    let (mut motion, mut turn) = (generator * 0.5, omega_hat * 0.5);
    let (mut lever, mut stretch) = (upsilon_hat * 0.5, upsilon * -0.5);
    let mut sum_motion = Matrix3::identity() + motion;
    let mut sum_turn = Matrix3::identity() + turn;
    let (mut sum_lever, mut sum_stretch) = (lever, stretch);
    for k in 2..MAX_TERMS {
        let share = 1.0 / f64::from(k + 1);
        lever = (generator * lever + upsilon_hat * turn) * share;
        stretch = generator * stretch * share;
        motion = generator * motion * share;
        turn = omega_hat * turn * share;
        sum_motion += motion;
        sum_turn += turn;
        sum_lever += lever;
        sum_stretch += stretch;
        let size = |m: &Matrix3<f64>| m.norm_squared();
        let added = size(&motion) + size(&turn) + size(&lever) + stretch.norm_squared();
        if added < f64::EPSILON.powi(2) * (size(&sum_motion) + size(&sum_lever)) {
            break;
        }
    }
    let nan = Matrix3::repeat(f64::NAN);
    let motion = sum_motion.try_inverse().unwrap_or(nan);
    let turn = sum_turn.try_inverse().unwrap_or(nan);
    let mut inverse = Matrix7::zeros();
    inverse.fixed_view_mut::<3, 3>(0, 0).copy_from(&motion);
    inverse.fixed_view_mut::<3, 3>(0, 3).copy_from(&(-motion * sum_lever * turn));
    inverse.fixed_view_mut::<3, 1>(0, 6).copy_from(&(-motion * sum_stretch));
    inverse.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
    inverse[(6, 6)] = 1.0;
    inverse
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

    fn twist() -> impl Strategy<Value = Twist7> {
        // Angles up to 3 rad keep away from the branch of the logarithm at π.
        proptest::array::uniform7(-1.7f64..1.7).prop_map(Twist7::from)
    }

    fn difference(a: &Sim3, b: &Sim3) -> f64 {
        (a.inverse() * *b).log().norm()
    }

    proptest! {
        #[test]
        fn log_inverts_exp(xi in twist()) {
            prop_assert!((Sim3::exp(&xi).log() - xi).norm() < 1e-9);
        }

        #[test]
        fn small_twists_keep_their_digits(xi in twist(), exponents in proptest::array::uniform3(-12.0f64..0.0)) {
            // Each part small independently of the others: no special case of a closed form decides.
            let mut xi = xi;
            for (part, exponent) in [(0..3, exponents[0]), (3..6, exponents[1]), (6..7, exponents[2])] {
                part.for_each(|i| xi[i] *= 10f64.powf(exponent));
            }
            prop_assert!((Sim3::exp(&xi).log() - xi).norm() < 1e-12);
        }

        #[test]
        fn without_scale_it_is_a_rigid_transform(xi in twist()) {
            let rigid = Vector6::from_iterator(xi.iter().copied());
            let mut xi = xi;
            xi[6] = 0.0;
            let exp = Sim3::exp(&xi);
            prop_assert!(exp.scale == 1.0);
            prop_assert!((exp.rigid.translation - SE3::exp(&rigid).translation).norm() < 1e-12);
        }

        #[test]
        fn a_twist_is_one_motion(xi in twist(), a in 0.0f64..1.0) {
            let both = Sim3::exp(&(xi * a)) * Sim3::exp(&(xi * (1.0 - a)));
            prop_assert!(difference(&both, &Sim3::exp(&xi)) < 1e-9);
        }

        #[test]
        fn adjoint_moves_a_twist_to_the_left(a in similarity(), xi in twist()) {
            let xi = xi * 0.3;
            let left = Sim3::exp(&(a.adjoint() * xi)) * a;
            prop_assert!(difference(&left, &(a * Sim3::exp(&xi))) < 1e-7);
        }

        #[test]
        fn inverse_jacobian_is_that_of_the_logarithm(xi in twist()) {
            const STEP: f64 = 1e-5;
            let jacobian = left_jacobian_inverse(&xi);
            for i in 0..7 {
                let moved = |step: f64| {
                    let mut delta = Twist7::zeros();
                    delta[i] = step;
                    (Sim3::exp(&delta) * Sim3::exp(&xi)).log()
                };
                let numeric = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
                prop_assert!((jacobian.column(i) - numeric).norm() < 1e-6, "{i}: {}", jacobian.column(i) - numeric);
            }
        }

        #[test]
        fn product_acts_as_composition(a in similarity(), b in similarity(), p in proptest::array::uniform3(-5.0f64..5.0)) {
            let p = Vector3::from(p);
            prop_assert!(((a * b) * p - a * (b * p)).norm() < 1e-8);
            prop_assert!((a.inverse() * (a * p) - p).norm() < 1e-8);
        }

        #[test]
        fn locate_inverts_place(world in similarity(), camera in similarity()) {
            let back = world.inverse_transform_pose(&world.transform_pose(&camera.rigid));
            prop_assert!((back.inverse() * camera.rigid).log().norm() < 1e-8);
        }

        #[test]
        fn a_placed_camera_sees_the_same_rays(world in similarity(), camera in similarity(), p in proptest::array::uniform3(0.5f64..5.0)) {
            // A point in keyframe units, seen by the camera, keeps its direction when both are placed in the world.
            let p = Vector3::from(p);
            let in_camera = camera.rigid.inverse() * p;
            let in_world_camera = world.transform_pose(&camera.rigid).inverse() * (world * p);
            prop_assert!((in_camera * world.scale - in_world_camera).norm() < 1e-7);
        }
    }
}
