//! The sums over the neighbours of a block of pixels, compiled for the vector units that the
//! processor has.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::depth::regularisation::{NeighbourSums, Neighbourhood};

/// A version of [`Neighbourhood::sums`].
pub(super) type SumsKernel = fn(&Neighbourhood<'_>, usize, usize) -> NeighbourSums;

/// The best version for this processor.
pub(super) fn sums_kernel() -> SumsKernel {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return |neighbourhood, first, v| {
            // SAFETY: the processor has AVX2, as was just asked.
            unsafe { sums_avx2(neighbourhood, first, v) }
        };
    }
    sums_portable
}

/// The explanation of the others.
fn sums_portable(neighbourhood: &Neighbourhood<'_>, first: usize, v: usize) -> NeighbourSums {
    neighbourhood.sums(first, v)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn sums_avx2(neighbourhood: &Neighbourhood<'_>, first: usize, v: usize) -> NeighbourSums {
    neighbourhood.sums(first, v)
}
