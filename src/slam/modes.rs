//! Errors of depth that are common to a whole keyframe, and their covariance.
//!
//! A relative error of inverse depth is split into the common part, δd/d = φᵀm with φ = (X, Y, ln d), X and Y the ray's
//! coordinates, and the rest, which is independent for each point. m is tilt along columns, tilt along rows and relief.
//! A constant error is not among them: it is the keyframe's unit, which no image shows.

use nalgebra::{Matrix3, Vector3};

/// Number of common errors of a keyframe's depth.
pub const NUM_MODES: usize = 3;

/// Largest accepted standard deviation of a mode: an error of ten times the depth per unit of φ.
const MAX_STD_DEV: f64 = 10.0;

/// Standard deviation of an unknown mode: depth may be twice or half as much across the image.
const IGNORANCE: f64 = 1.0;

/// Covariance P of the common errors of a keyframe's relative inverse depth: tilt along columns, along rows, relief.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ModeCovariance {
    upper_triangle: [f64; 6],
}

impl ModeCovariance {
    /// No common error.
    pub const ZERO: Self = Self { upper_triangle: [0.0; 6] };

    /// Independent modes with these standard deviations.
    pub fn of_std_devs([column, row, relief]: [f64; NUM_MODES]) -> Self {
        Self { upper_triangle: [column * column, 0.0, 0.0, row * row, 0.0, relief * relief] }
    }

    /// Covariance for unknown depth.
    pub fn unknown() -> Self {
        Self::of_std_devs([IGNORANCE; NUM_MODES])
    }

    /// From a symmetric matrix.
    pub fn of(matrix: &Matrix3<f64>) -> Self {
        let m = |i, j| 0.5 * (matrix[(i, j)] + matrix[(j, i)]);
        Self { upper_triangle: [m(0, 0), m(0, 1), m(0, 2), m(1, 1), m(1, 2), m(2, 2)] }
    }

    /// From a symmetric matrix that is a sum: no mode is less certain than an unknown one, and what is no covariance
    /// becomes complete ignorance.
    pub fn bounded(matrix: &Matrix3<f64>) -> Self {
        let matrix = Self::of(matrix).matrix();
        // Rows and columns are scaled alike: a covariance stays one, and the other modes keep theirs.
        let factors = matrix.diagonal().map(|variance| match variance > IGNORANCE * IGNORANCE {
            true => IGNORANCE / variance.sqrt(),
            false => 1.0,
        });
        let within = matrix.component_mul(&(factors * factors.transpose()));
        Self::from_upper_triangle(Self::of(&within).upper_triangle).unwrap_or_else(Self::unknown)
    }

    /// From its upper triangle, row by row; `None` where that is not a covariance, or an implausible one.
    pub fn from_upper_triangle(upper_triangle: [f64; 6]) -> Option<Self> {
        /// By rounding, eigenvalues may be negative by this share of the largest.
        const TOLERANCE: f64 = 1e-9;
        let covariance = Self { upper_triangle };
        if !upper_triangle.iter().all(|x| x.is_finite()) {
            return None;
        }
        let eigenvalues = covariance.matrix().symmetric_eigenvalues();
        let (least, largest) = (eigenvalues.min(), eigenvalues.max());
        let is_one = largest <= MAX_STD_DEV * MAX_STD_DEV && least >= -TOLERANCE * largest.abs();
        is_one.then_some(covariance)
    }

    /// The covariance for depth whose relief has a permanent error of `error`.
    pub fn with_relief_error(&self, error: f64) -> Self {
        let mut matrix = self.matrix();
        matrix[(2, 2)] += error * error;
        Self::bounded(&matrix)
    }

    /// Its upper triangle, row by row.
    pub fn upper_triangle(&self) -> [f64; 6] {
        self.upper_triangle
    }

    /// The whole matrix.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [a, b, c, d, e, f] = self.upper_triangle;
        Matrix3::new(a, b, c, b, d, e, c, e, f)
    }

    /// Standard deviations of the modes.
    pub fn std_devs(&self) -> Vector3<f64> {
        self.matrix().diagonal().map(|variance| variance.max(0.0).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_covariance_is_refused() {
        let good = ModeCovariance::of_std_devs([0.1, 0.2, 0.3]);
        assert_eq!(ModeCovariance::from_upper_triangle(good.upper_triangle()), Some(good));
        assert!((good.std_devs() - Vector3::new(0.1, 0.2, 0.3)).norm() < 1e-12);
        assert_eq!(ModeCovariance::from_upper_triangle([0.0; 6]), Some(ModeCovariance::ZERO));
        assert_eq!(ModeCovariance::bounded(&good.matrix()), good);
        for broken in [Matrix3::from_diagonal_element(f64::NAN), Matrix3::identity() * 9.0] {
            assert_eq!(ModeCovariance::bounded(&broken), ModeCovariance::of_std_devs([1.0; 3]));
        }
        // One unknown mode leaves the others known.
        let wide = Matrix3::new(0.01, 0.0, 0.1, 0.0, 0.04, 0.0, 0.1, 0.0, 4.0);
        let bounded = ModeCovariance::bounded(&wide);
        assert!((bounded.std_devs() - Vector3::new(0.1, 0.2, 1.0)).norm() < 1e-12);
        assert!((bounded.matrix()[(0, 2)] - 0.05).abs() < 1e-12, "the correlation stays");
        for bad in [
            [f64::NAN, 0.0, 0.0, 1.0, 0.0, 1.0],
            [1.0, 0.0, 0.0, f64::INFINITY, 0.0, 1.0],
            [-1.0, 0.0, 0.0, 1.0, 0.0, 1.0],
            // A correlation above 1.
            [1.0, 2.0, 0.0, 1.0, 0.0, 1.0],
            [1e9, 0.0, 0.0, 1.0, 0.0, 1.0],
        ] {
            assert_eq!(ModeCovariance::from_upper_triangle(bad), None, "{bad:?}");
        }
    }
}
