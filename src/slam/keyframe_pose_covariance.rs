//! Covariance of a keyframe's pose in the map, and of the poses of cameras on it.
//!
//! The pose is `map_from_keyframe` with its unit s. Its errors are (ξ, λ): the left increment of its rigid part,
//! `exp(ξ) map_from_keyframe`, ξ = (translation, rotation) in map units and radians, and the unit s e^λ. All left
//! increments rotate about the one origin of the map, so the cameras of a keyframe share its error. With Δ from the
//! keyframe to the camera, in the map, and ε the left increment of `current_from_keyframe`:
//! ```text
//! ξ_camera = ξ + (λ Δ, 0) − Ad(map_from_camera) diag(s, s, s, 1, 1, 1) ε
//! ```
//! The error of a position p is δp = ξ_t + ξ_ω × p. The first keyframe of an epoch is the gauge and has no error.

use nalgebra::{Matrix6, SMatrix, SVector, Vector3};

use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::pose::UNKNOWN_VARIANCE;

/// Number of errors of a keyframe's pose: six of its rigid part, one of its unit.
pub const KEYFRAME_POSE_ERRORS: usize = 7;
/// Entries of the upper triangle of their covariance.
pub const KEYFRAME_POSE_ENTRIES: usize = 28;

/// A covariance of (ξ, λ).
pub type KeyframePoseMatrix = SMatrix<f64, KEYFRAME_POSE_ERRORS, KEYFRAME_POSE_ERRORS>;

/// Variances of an unknown pose: for the rigid part those of a pose that is not claimed, for the logarithm of the unit
/// a factor of e. No variance is larger.
const IGNORANCE: [f64; KEYFRAME_POSE_ERRORS] = {
    let mut variances = [UNKNOWN_VARIANCE; KEYFRAME_POSE_ERRORS];
    variances[KEYFRAME_POSE_ERRORS - 1] = 1.0;
    variances
};

/// By rounding, variances may be negative by this share of the largest, and so may eigenvalues of the correlations.
const ROUNDING: f64 = 1e-9;

/// Covariance of the errors (ξ, λ) of a keyframe's pose.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct KeyframePoseCovariance {
    upper_triangle: [f64; KEYFRAME_POSE_ENTRIES],
}

/// A keyframe's pose and its covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UncertainPose {
    /// Its pose in the map, with its unit.
    pub map_from_keyframe: Sim3,
    /// Its covariance.
    pub covariance: KeyframePoseCovariance,
}

impl KeyframePoseCovariance {
    /// The covariance of an exact pose.
    pub const ZERO: Self = Self { upper_triangle: [0.0; KEYFRAME_POSE_ENTRIES] };

    /// The covariance of an unknown pose.
    pub fn unknown() -> Self {
        Self::of(&KeyframePoseMatrix::from_diagonal(&IGNORANCE.into()))
    }

    fn of(matrix: &KeyframePoseMatrix) -> Self {
        let mut entries = entries();
        let mean = |(i, j)| 0.5 * (matrix[(i, j)] + matrix[(j, i)]);
        Self { upper_triangle: std::array::from_fn(|_| entries.next().map_or(0.0, mean)) }
    }

    /// From a symmetric matrix that is a sum. A variance that is negative by rounding alone becomes zero, one beyond
    /// ignorance is clipped to it with its correlations unchanged; a matrix that is not a covariance even so becomes
    /// complete ignorance.
    pub fn bounded(matrix: &KeyframePoseMatrix) -> Self {
        let covariance = Self::of(matrix);
        let matrix = covariance.matrix();
        let variances = matrix.diagonal();
        let least = -ROUNDING * variances.max();
        // Rows and columns are scaled alike: a covariance stays one.
        let factors = SVector::<f64, KEYFRAME_POSE_ERRORS>::from_fn(|k, _| match variances[k] {
            variance if (least..0.0).contains(&variance) => 0.0,
            variance if variance > IGNORANCE[k] => (IGNORANCE[k] / variance).sqrt(),
            _ => 1.0,
        });
        let mut within = scaled(&matrix, &factors);
        // Rounding may leave it beside the bound, by which it is recognised.
        for k in (0..KEYFRAME_POSE_ERRORS).filter(|&k| variances[k] > IGNORANCE[k]) {
            within[(k, k)] = IGNORANCE[k];
        }
        Self::from_upper_triangle(Self::of(&within).upper_triangle).unwrap_or_else(Self::unknown)
    }

