//! The residual of a constraint and its derivatives (Engel, Schöps, Cremers 2014, §3.6).
//!
//! r = log(S_ji S_i⁻¹ S_j), with S_ji as measured and S_i = `map_from_keyframe` of i. An error of S_ji that is a left
//! increment, S_ji = exp(ε) S_ji*, is r to first order, so that the information of that increment is the weight of r.
//!
//! Vertices move by right increments, S ← S exp(δ): the same steps as exp(Ad(S) δ) S, but in the axes and unit of the
//! keyframe, which conditions the equations of a large map better. Results are left increments.

use nalgebra::SMatrix;

use crate::slam::geometry::sim3::{Matrix7, Sim3, Twist7, left_jacobian_inverse};

/// A residual and its derivatives by small motions of its keyframes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// r: translation, rotation, log scale.
    pub value: Twist7,
    /// ∂r/∂δ_i.
    pub d_value_d_i: Matrix7,
    /// ∂r/∂δ_j.
    pub d_value_d_j: Matrix7,
}

/// r for a measurement and the similarities of its keyframes.
pub fn residual(j_from_i: &Sim3, map_from_i: &Sim3, map_from_j: &Sim3) -> Twist7 {
    (*j_from_i * (map_from_i.inverse() * *map_from_j)).log()
}

/// r with its derivatives: r(δ) = log(S_ji exp(−δ_i) S_i⁻¹ S_j exp(δ_j)) = log(exp(−Ad(S_ji) δ_i) E exp(δ_j)); an
/// increment to the right of E = exp(r) acts on r through J⁻¹(−r).
pub fn linearise(j_from_i: &Sim3, map_from_i: &Sim3, map_from_j: &Sim3) -> Residual {
    let value = residual(j_from_i, map_from_i, map_from_j);
    let left = left_jacobian_inverse(&value);
    Residual {
        value,
        d_value_d_i: -(left * j_from_i.adjoint()),
        d_value_d_j: left_jacobian_inverse(&-value),
    }
}

/// rᵀΛr of the first `D` parts.
pub(super) fn squared_error<const D: usize>(value: &Twist7, information: &Matrix7) -> f64 {
    let part = value.fixed_rows::<D>(0);
    part.dot(&(information.fixed_view::<D, D>(0, 0) * part))
}

/// The upper left part of a matrix over twists.
pub(super) fn part<const D: usize>(matrix: &Matrix7) -> SMatrix<f64, D, D> {
    matrix.fixed_view::<D, D>(0, 0).into_owned()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn similarity() -> impl Strategy<Value = Sim3> {
        proptest::array::uniform7(-0.7f64..0.7).prop_map(|twist| Sim3::exp(&Twist7::from(twist)))
    }

    proptest! {
        #[test]
        fn derivatives_are_those_of_the_residual(a in similarity(), i in similarity(), j in similarity()) {
            const STEP: f64 = 1e-5;
            let at = linearise(&a, &i, &j);
            for k in 0..7 {
                let moved = |step: f64| {
                    let mut delta = Twist7::zeros();
                    delta[k] = step;
                    Sim3::exp(&delta)
                };
                let of_i = |step| residual(&a, &(i * moved(step)), &j);
                let of_j = |step| residual(&a, &i, &(j * moved(step)));
                let by_i = (of_i(STEP) - of_i(-STEP)) / (2.0 * STEP);
                let by_j = (of_j(STEP) - of_j(-STEP)) / (2.0 * STEP);
                prop_assert!((at.d_value_d_i.column(k) - by_i).norm() < 1e-6);
                prop_assert!((at.d_value_d_j.column(k) - by_j).norm() < 1e-6);
            }
        }

        #[test]
        fn an_error_of_the_measurement_from_the_left_is_the_residual(i in similarity(), j in similarity(), error in proptest::array::uniform7(-0.5f64..0.5)) {
            let error = Twist7::from(error);
            let measured = Sim3::exp(&error) * (j.inverse() * i);
            prop_assert!((residual(&measured, &i, &j) - error).norm() < 1e-9);
        }
    }
}
