//! What this machine can do at most: arithmetic in registers, and reading memory in order.

use std::hint::black_box;
use std::time::Instant;

use semidense::slam::alignment::kernel::Kernel;

/// Independent chains of sums: two pipes of four cycles' latency want eight, and with two operands
/// twelve registers of the sixteen that AVX2 has are taken.
const CHAINS: usize = 10;

/// Steps of each chain in one measurement, some tenths of a millisecond.
const STEPS: usize = 100_000;

/// Measurements of which the best counts: a limit is what is reached undisturbed.
const REPEATS: usize = 60;

/// Floating-point operations of a fused multiply-add.
const FLOPS_PER_STEP: f64 = 2.0;

/// Bytes read in one measurement of the memory, whatever the working set.
const BYTES_READ: usize = 16 << 20;

/// Fused multiply-adds on `CHAINS` vectors of `W` floats.
#[inline(always)]
fn fused<const W: usize>(start: f32) -> f32 {
    let mut sums = [[start; W]; CHAINS];
    let (factor, summand) = (black_box([0.999f32; W]), black_box([1e-3f32; W]));
    for _ in 0..STEPS {
        for sum in &mut sums {
            for lane in 0..W {
                sum[lane] = sum[lane].mul_add(factor[lane], summand[lane]);
            }
        }
    }
    sums.iter().flatten().sum()
}

/// The same without fusion: what the portable kernel may use.
fn separate(start: f32) -> f32 {
    const W: usize = 4;
    let mut sums = [[start; W]; CHAINS];
    let (factor, summand) = (black_box([0.999f32; W]), black_box([1e-3f32; W]));
    for _ in 0..STEPS {
        for sum in &mut sums {
            for lane in 0..W {
                sum[lane] = sum[lane] * factor[lane] + summand[lane];
            }
        }
    }
    sums.iter().flatten().sum()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn fused_avx2(start: f32) -> f32 {
    fused::<8>(start)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn fused_avx512(start: f32) -> f32 {
    fused::<16>(start)
}

/// Floating-point operations a nanosecond (GFLOP/s) with the instructions of `kernel`.
pub fn peak_gflops(kernel: Kernel) -> f64 {
    let (run, width): (fn(f32) -> f32, usize) = match kernel {
        Kernel::Portable => (separate, 4),
        // SAFETY of both: a value of this kernel exists only where the CPU has its instructions.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2 => (|start| unsafe { fused_avx2(start) }, 8),
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx512 => (|start| unsafe { fused_avx512(start) }, 16),
        #[cfg(target_arch = "aarch64")]
        Kernel::Neon => (fused::<4>, 4),
    };
    let nanos = best_nanos(|| {
        black_box(run(black_box(1.0)));
    });
    (CHAINS * STEPS * width) as f64 * FLOPS_PER_STEP / nanos
}

/// Bytes a nanosecond (GB/s) of reading `bytes` in order, again and again.
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

/// Reads all words: sixteen sums, so that no addition waits for another.
fn read(words: &[u64]) -> u64 {
    let mut sums = [0u64; 16];
    for chunk in words.as_chunks::<16>().0 {
        for (sum, word) in sums.iter_mut().zip(chunk) {
            *sum = sum.wrapping_add(*word);
        }
    }
    sums.iter().fold(0, |all, sum| all.wrapping_add(*sum))
}

/// Shortest of some runs, nanoseconds.
pub fn best_nanos(mut run: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..REPEATS {
        let begin = Instant::now();
        run();
        best = best.min(begin.elapsed().as_nanos() as f64);
    }
    best
}