    /// From its upper triangle, row by row; `None` where that is not a covariance, or an implausible one.
    pub fn from_upper_triangle(upper_triangle: [f64; KEYFRAME_POSE_ENTRIES]) -> Option<Self> {
        let covariance = Self { upper_triangle };
        let matrix = covariance.matrix();
        let is_bounded = upper_triangle.iter().all(|x| x.is_finite())
            && (0..KEYFRAME_POSE_ERRORS).all(|k| (0.0..=IGNORANCE[k]).contains(&matrix[(k, k)]));
        if !is_bounded {
            return None;
        }
        // Lengths and angles have no common scale.
        let deviations = deviations(&matrix);
        let correlation = scaled(&matrix, &deviations.map(|of| 1.0 / of));
        (correlation.symmetric_eigenvalues().min() >= -ROUNDING).then_some(covariance)
    }

    /// Its upper triangle, row by row.
    pub fn upper_triangle(&self) -> [f64; KEYFRAME_POSE_ENTRIES] {
        self.upper_triangle
    }

    /// The whole matrix.
    pub fn matrix(&self) -> KeyframePoseMatrix {
        let mut matrix = KeyframePoseMatrix::zeros();
        for ((i, j), value) in entries().zip(self.upper_triangle) {
            (matrix[(i, j)], matrix[(j, i)]) = (value, value);
        }
        matrix
    }

    /// Whether a variance is at its upper bound.
    fn is_at_bound(&self) -> bool {
        self.matrix().diagonal().iter().zip(IGNORANCE).any(|(&variance, bound)| variance >= bound)
    }

    /// Covariance of the left increment (translation, rotation, log scale) of `keyframe_from_map`, in the keyframe's
    /// unit, where this is that of its pose: of `keyframe_from_other` if it is relative to another.
    pub fn of_left_increment(&self, map_from_keyframe: &Sim3) -> KeyframePoseMatrix {
        let mut by_errors = map_from_keyframe.inverse().adjoint();
        by_errors.fixed_view_mut::<7, 1>(0, 6).fill(0.0);
        by_errors[(6, 6)] = 1.0;
        by_errors * self.matrix() * by_errors.transpose()
    }

    /// With that of an independent error added.
    pub fn plus(&self, other: &KeyframePoseMatrix) -> Self {
        Self::bounded(&(self.matrix() + other))
    }

    /// The covariance after the map is transformed by `by`.
    pub fn transported(&self, by: &Sim3) -> Self {
        let by = transport(by);
        Self::bounded(&(by * self.matrix() * by.transpose()))
    }
}

impl UncertainPose {
    /// The gauge.
    pub fn exact(map_from_keyframe: Sim3) -> Self {
        Self { map_from_keyframe, covariance: KeyframePoseCovariance::ZERO }
    }

    /// Covariance of the left increment of `map_from_camera`, map units and radians, of a camera at
    /// `keyframe_from_camera` with this covariance of the left increment of `current_from_keyframe`, both in the
    /// keyframe's unit. Where the result is not finite the pose is unknown.
    pub fn of_camera(&self, keyframe_from_camera: &SE3, covariance: &Matrix6<f64>) -> Matrix6<f64> {
        let sum = self.with_camera(keyframe_from_camera, covariance);
        let mut pose = sum.fixed_view::<6, 6>(0, 0).into_owned();
        if !pose.iter().all(|x| x.is_finite()) {
            return Matrix6::from_diagonal_element(UNKNOWN_VARIANCE);
        }
        // Only by rounding is a variance negative.
        (0..6).for_each(|k| pose[(k, k)] = pose[(k, k)].max(0.0));
        pose
    }

    /// The covariance of a keyframe created at that camera, its unit as uncertain as this one's.
    pub fn of_next(
        &self,
        keyframe_from_camera: &SE3,
        covariance: &Matrix6<f64>,
    ) -> KeyframePoseCovariance {
        KeyframePoseCovariance::bounded(&self.with_camera(keyframe_from_camera, covariance))
    }

    fn with_camera(
        &self,
        keyframe_from_camera: &SE3,
        covariance: &Matrix6<f64>,
    ) -> KeyframePoseMatrix {
        let map_from_camera = self.map_from_keyframe.transform_pose(keyframe_from_camera);
        let mut by_camera = map_from_camera.adjoint();
        by_camera.fixed_columns_mut::<3>(0).scale_mut(self.map_from_keyframe.scale);
        let mut sum = self.covariance_at(&map_from_camera.translation);
        let mut pose = sum.fixed_view_mut::<6, 6>(0, 0);
        pose += by_camera * covariance * by_camera.transpose();
        sum
    }

