//! The observation of a row, compiled for the vector units that the processor has.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::depth::gaussian::{ObservationCounts, PixelObserver};
use crate::slam::depth::map::Hypothesis;

/// A version of [`PixelObserver::observe_row`].
pub(super) type RowKernel = fn(&PixelObserver<'_>, &mut [Hypothesis], usize) -> ObservationCounts;

/// The best version for this processor.
pub(super) fn row_kernel() -> RowKernel {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return |pixel, row, v| {
            // SAFETY: the processor has AVX2, as was just asked.
            unsafe { observe_row_avx2(pixel, row, v) }
        };
    }
    observe_row_portable
}

/// The explanation of the others.
fn observe_row_portable(
    pixel: &PixelObserver<'_>,
    row: &mut [Hypothesis],
    v: usize,
) -> ObservationCounts {
    pixel.observe_row(row, v)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn observe_row_avx2(
    pixel: &PixelObserver<'_>,
    row: &mut [Hypothesis],
    v: usize,
) -> ObservationCounts {
    pixel.observe_row(row, v)
}
