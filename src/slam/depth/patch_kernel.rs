//! The cost of a patch in vector registers. Compilers that see its sum take two samples at a time, with a division each.

use crate::slam::depth::pattern::sum_of_samples;
use crate::slam::kernel::Instructions;

/// Residuals beyond this many grey levels grow linearly (Engel, Koltun, Cremers 2018).
const HUBER_GREY: f32 = 9.0;

/// How the eight residuals of a patch are summed; all versions give the same bits.
pub(super) trait PatchSums: Copy {
    /// Σ ρ(r), ρ(r) = r² up to [`HUBER_GREY`], linear beyond; r = `seen` − `expected`.
    fn cost(self, seen: &[f32; 8], expected: &[f32; 8]) -> f32;

    /// Σ w g r and Σ w g², w = Huber's weight.
    fn slope(self, seen: &[f32; 8], expected: &[f32; 8], gradients: &[f32; 8]) -> [f32; 2];
}

impl<I: Instructions> PatchSums for I {
    #[inline(always)]
    fn cost(self, seen: &[f32; 8], expected: &[f32; 8]) -> f32 {
        #[cfg(target_arch = "x86_64")]
        if I::HAS_AVX2 {
            // SAFETY: who made the instructions vouched for them.
            return unsafe { avx2::cost(seen, expected) };
        }
        cost(seen, expected)
    }

    #[inline(always)]
    fn slope(self, seen: &[f32; 8], expected: &[f32; 8], gradients: &[f32; 8]) -> [f32; 2] {
        #[cfg(target_arch = "x86_64")]
        if I::HAS_AVX2 {
            // SAFETY: as above.
            return unsafe { avx2::slope(seen, expected, gradients) };
        }
        slope(seen, expected, gradients)
    }
}

/// The explanation of the others.
#[inline(always)]
fn cost(seen: &[f32; 8], expected: &[f32; 8]) -> f32 {
    let mut costs = [0.0; 8];
    for k in 0..8 {
        let residual = seen[k] - expected[k];
        let weight = weight(residual);
        costs[k] = weight * (2.0 - weight) * residual * residual;
    }
    sum_of_samples(&costs)
}

/// The explanation of the others.
#[inline(always)]
fn slope(seen: &[f32; 8], expected: &[f32; 8], gradients: &[f32; 8]) -> [f32; 2] {
    let (mut mixed, mut squares) = ([0.0; 8], [0.0; 8]);
    for k in 0..8 {
        let weighted = weight(seen[k] - expected[k]) * gradients[k];
        (mixed[k], squares[k]) = (weighted * (seen[k] - expected[k]), weighted * gradients[k]);
    }
    [sum_of_samples(&mixed), sum_of_samples(&squares)]
}

/// Huber's: 1 up to the bound, without a branch, so that the lanes go together.
#[inline(always)]
fn weight(residual: f32) -> f32 {
    HUBER_GREY / residual.abs().max(HUBER_GREY)
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;

    use super::HUBER_GREY;

    /// # Safety
    /// The processor has AVX2. Without the attribute that says so, because only that goes into the loop of the caller
    /// whatever its size. So have the others.
    #[inline(always)]
    pub(super) unsafe fn cost(seen: &[f32; 8], expected: &[f32; 8]) -> f32 {
        // SAFETY: this function's own contract.
        unsafe {
            let (residual, weight) = weighed(seen, expected);
            let factor = _mm256_mul_ps(weight, _mm256_sub_ps(_mm256_set1_ps(2.0), weight));
            sum(_mm256_mul_ps(_mm256_mul_ps(factor, residual), residual))
        }
    }

    /// # Safety
    /// As [`cost`].
    #[inline(always)]
    pub(super) unsafe fn slope(
        seen: &[f32; 8],
        expected: &[f32; 8],
        gradients: &[f32; 8],
    ) -> [f32; 2] {
        // SAFETY: this function's own contract; eight numbers are loaded.
        unsafe {
            let (residual, weight) = weighed(seen, expected);
            let gradients = _mm256_loadu_ps(gradients.as_ptr());
            let weighted = _mm256_mul_ps(weight, gradients);
            [_mm256_mul_ps(weighted, residual), _mm256_mul_ps(weighted, gradients)].map(|x| sum(x))
        }
    }

    /// Residuals and their weights.
    ///
    /// # Safety
    /// As [`cost`].
    #[inline(always)]
    unsafe fn weighed(seen: &[f32; 8], expected: &[f32; 8]) -> (__m256, __m256) {
        // SAFETY: this function's own contract; eight numbers are loaded.
        unsafe {
            let (seen, expected) =
                (_mm256_loadu_ps(seen.as_ptr()), _mm256_loadu_ps(expected.as_ptr()));
            let residual = _mm256_sub_ps(seen, expected);
            let size = _mm256_andnot_ps(_mm256_set1_ps(-0.0), residual);
            let bound = _mm256_set1_ps(HUBER_GREY);
            (residual, _mm256_div_ps(bound, _mm256_max_ps(size, bound)))
        }
    }

    /// [`sum_of_samples`](crate::slam::depth::pattern::sum_of_samples).
    ///
    /// # Safety
    /// As [`cost`].
    #[inline(always)]
    unsafe fn sum(x: __m256) -> f32 {
        // SAFETY: this function's own contract.
        unsafe {
            let four = _mm_add_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps::<1>(x));
            let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
        }
    }

    #[cfg(test)]
    mod tests {
        use super::super::{cost, slope};
        use crate::slam::test_scene::Random;

        #[test]
        fn sums_are_those_of_the_explanation() {
            if !std::arch::is_x86_feature_detected!("avx2") {
                return;
            }
            let mut random = Random::new(11);
            for round in 0..1000 {
                let scale = [1.0, 8.0, 60.0, 1e20][round % 4];
                let mut eight =
                    || -> [f32; 8] { std::array::from_fn(|_| (scale * random.normal()) as f32) };
                let (mut seen, expected, gradients) = (eight(), eight(), eight());
                if round % 97 == 0 {
                    seen[round % 8] = [f32::NAN, f32::INFINITY][round % 2];
                }
                // SAFETY: the processor has AVX2, as was just asked.
                let (found, slopes) = unsafe {
                    (super::cost(&seen, &expected), super::slope(&seen, &expected, &gradients))
                };
                let is_same = |one: f32, other: f32| {
                    one.to_bits() == other.to_bits() || one.is_nan() && other.is_nan()
                };
                assert!(is_same(found, cost(&seen, &expected)), "{seen:?} {expected:?}");
                let expected = slope(&seen, &expected, &gradients);
                assert!(is_same(slopes[0], expected[0]) && is_same(slopes[1], expected[1]));
            }
        }
    }
}