    /// The covariance of something at `position` in the map that is exact relative to this keyframe.
    pub fn covariance_at(&self, position: &Vector3<f64>) -> KeyframePoseMatrix {
        let mut by_place = KeyframePoseMatrix::identity();
        let lever = position - self.map_from_keyframe.rigid.translation;
        by_place.fixed_view_mut::<3, 1>(0, 6).copy_from(&lever);
        by_place * self.covariance.matrix() * by_place.transpose()
    }

    /// Covariance of a keyframe that follows its leader from `was` to `is`: the leader's, plus the uncertainty between
    /// them, which is what its own had beyond the leader's.
    pub fn following(&self, was: &Self, is: &Self) -> KeyframePoseCovariance {
        let moved = is.map_from_keyframe * was.map_from_keyframe.inverse();
        let position = moved * self.map_from_keyframe.rigid.translation;
        // A variance at its bound was larger: if only one of two was clipped, or they were clipped elsewhere, their
        // difference is not the uncertainty between them.
        if was.covariance.is_at_bound() {
            return KeyframePoseCovariance::bounded(&is.covariance_at(&position));
        }
        // Unknown for a separate reason: its leader does not change that.
        if self.covariance.is_at_bound() {
            return self.covariance;
        }
        let own = self.covariance.matrix();
        let beyond = own - was.covariance_at(&self.map_from_keyframe.rigid.translation);
        let between = positive_part(&beyond, &deviations(&own));
        let by = transport(&moved);
        KeyframePoseCovariance::bounded(
            &(is.covariance_at(&position) + by * between * by.transpose()),
        )
    }
}

/// Rows and columns of the upper triangle.
fn entries() -> impl Iterator<Item = (usize, usize)> {
    (0..KEYFRAME_POSE_ERRORS)
        .flat_map(|row| (row..KEYFRAME_POSE_ERRORS).map(move |column| (row, column)))
}

/// Transforms (ξ, λ) into the map that `by` makes of this one.
pub fn transport(by: &Sim3) -> KeyframePoseMatrix {
    let mut matrix = KeyframePoseMatrix::identity();
    matrix.fixed_view_mut::<6, 6>(0, 0).copy_from(&by.rigid_adjoint());
    matrix
}

/// Standard deviations; 1 for exact entries.
fn deviations(covariance: &KeyframePoseMatrix) -> SVector<f64, KEYFRAME_POSE_ERRORS> {
    covariance.diagonal().map(|variance| if variance > 0.0 { variance.sqrt() } else { 1.0 })
}

/// Rows and columns multiplied by `by`.
fn scaled(
    matrix: &KeyframePoseMatrix,
    by: &SVector<f64, KEYFRAME_POSE_ERRORS>,
) -> KeyframePoseMatrix {
    KeyframePoseMatrix::from_fn(|row, column| matrix[(row, column)] * by[row] * by[column])
}

