//! The cost of a patch in vector registers.

use crate::slam::depth::pattern::{HUBER_GREY, sum_of_samples};
use crate::slam::kernel::{Floats, Instructions};

/// ρ(r) by sample: r² up to [`HUBER_GREY`], linear beyond; r = `seen` − `expected`. Avoids the division of a weight.
#[inline(always)]
pub(super) fn huber<I: Instructions>(lanes: I, seen: &[f32; 8], expected: &[f32; 8]) -> [f32; 8] {
    let lanes = lanes.eight();
    let size = (lanes.load(seen) - lanes.load(expected)).abs();
    let bounded = size.min(lanes.splat(HUBER_GREY));
    (bounded * (lanes.splat(2.0) * size - bounded)).to_array()
}

/// The sum of each row: several at once, because within a row each addition waits for the one before.
#[inline(always)]
pub(super) fn sums<I: Instructions>(_: I, rows: &[[f32; 8]; 8]) -> [f32; 8] {
    #[cfg(target_arch = "x86_64")]
    if I::HAS_AVX2 {
        // SAFETY: whoever made the instructions vouched for them.
        return unsafe { sums_avx2(rows) };
    }
    rows.map(|row| sum_of_samples(&row))
}

/// # Safety
/// The processor has AVX2. Without `#[target_feature]`, because only then is it inlined into the caller's loop whatever
/// its size.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn sums_avx2(rows: &[[f32; 8]; 8]) -> [f32; 8] {
    use std::arch::x86_64::*;

    // SAFETY: this function's own contract; eight numbers are loaded and stored.
    unsafe {
        let row = |k: usize| _mm256_loadu_ps(rows[k].as_ptr());
        // Halves of two rows, then quarters of four, then eighths of all, each sum at the position of its row.
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

/// Σ w g r and Σ w g², w = Huber's weight.
#[inline(always)]
pub(super) fn slope<I: Instructions>(
    lanes: I,
    seen: &[f32; 8],
    expected: &[f32; 8],
    gradients: &[f32; 8],
) -> [f32; 2] {
    let lanes = lanes.eight();
    let (residual, weight) = weighed(lanes, seen, expected);
    let gradients = lanes.load(gradients);
    let weighted = weight * gradients;
    let (mixed, squared) = (weighted * residual, weighted * gradients);
    // Each separately: `map` over registers is not always inlined, and then compiled for every CPU.
    [sum_of_samples(&mixed.to_array()), sum_of_samples(&squared.to_array())]
}

/// Residuals and Huber's weights: 1 up to the bound, without a branch, so that it vectorises.
#[inline(always)]
fn weighed<I: Instructions>(
    lanes: I,
    seen: &[f32; 8],
    expected: &[f32; 8],
) -> (Floats<I>, Floats<I>) {
    let residual = lanes.load(seen) - lanes.load(expected);
    let bound = lanes.splat(HUBER_GREY);
    (residual, bound / residual.abs().max(bound))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::kernel::{Body, Kernel};
    use crate::slam::test_scene::Random;

    /// Samples, expected values, gradients, and more.
    #[derive(Debug, Clone, Copy)]
    struct Rows([[f32; 8]; 8]);

    impl Body for Rows {
        type Output = [[f32; 8]; 3];

        #[inline(always)]
        fn run<I: Instructions>(self, lanes: I) -> [[f32; 8]; 3] {
            let [seen, expected, gradients, ..] = &self.0;
            let [mixed, squares] = slope(lanes, seen, expected, gradients);
            let slopes = [mixed, squares, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            [huber(lanes, seen, expected), sums(lanes, &self.0), slopes]
        }
    }

    #[test]
    fn all_versions_give_the_same_bits() {
        let mut random = Random::new(11);
        for round in 0..1000 {
            let scale = [1.0, 8.0, 60.0, 1e20][round % 4];
            let mut of = Rows([[0.0; 8]; 8]);
            of.0.as_flattened_mut().fill_with(|| (scale * random.normal()) as f32);
            if round % 97 == 0 {
                of.0[0][round % 8] = [f32::NAN, f32::INFINITY][round % 2];
            }
            // NaN payloads are not compared.
            let bits = |kernel: Kernel| {
                let found = kernel.run(of);
                found.map(|row| row.map(|x| if x.is_nan() { f32::NAN } else { x }.to_bits()))
            };
            for kernel in Kernel::available() {
                assert_eq!(bits(kernel), bits(Kernel::Portable), "{kernel:?} {of:?}");
            }
        }
    }

    #[test]
    fn huber_terms_are_squares_up_to_the_bound_and_linear_beyond() {
        let seen = [0.0, 3.0, -8.9, 9.0, 9.1, -200.0, f32::INFINITY, f32::NAN];
        let mut rows = Rows([[0.0; 8]; 8]);
        rows.0[0] = seen;
        for (residual, term) in seen.into_iter().zip(Kernel::Portable.run(rows)[0]) {
            let size = residual.abs();
            let expected = if size > 9.0 { 9.0 * (2.0 * size - 9.0) } else { size * size };
            match residual.is_finite() {
                true => assert!((term - expected).abs() <= 1e-6 * expected, "{residual}"),
                false => assert!(!term.is_finite(), "{residual}"),
            }
        }
    }
}
