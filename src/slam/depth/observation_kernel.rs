//! The observation of a row, compiled for the vector units that the processor has.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::depth::map::Hypothesis;
#[cfg(target_arch = "x86_64")]
use crate::slam::image::quads_kernel::Avx2Sampler;
use crate::slam::image::quads_kernel::{PortableSampler, Sampler};

/// What observes the pixels of a row.
pub(super) trait RowObserver {
    /// What a row comes to.
    type Observation;

    /// Observes the pixels of row `v`.
    fn observe_row<S: Sampler>(
        &self,
        sampler: S,
        row: &mut [Hypothesis],
        v: usize,
    ) -> Self::Observation;
}

/// A version of [`RowObserver::observe_row`].
pub(super) type RowKernel<O> = fn(&O, &mut [Hypothesis], usize) -> <O as RowObserver>::Observation;

/// The best version for this processor.
pub(super) fn row_kernel<O: RowObserver>() -> RowKernel<O> {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        let has_avx512 = std::arch::is_x86_feature_detected!("avx512f")
            && std::arch::is_x86_feature_detected!("avx512vl")
            && std::arch::is_x86_feature_detected!("avx512bw")
            && std::arch::is_x86_feature_detected!("avx512dq");
        if has_avx512 {
            return |pixel, row, v| {
                // SAFETY: the processor has these, as was just asked.
                unsafe { observe_row_avx512(pixel, row, v) }
            };
        }
        return |pixel, row, v| {
            // SAFETY: the processor has AVX2, as was just asked.
            unsafe { observe_row_avx2(pixel, row, v) }
        };
    }
    observe_row_portable
}

/// The explanation of the others.
fn observe_row_portable<O: RowObserver>(
    pixel: &O,
    row: &mut [Hypothesis],
    v: usize,
) -> O::Observation {
    pixel.observe_row(PortableSampler, row, v)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn observe_row_avx2<O: RowObserver>(pixel: &O, row: &mut [Hypothesis], v: usize) -> O::Observation {
    // SAFETY: this function asks for AVX2.
    let sampler = unsafe { Avx2Sampler::new() };
    pixel.observe_row(sampler, row, v)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512vl,avx512bw,avx512dq")]
fn observe_row_avx512<O: RowObserver>(
    pixel: &O,
    row: &mut [Hypothesis],
    v: usize,
) -> O::Observation {
    // SAFETY: this function asks for AVX2.
    let sampler = unsafe { Avx2Sampler::new() };
    pixel.observe_row(sampler, row, v)
}
