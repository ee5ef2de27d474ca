//! The smoothing of some rows of the map, compiled for the vector units that the processor has.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

/// Rows that are smoothed.
pub(super) trait SmoothedRows {
    /// Smooths, drops and fills row by row.
    fn regularise(&mut self);
}

/// A version of [`SmoothedRows::regularise`].
pub(super) type SmoothingKernel<R> = fn(&mut R);

/// The best version for this processor.
pub(super) fn smoothing_kernel<R: SmoothedRows>() -> SmoothingKernel<R> {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return |band| {
            // SAFETY: the processor has AVX2, as was just asked.
            unsafe { regularise_avx2(band) }
        };
    }
    regularise_portable
}

/// The explanation of the others.
fn regularise_portable<R: SmoothedRows>(band: &mut R) {
    band.regularise()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn regularise_avx2<R: SmoothedRows>(band: &mut R) {
    band.regularise()
}
