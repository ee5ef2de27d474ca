//! The machine's peak: arithmetic in registers, and sequential reads of memory.

use std::hint::black_box;
use std::time::Instant;

use semidense::slam::kernel::Kernel;

/// Independent chains of sums: two pipes with a latency of four cycles when fused, six when not, need up to twelve;
/// with two operands, that takes fourteen of AVX2's sixteen registers.
const CHAINS: usize = 12;

/// Steps of each chain in one measurement, which takes some tenths of a millisecond.
const STEPS: usize = 100_000;

/// Measurements, of which the fastest counts: a limit is what is reached without disturbance.
const REPEATS: usize = 60;

/// Floating-point operations of a multiply-add.
const FLOPS_PER_STEP: f64 = 2.0;

/// Bytes read in one measurement of the memory, whatever the working set.
const BYTES_READ: usize = 16 << 20;

/// Defines a function that runs the chains: `$splat` creates a vector, `$step` is one step of a chain.
macro_rules! chains {
    ($(#[$feature:meta])* $name:ident, $splat:expr, $step:expr) => {
        $(#[$feature])*
        fn $name() {
            let (factor, summand) = ($splat(black_box(0.999)), $splat(black_box(1e-3)));
            let mut sums = [$splat(black_box(1.0)); CHAINS];
            for _ in 0..STEPS {
                for sum in &mut sums {
                    *sum = $step(*sum, factor, summand);
                }
            }
            black_box(sums);
        }
    };
}

#[cfg(target_arch = "x86_64")]
mod instructions {
    use super::{CHAINS, STEPS, black_box};
    use std::arch::x86_64::*;

    chains!(
        #[target_feature(enable = "sse2")]
        portable,
        _mm_set1_ps,
        |sum, factor, summand| _mm_add_ps(_mm_mul_ps(sum, factor), summand)
    );
    chains!(
        #[target_feature(enable = "avx2,fma")]
        avx2,
        _mm256_set1_ps,
        _mm256_fmadd_ps
    );
    chains!(
        #[target_feature(enable = "avx512f")]
        avx512,
        _mm512_set1_ps,
        _mm512_fmadd_ps
    );

    pub fn run_portable() {
        // SAFETY: every x86-64 has SSE2.
        unsafe { portable() }
    }

    /// Runs the chains with AVX2 and FMA; called only if there is a kernel for them.
    pub fn run_avx2() {
        // SAFETY: called for that kernel only.
        unsafe { avx2() }
    }

    /// Runs the chains with AVX-512F; called only if there is a kernel for it.
    pub fn run_avx512() {
        // SAFETY: called for that kernel only.
        unsafe { avx512() }
    }
}

#[cfg(target_arch = "aarch64")]
mod instructions {
    use super::{CHAINS, STEPS, black_box};
    use std::arch::aarch64::*;

    chains!(
        #[target_feature(enable = "neon")]
        portable,
        vdupq_n_f32,
        |sum, factor, summand| vaddq_f32(vmulq_f32(sum, factor), summand)
    );
    chains!(
        #[target_feature(enable = "neon")]
        neon,
        vdupq_n_f32,
        |sum, factor, summand| vfmaq_f32(summand, sum, factor)
    );

    pub fn run_portable() {
        // SAFETY: every aarch64 that Linux runs on has NEON.
        unsafe { portable() }
    }

    pub fn run_neon() {
        // SAFETY: as above.
        unsafe { neon() }
    }
}

/// Floating-point operations per nanosecond (GFLOP/s) with the instructions of `kernel`.
pub fn peak_gflops(kernel: Kernel) -> f64 {
    let (run, width): (fn(), usize) = match kernel {
        Kernel::Portable => (instructions::run_portable, 4),
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2 { .. } => (instructions::run_avx2, 8),
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx512 { .. } => (instructions::run_avx512, 16),
        #[cfg(target_arch = "aarch64")]
        Kernel::Neon { .. } => (instructions::run_neon, 4),
    };
    (CHAINS * STEPS * width) as f64 * FLOPS_PER_STEP / best_nanos(run)
}

/// Bytes per nanosecond (GB/s) of reading `bytes` sequentially, over and over.
pub fn bandwidth(bytes: usize) -> f64 {
    let words = vec![1u64; (bytes / 8).next_multiple_of(64)];
    let rounds = (BYTES_READ / (8 * words.len())).max(1);
    let nanos = best_nanos(|| {
        for _ in 0..rounds {
            black_box(read(black_box(&words)));
        }
    });
    (rounds * words.len() * 8) as f64 / nanos
}

/// Reads all words with sixteen sums, so that no addition waits for another.
fn read(words: &[u64]) -> u64 {
    let mut sums = [0u64; 16];
    for chunk in words.as_chunks::<16>().0 {
        for (sum, word) in sums.iter_mut().zip(chunk) {
            *sum = sum.wrapping_add(*word);
        }
    }
    sums.iter().fold(0, |all, sum| all.wrapping_add(*sum))
}

/// Shortest of several runs, nanoseconds.
pub fn best_nanos(mut run: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..REPEATS {
        let begin = Instant::now();
        run();
        best = best.min(begin.elapsed().as_nanos() as f64);
    }
    best
}
