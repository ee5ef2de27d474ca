//! The cost of a patch in vector registers. Compilers that see its sum take two samples at a time, with a division each.

use crate::slam::depth::pattern::sum_of_samples;
use crate::slam::kernel::Instructions;

/// Residuals beyond this many grey levels grow linearly (Engel, Koltun, Cremers 2018).
const HUBER_GREY: f32 = 9.0;

/// How the eight residuals of a patch are summed; all versions give the same bits.
pub(super) trait PatchSums: Copy {
    /// The sum of eight.
    fn sum(self, terms: &[f32; 8]) -> f32;

    /// The sum of each row: of several at once, because within one row each addition waits for the one before.
    fn sums(self, rows: &[[f32; 8]; 8]) -> [f32; 8];

    /// Σ w g r and Σ w g², w = Huber's weight.
    fn slope(self, seen: &[f32; 8], expected: &[f32; 8], gradients: &[f32; 8]) -> [f32; 2];
}

impl<I: Instructions> PatchSums for I {
    #[inline(always)]
    fn sum(self, terms: &[f32; 8]) -> f32 {
        #[cfg(target_arch = "x86_64")]
        if I::HAS_AVX2 {
            // SAFETY: who made the instructions vouched for them.
            return unsafe { avx2::sum_of(terms) };
        }
        sum_of_samples(terms)
    }

    #[inline(always)]
    fn sums(self, rows: &[[f32; 8]; 8]) -> [f32; 8] {
        #[cfg(target_arch = "x86_64")]
        if I::HAS_AVX2 {
            // SAFETY: as above.
            return unsafe { avx2::sums(rows) };
        }
        rows.map(|row| sum_of_samples(&row))
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

/// ρ(r) by sample: r² up to [`HUBER_GREY`], linear beyond; r = `seen` − `expected`. Without the division of a weight.
#[inline(always)]
pub(super) fn huber(seen: &[f32; 8], expected: &[f32; 8]) -> [f32; 8] {
    let mut terms = [0.0; 8];
    for k in 0..8 {
        let size = (seen[k] - expected[k]).abs();
        // Not `min`, which asks for NaN: its term is NaN either way.
        let bounded = if size < HUBER_GREY { size } else { HUBER_GREY };
        terms[k] = bounded * (2.0 * size - bounded);
    }
    terms
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

    /// [`sum_of_samples`](crate::slam::depth::pattern::sum_of_samples).
    ///
    /// # Safety
    /// The processor has AVX2. Without the attribute that says so, because only that goes into the loop of the caller
    /// whatever its size. So have the others.
    #[inline(always)]
    pub(super) unsafe fn sum_of(terms: &[f32; 8]) -> f32 {
        // SAFETY: this function's own contract; eight numbers are loaded.
        unsafe { sum(_mm256_loadu_ps(terms.as_ptr())) }
    }

    /// The same of several at once.
    ///
    /// # Safety
    /// As [`sum_of`].
    #[inline(always)]
    pub(super) unsafe fn sums(rows: &[[f32; 8]; 8]) -> [f32; 8] {
        // SAFETY: this function's own contract; eight numbers are loaded and stored.
        unsafe {
            let row = |k: usize| _mm256_loadu_ps(rows[k].as_ptr());
            // Halves of two rows, then quarters of four, then eighths of all, each in the place of its row.
            let halves = |one, other| {
                let lower = _mm256_permute2f128_ps::<0x20>(one, other);
                _mm256_add_ps(lower, _mm256_permute2f128_ps::<0x31>(one, other))
            };
            let quarters = |one, other| {
                let lower = _mm256_shuffle_ps::<0x44>(one, other);
                _mm256_add_ps(lower, _mm256_shuffle_ps::<0xee>(one, other))
            };
            let left = quarters(halves(row(0), row(4)), halves(row(1), row(5)));
            let right = quarters(halves(row(2), row(6)), halves(row(3), row(7)));
            let even = _mm256_shuffle_ps::<0x88>(left, right);
            let sums = _mm256_add_ps(even, _mm256_shuffle_ps::<0xdd>(left, right));
            let mut out = [0.0; 8];
            _mm256_storeu_ps(out.as_mut_ptr(), sums);
            out
        }
    }

    /// # Safety
    /// As [`sum_of`].
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
    /// As [`sum_of`].
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
    /// As [`sum_of`].
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
        use super::super::{HUBER_GREY, huber, slope, weight};
        use crate::slam::depth::pattern::sum_of_samples;
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
                let mut rows: [[f32; 8]; 8] = std::array::from_fn(|_| eight());
                if round % 97 == 0 {
                    seen[round % 8] = [f32::NAN, f32::INFINITY][round % 2];
                    rows[round % 8] = seen;
                }
                // SAFETY: the processor has AVX2, as was just asked.
                let (sums, slopes) =
                    unsafe { (super::sums(&rows), super::slope(&seen, &expected, &gradients)) };
                let is_same = |one: f32, other: f32| {
                    one.to_bits() == other.to_bits() || one.is_nan() && other.is_nan()
                };
                for (row, found) in rows.iter().zip(sums) {
                    // SAFETY: as above.
                    let alone = unsafe { super::sum_of(row) };
                    let expected = sum_of_samples(row);
                    assert!(is_same(found, expected) && is_same(alone, expected), "{row:?}");
                }
                let expected = slope(&seen, &expected, &gradients);
                assert!(is_same(slopes[0], expected[0]) && is_same(slopes[1], expected[1]));
            }
        }

        #[test]
        fn hubers_terms_are_squares_that_grow_linearly_beyond_the_bound() {
            let seen = [0.0, 3.0, -8.9, 9.0, 9.1, -200.0, f32::INFINITY, f32::NAN];
            for (residual, term) in seen.into_iter().zip(huber(&seen, &[0.0; 8])) {
                let weight = weight(residual);
                let expected = weight * (2.0 - weight) * residual * residual;
                match residual.is_finite() {
                    true => assert!((term - expected).abs() <= 1e-6 * expected, "{residual}"),
                    false => assert!(!term.is_finite()),
                }
                assert!(
                    residual.abs() > HUBER_GREY || term == residual * residual || term.is_nan()
                );
            }
        }
    }
}
