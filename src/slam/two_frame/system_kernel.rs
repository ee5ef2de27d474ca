//! What goes over all points, compiled for the vector units that the processor has.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::two_frame::elimination::{Elimination, neighbour_medians};
use crate::slam::two_frame::points::NeighbourBlock;
#[cfg(target_arch = "x86_64")]
use crate::slam::two_frame::sampling_kernel::Avx2Sampler;
use crate::slam::two_frame::sampling_kernel::PortableSampler;
use crate::slam::two_frame::system::{LevelView, State, System};

/// The versions for one processor.
pub(super) struct SystemKernels {
    /// [`System::evaluate_blocks`].
    pub evaluate: fn(&mut System, &LevelView<'_>, &State),
    /// [`Elimination::reduce`].
    pub reduce: fn(&mut Elimination, &System, &[f32], &[f32]),
    /// [`neighbour_medians`].
    pub medians: fn(&[NeighbourBlock], &[f32], &mut Vec<f32>),
}

/// The best versions for this processor.
pub(super) fn system_kernels() -> SystemKernels {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return SystemKernels {
            evaluate: |system, level, state| {
                // SAFETY: the processor has AVX2, as was just asked.
                unsafe { evaluate_avx2(system, level, state) }
            },
            reduce: |elimination, system, inverse_depths, medians| {
                // SAFETY: the processor has AVX2, as was just asked.
                unsafe { reduce_avx2(elimination, system, inverse_depths, medians) }
            },
            medians: |neighbours, inverse_depths, medians| {
                // SAFETY: the processor has AVX2, as was just asked.
                unsafe { medians_avx2(neighbours, inverse_depths, medians) }
            },
        };
    }
    portable_kernels()
}

/// The explanation of the others.
pub(super) fn portable_kernels() -> SystemKernels {
    SystemKernels {
        evaluate: |system, level, state| system.evaluate_blocks(PortableSampler, level, state),
        reduce: Elimination::reduce,
        medians: neighbour_medians,
    }
}

impl System {
    /// Evaluates every point at `state`. Sums go in the order of the points.
    pub fn evaluate(&mut self, level: &LevelView<'_>, state: &State) {
        (system_kernels().evaluate)(self, level, state);
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn evaluate_avx2(system: &mut System, level: &LevelView<'_>, state: &State) {
    // SAFETY: this function asks for AVX2.
    let sampler = unsafe { Avx2Sampler::new() };
    system.evaluate_blocks(sampler, level, state);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn reduce_avx2(
    elimination: &mut Elimination,
    system: &System,
    inverse_depths: &[f32],
    medians: &[f32],
) {
    elimination.reduce(system, inverse_depths, medians);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn medians_avx2(neighbours: &[NeighbourBlock], inverse_depths: &[f32], medians: &mut Vec<f32>) {
    neighbour_medians(neighbours, inverse_depths, medians);
}
