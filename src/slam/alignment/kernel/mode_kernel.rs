//! The effect of a common error of depth on the gradient of the cost, for any instruction set: the last sum of
//! `GradientScatter::reference` in lanes.
//!
//! ∂r/∂d · d is J_t · t, so that the whitened columns provide all of it except X, Y and ln d.

use nalgebra::SMatrix;

use crate::slam::alignment::kernel::accumulate_kernel::Whitened;
use crate::slam::alignment::normal_equations::UNKNOWNS;
use crate::slam::alignment::points::{LANES, PointBlock};
use crate::slam::kernel::{Floats, Instructions};
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

/// Adds the products of a chunk with columns `whitened`; `translation` is that of the state.
#[inline(always)]
pub fn add_modes<I: Instructions>(
    lanes: I,
    blocks: &[PointBlock],
    log_inverse_depths: &[[f32; LANES]],
    whitened: &[Whitened],
    translation: [f32; 3],
    sums: &mut ModeSums,
) {
    let [tx, ty, tz] = translation.map(|t| lanes.splat(t));
    for lane in (0..LANES).step_by(I::N) {
        // One mode at a time: its eight sums stay in registers.
        for (mode, sums) in sums.0.iter_mut().enumerate() {
            let mut totals: [Floats<I>; UNKNOWNS] =
                std::array::from_fn(|i| lanes.load(&sums[i][lane..]));
            for ((block, log), columns) in blocks.iter().zip(log_inverse_depths).zip(whitened) {
                let column = |index: usize| lanes.load(&columns.0[index][lane..]);
                let shape = match mode {
                    0 => &block.ray_x,
                    1 => &block.ray_y,
                    _ => log,
                };
                let along = tz.mul_add(column(2), ty.mul_add(column(1), tx * column(0)));
                let change = along * lanes.load(&shape[lane..]);
                for (i, total) in totals.iter_mut().enumerate() {
                    *total = column(i).mul_add(change, *total);
                }
            }
            for (sum, total) in sums.iter_mut().zip(totals) {
                total.store(&mut sum[lane..]);
            }
        }
    }
}
