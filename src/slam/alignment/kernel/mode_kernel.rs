//! What a common error of depth does to the gradient of the cost, for any instruction set: the last
//! sum of `GradientScatter::reference` in lanes.
//!
//! ∂r/∂d · d is J_t · t, so that the whitened columns hold all of it but X, Y and ln d.

use nalgebra::SMatrix;

use crate::slam::alignment::kernel::accumulate_kernel::Whitened;
use crate::slam::alignment::normal_equations::UNKNOWNS;
use crate::slam::alignment::points::{LANES, PointBlock};
use crate::slam::kernel::lanes_kernel::Lanes;
use crate::slam::modes::NUM_MODES;

/// Σ w J (∂r/∂d) d φᵀ, lane by lane.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct ModeSums([[[f32; LANES]; UNKNOWNS]; NUM_MODES]);

impl ModeSums {
    pub const ZERO: Self = Self([[[0.0; LANES]; UNKNOWNS]; NUM_MODES]);

    /// Adds up the lanes, in their order, in f64.
    pub fn total(&self) -> SMatrix<f64, UNKNOWNS, NUM_MODES> {
        SMatrix::from_fn(|i, mode| self.0[mode][i].iter().map(|&sum| f64::from(sum)).sum())
    }
}

/// Adds the products of a chunk whose columns are `whitened`; `translation` is that of the state.
///
/// # Safety
/// The CPU has the instructions of `L`.
#[inline(always)]
pub unsafe fn add_modes<L: Lanes>(
    blocks: &[PointBlock],
    log_inverse_depths: &[[f32; LANES]],
    whitened: &[Whitened],
    translation: [f32; 3],
    sums: &mut ModeSums,
) {
    // SAFETY: this function's own contract; all pointers go to blocks of sixteen floats.
    unsafe {
        let [tx, ty, tz] = translation.map(|t| L::splat(t));
        for lane in (0..LANES).step_by(L::N) {
            // One mode at a time: its eight sums stay in registers.
            for (mode, sums) in sums.0.iter_mut().enumerate() {
                let mut totals: [L; UNKNOWNS] =
                    std::array::from_fn(|i| L::load(sums[i].as_ptr().add(lane)));
                for ((block, log), columns) in blocks.iter().zip(log_inverse_depths).zip(whitened) {
                    let column = |index: usize| L::load(columns.0[index].as_ptr().add(lane));
                    let shape = match mode {
                        0 => &block.ray_x,
                        1 => &block.ray_y,
                        _ => log,
                    };
                    let along = tz.mul_add(column(2), ty.mul_add(column(1), tx.mul(column(0))));
                    let change = along.mul(L::load(shape.as_ptr().add(lane)));
                    for (i, total) in totals.iter_mut().enumerate() {
                        *total = column(i).mul_add(change, *total);
                    }
                }
                for (sum, total) in sums.iter_mut().zip(totals) {
                    total.store(sum.as_mut_ptr().add(lane));
                }
            }
        }
    }
}