/// The positive semi-definite part of a symmetric matrix, its entries measured in `unit`.
fn positive_part(
    matrix: &KeyframePoseMatrix,
    unit: &SVector<f64, KEYFRAME_POSE_ERRORS>,
) -> KeyframePoseMatrix {
    let mut eigen = scaled(matrix, &unit.map(|of| 1.0 / of)).symmetric_eigen();
    eigen.eigenvalues.apply(|value| *value = value.max(0.0));
    scaled(&eigen.recompose(), unit)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;

    /// Small enough for products of errors to vanish.
    const STEP: f64 = 1e-6;

    fn place() -> Sim3 {
        Sim3::new(SE3::exp(&Vector6::new(3.0, -2.0, 1.5, 0.4, -0.7, 0.2)), 1.7)
    }

    fn camera() -> SE3 {
        SE3::exp(&Vector6::new(0.2, -0.3, 0.4, 0.1, 0.2, -0.3))
    }

    /// Errors of a pose, of a size that depends on `salt`.
    fn errors(salt: f64) -> SVector<f64, KEYFRAME_POSE_ERRORS> {
        SVector::from_fn(|row, _| (salt + 1.3 * row as f64).sin())
    }

    fn of_errors(errors: &SVector<f64, KEYFRAME_POSE_ERRORS>) -> KeyframePoseCovariance {
        KeyframePoseCovariance::bounded(&(errors * errors.transpose()))
    }

    /// The pose with this error.
    fn off(place: &Sim3, by: &SVector<f64, KEYFRAME_POSE_ERRORS>) -> Sim3 {
        let pose = SE3::exp(&by.fixed_rows::<6>(0).into_owned());
        Sim3::new(pose * place.rigid, place.scale * by[6].exp())
    }

    /// The error of one pose relative to another.
    fn difference(from: &Sim3, to: &Sim3) -> SVector<f64, KEYFRAME_POSE_ERRORS> {
        let mut found = SVector::<f64, KEYFRAME_POSE_ERRORS>::zeros();
        found.fixed_rows_mut::<6>(0).copy_from(&(to.rigid * from.rigid.inverse()).log());
        found[6] = (to.scale / from.scale).ln();
        found / STEP
    }

    fn assert_near(found: &KeyframePoseMatrix, expected: &SVector<f64, KEYFRAME_POSE_ERRORS>) {
        let error = (found - expected * expected.transpose()).norm();
        assert!(error < 1e-4 * (1.0 + found.norm()), "{found}{expected}");
    }

    #[test]
    fn the_error_of_a_camera_combines_those_of_its_keyframe_and_its_pose_on_it() {
        let relative = Vector6::new(0.5, -0.4, 0.3, 0.6, -0.2, 0.1);
        for (of_place, of_pose) in [(1.0, 0.0), (0.0, 1.0), (-0.7, 0.9)] {
            let (by, relative) = (errors(0.3) * of_place, relative * of_pose);
            let standing = |map_from_keyframe: &Sim3, twist: Vector6<f64>| {
                let current_from_keyframe = SE3::exp(&twist) * camera().inverse();
                let rigid = map_from_keyframe.transform_pose(&current_from_keyframe.inverse());
                Sim3::new(rigid, map_from_keyframe.scale)
            };
            let exact = standing(&place(), Vector6::zeros());
            let expected =
                difference(&exact, &standing(&off(&place(), &(by * STEP)), relative * STEP));
            // Errors of keyframe and camera are independent: each alone, or their sum.
            let covariance = relative * relative.transpose();
            let known = UncertainPose { map_from_keyframe: place(), covariance: of_errors(&by) };
            let found = known.with_camera(&camera(), &covariance);
            if of_place == 0.0 || of_pose == 0.0 {
                assert_near(&found, &expected);
                assert_near(&known.of_next(&camera(), &covariance).matrix(), &expected);
            }
            let alone = |place: f64, pose: f64| {
                let covariance = of_errors(&(by * place));
                UncertainPose { covariance, ..known }
                    .of_camera(&camera(), &(relative * relative.transpose() * pose))
            };
            let sum = alone(1.0, 0.0) + alone(0.0, 1.0);
            assert!((known.of_camera(&camera(), &covariance) - sum).norm() < 1e-9);
        }
    }

    #[test]
    fn errors_move_with_the_map() {
        let by = Sim3::new(SE3::exp(&Vector6::new(-1.0, 2.0, 0.5, 0.3, 0.9, -0.4)), 2.5);
        let errors = errors(1.1);
        let expected = difference(&(by * place()), &(by * off(&place(), &(errors * STEP))));
        assert_near(&of_errors(&errors).transported(&by).matrix(), &expected);
    }

    #[test]
    fn a_follower_has_the_error_of_its_leader_and_the_one_between_them() {
        let covariance = Matrix6::from_diagonal_element(1e-4);
        let leader = |size: f64, moved: &Sim3| UncertainPose {
            map_from_keyframe: *moved * place(),
            covariance: KeyframePoseCovariance::bounded(&(KeyframePoseMatrix::identity() * size)),
        };
        let next = |leader: &UncertainPose| UncertainPose {
            map_from_keyframe: Sim3::new(
                leader.map_from_keyframe.transform_pose(&camera()),
                1.3 * leader.map_from_keyframe.scale,
            ),
            covariance: leader.of_next(&camera(), &covariance),
        };
        let moved = Sim3::new(SE3::exp(&Vector6::new(0.1, 0.2, -0.1, 0.05, 0.1, 0.0)), 1.1);
        for (before, after) in [(1e-2, 1e-4), (1e-4, 1e-2)] {
            let (was, is) = (leader(before, &Sim3::identity()), leader(after, &moved));
            let found = next(&was).following(&was, &is).matrix();
            // As if it had been created on the leader at the leader's new pose.
            let expected = next(&is).covariance.matrix();
            assert!((found - expected).norm() < 1e-9 * expected.norm(), "{found}{expected}");
        }
        // One that was more certain than its leader becomes as certain as the leader.
        let (was, is) = (leader(1e-2, &Sim3::identity()), leader(1e-4, &Sim3::identity()));
        let sure = UncertainPose { covariance: KeyframePoseCovariance::ZERO, ..was };
        let found = sure.following(&was, &is).matrix();
        assert!((found - is.covariance.matrix()).norm() < 1e-12, "{found}");
    }

    #[test]
    fn a_variance_beyond_ignorance_is_clipped_and_the_rest_stays_unchanged() {
        let good = of_errors(&errors(0.5)).matrix() + KeyframePoseMatrix::identity() * 1e-3;
        // Only the unit is unknown, and far beyond any plausible value.
        for beyond in [1.1, 1.5, 3.0, 6.0, 1e9, 1e300] {
            let mut scales = SVector::<f64, KEYFRAME_POSE_ERRORS>::repeat(1.0);
            scales[6] = (beyond / good[(6, 6)]).sqrt();
            let found = KeyframePoseCovariance::bounded(&scaled(&good, &scales)).matrix();
            scales[6] = (1.0 / good[(6, 6)]).sqrt();
            let expected = scaled(&good, &scales);
            assert!((found - expected).norm() < 1e-12 * expected.norm(), "{beyond}{found}");
            assert_eq!(found[(6, 6)], 1.0);
        }
        // A direction in which it is exact, up to rounding.
        let mut rounded = good;
        rounded.fixed_view_mut::<1, KEYFRAME_POSE_ERRORS>(2, 0).fill(1e-12);
        rounded.fixed_view_mut::<KEYFRAME_POSE_ERRORS, 1>(0, 2).fill(1e-12);
        rounded[(2, 2)] = -1e-15;
        let found = KeyframePoseCovariance::bounded(&rounded).matrix();
        let is_of_it = |i: usize, j: usize| i == 2 || j == 2;
        let left =
            KeyframePoseMatrix::from_fn(|i, j| if is_of_it(i, j) { 0.0 } else { good[(i, j)] });
        assert_eq!(found, left);
        rounded[(2, 2)] = -1e-3;
        assert_eq!(KeyframePoseCovariance::bounded(&rounded), KeyframePoseCovariance::unknown());
    }

    #[test]
    fn with_a_variance_at_its_bound_a_follower_is_as_certain_as_its_leader() {
        let with = |covariance| UncertainPose { map_from_keyframe: place(), covariance };
        let sure = with(of_errors(&(errors(0.7) * 1e-3)));
        let unknown = with(KeyframePoseCovariance::unknown());
        // Its leader was unknown, and so was it; its pose was clipped and that of the leader was not.
        let mut clipped = KeyframePoseMatrix::identity() * 1e-2;
        clipped[(6, 6)] = 1.0;
        let follower = UncertainPose {
            map_from_keyframe: Sim3::new(place().transform_pose(&camera()), 1.3),
            covariance: KeyframePoseCovariance::bounded(&(clipped * 2.0)),
        };
        let position = follower.map_from_keyframe.rigid.translation;
        let expected = sure.covariance_at(&position);
        let is_as_sure = |follower: &UncertainPose, was: &UncertainPose| {
            let off = follower.following(was, &sure).matrix() - expected;
            off.norm() < 1e-9 * expected.norm()
        };
        for was in [unknown, with(KeyframePoseCovariance::bounded(&clipped))] {
            assert!(is_as_sure(&follower, &was));
        }
        let open = KeyframePoseMatrix::identity() * 1e-2;
        let follower =
            UncertainPose { covariance: KeyframePoseCovariance::bounded(&open), ..follower };
        assert!(is_as_sure(&follower, &unknown) && !is_as_sure(&follower, &sure));
    }

    #[test]
    fn an_invalid_covariance_is_refused() {
        let good = of_errors(&errors(0.5));
        assert_eq!(KeyframePoseCovariance::from_upper_triangle(good.upper_triangle()), Some(good));
        assert_eq!(KeyframePoseCovariance::bounded(&good.matrix()), good);
        let unknown = KeyframePoseCovariance::unknown();
        for fine in [unknown, KeyframePoseCovariance::ZERO] {
            assert_eq!(
                KeyframePoseCovariance::from_upper_triangle(fine.upper_triangle()),
                Some(fine)
            );
        }
        let with = |index: usize, value: f64| {
            let mut triangle = [0.0; KEYFRAME_POSE_ENTRIES];
            triangle[index] = value;
            triangle
        };
        // The last is a correlation with an entry that has no variance.
        for bad in [with(0, f64::NAN), with(0, -1e-9), with(0, 2e6), with(27, 2.0), with(1, 1e-3)] {
            assert_eq!(KeyframePoseCovariance::from_upper_triangle(bad), None, "{bad:?}");
        }
        let correlated =
            good.matrix() + KeyframePoseMatrix::from_fn(|i, j| f64::from(u8::from(i != j)));
        assert_eq!(KeyframePoseCovariance::bounded(&correlated), unknown);
        assert_eq!(
            KeyframePoseCovariance::bounded(&KeyframePoseMatrix::from_element(f64::NAN)),
            unknown
        );
    }
}
