//! Solves the equations that remain for the poses.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use crate::slam::window::comparison::POSE;
use crate::slam::window::elimination_kernel::{Block, lower};

/// The equations' factors, after scaling to a unit diagonal: translations and rotations differ by the depth.
#[derive(Debug, Clone)]
pub(super) struct Factors {
    /// One over the roots of the diagonal.
    scale: DVector<f64>,
    of_scaled: Cholesky<f64, Dyn>,
}

impl Factors {
    /// Factorises a lower triangle of blocks with `size` rows in all, plus a stiffness of 1 along `stiffened`, after
    /// the scaling; `None` where it is not positive definite.
    pub(super) fn of(
        blocks: &[Block],
        size: usize,
        stiffened: Option<&DVector<f64>>,
    ) -> Option<Self> {
        /// Added to the unit diagonal, so that a gauge that nothing holds is not singular.
        const REGULARISATION: f64 = 1e-9;
        let entry = |row: usize, column: usize| {
            blocks[lower(row / POSE, column / POSE)][row % POSE][column % POSE]
        };
        let scale = DVector::from_fn(size, |k, _| 1.0 / entry(k, k).max(f64::MIN_POSITIVE).sqrt());
        let mut matrix = DMatrix::from_fn(size, size, |row, column| {
            let (row, column) = (row.max(column), row.min(column));
            let regular = if row == column { REGULARISATION } else { 0.0 };
            entry(row, column) * scale[row] * scale[column] + regular
        });
        if let Some(along) = stiffened {
            let along = along.component_div(&scale).normalize();
            matrix.ger(1.0, &along, &along, 1.0);
        }
        Some(Self { scale, of_scaled: matrix.cholesky()? })
    }

    /// L⁻¹ b of a vector b, where the matrix is L Lᵀ.
    pub(super) fn whiten(&self, mut of: DVector<f64>) -> DVector<f64> {
        of.component_mul_assign(&self.scale);
        // The diagonal of a Cholesky factor is positive.
        self.of_scaled.l_dirty().solve_lower_triangular_unchecked_mut(&mut of);
        of
    }
}

/// Solves `matrix · x = −right` for a lower triangle of blocks.
pub(super) fn solve(blocks: &[Block], right: &[f64]) -> Option<DVector<f64>> {
    let size = right.len();
    if size == 0 {
        return Some(DVector::zeros(0));
    }
    let Factors { scale, of_scaled } = Factors::of(blocks, size, None)?;
    let right = DVector::from_fn(size, |k, _| right[k] * scale[k]);
    let step = -of_scaled.solve(&right).component_mul(&scale);
    step.iter().all(|x| x.is_finite()).then_some(step)
}
