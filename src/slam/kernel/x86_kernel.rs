//! AVX2 and AVX-512 lanes.

use std::arch::x86_64::*;

use crate::slam::kernel::lanes_kernel::{Lanes, Sample, intrinsics};

/// Defines the samples of `Lanes`, which differ by the width of the registers alone.
macro_rules! samples {
    (
        $Integers:ty, $gathered:ident, $splat:ident, $truncated:ident, $floats:ident, $add:ident, $mul:ident, $and:ident,
        $shifted:ident, $min:ident, $sub:ident
    ) => {
        #[inline(always)]
        unsafe fn sample(image: &[u16], stride: usize, u: Self, v: Self) -> Sample<Self> {
            // SAFETY: the trait's contract; every index and its right and lower neighbour lie within
            // the image, so that each gather reads two of its pixels.
            unsafe {
                let (column, row) = ($truncated(u), $truncated(v));
                let stride = $splat(stride as i32);
                let upper = $add($mul(row, stride), column);
                let lower = $add(upper, stride);
                let pixels = image.as_ptr().cast::<i32>();
                let upper = $gathered::<2>(pixels, upper);
                let lower = $gathered::<2>(pixels, lower);
                let low = $splat(0xFFFF);
                let left = |pair: $Integers| $floats($and(pair, low));
                let right = |pair: $Integers| $floats($shifted::<16>(pair));
                Sample {
                    upper_left: left(upper),
                    upper_right: right(upper),
                    lower_left: left(lower),
                    lower_right: right(lower),
                    du: $sub(u, $floats(column)),
                    dv: $sub(v, $floats(row)),
                }
            }
        }
        #[inline(always)]
        unsafe fn sample_bytes(image: &[u8], stride: usize, u: Self, v: Self) -> Sample<Self> {
            // SAFETY: the trait's contract; an index is at most that of the pixel with a row and four bytes behind it,
            // unsigned, so that each gather reads four bytes of the image.
            unsafe {
                let (column, row) = ($truncated(u), $truncated(v));
                let last = $splat((image.len() - stride - 4) as i32);
                let stride = $splat(stride as i32);
                let index = $add($mul(row, stride), column);
                let index = $min(index, last);
                let pixels = image.as_ptr().cast::<i32>();
                let words = |index| $gathered::<1>(pixels, index);
                let (upper, lower) = (words(index), words($add(index, stride)));
                let byte = $splat(255);
                let left = |word: $Integers| $floats($and(word, byte));
                let right = |word: $Integers| left($shifted::<8>(word));
                Sample {
                    upper_left: left(upper),
                    upper_right: right(upper),
                    lower_left: left(lower),
                    lower_right: right(lower),
                    du: $sub(u, $floats(column)),
                    dv: $sub(v, $floats(row)),
                }
            }
        }
    };
}

impl Lanes for __m256 {
    const N: usize = 8;
    type Mask = __m256;

    intrinsics! {
        splat(value: f32) -> Self = _mm256_set1_ps(value);
        load(from: *const f32) -> Self = _mm256_loadu_ps(from);
        count(mask: __m256) -> u32 = (_mm256_movemask_ps(mask) as u32).count_ones();
        both(one: __m256, other: __m256) -> __m256 = _mm256_and_ps(one, other);
        select(mask: __m256, yes: Self, no: Self) -> Self = _mm256_blendv_ps(no, yes, mask);
        add(self: Self, other: Self) -> Self = _mm256_add_ps(self, other);
        sub(self: Self, other: Self) -> Self = _mm256_sub_ps(self, other);
        mul(self: Self, other: Self) -> Self = _mm256_mul_ps(self, other);
        div(self: Self, other: Self) -> Self = _mm256_div_ps(self, other);
        sqrt(self: Self) -> Self = _mm256_sqrt_ps(self);
        min(self: Self, other: Self) -> Self = _mm256_min_ps(self, other);
        max(self: Self, other: Self) -> Self = _mm256_max_ps(self, other);
        mul_add(self: Self, factor: Self, summand: Self) -> Self = _mm256_fmadd_ps(self, factor, summand);
        greater(self: Self, other: Self) -> __m256 = _mm256_cmp_ps::<_CMP_GT_OQ>(self, other);
        at_least(self: Self, other: Self) -> __m256 = _mm256_cmp_ps::<_CMP_GE_OQ>(self, other);
        store(self: Self, to: *mut f32) -> () = _mm256_storeu_ps(to, self);
    }
    samples!(
        __m256i,
        _mm256_i32gather_epi32,
        _mm256_set1_epi32,
        _mm256_cvttps_epi32,
        _mm256_cvtepi32_ps,
        _mm256_add_epi32,
        _mm256_mullo_epi32,
        _mm256_and_si256,
        _mm256_srli_epi32,
        _mm256_min_epu32,
        _mm256_sub_ps
    );
}

impl Lanes for __m512 {
    const N: usize = 16;
    type Mask = __mmask16;

    intrinsics! {
        splat(value: f32) -> Self = _mm512_set1_ps(value);
        load(from: *const f32) -> Self = _mm512_loadu_ps(from);
        select(mask: __mmask16, yes: Self, no: Self) -> Self = _mm512_mask_blend_ps(mask, no, yes);
        add(self: Self, other: Self) -> Self = _mm512_add_ps(self, other);
        sub(self: Self, other: Self) -> Self = _mm512_sub_ps(self, other);
        mul(self: Self, other: Self) -> Self = _mm512_mul_ps(self, other);
        div(self: Self, other: Self) -> Self = _mm512_div_ps(self, other);
        sqrt(self: Self) -> Self = _mm512_sqrt_ps(self);
        min(self: Self, other: Self) -> Self = _mm512_min_ps(self, other);
        max(self: Self, other: Self) -> Self = _mm512_max_ps(self, other);
        mul_add(self: Self, factor: Self, summand: Self) -> Self = _mm512_fmadd_ps(self, factor, summand);
        greater(self: Self, other: Self) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(self, other);
        at_least(self: Self, other: Self) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_GE_OQ>(self, other);
        store(self: Self, to: *mut f32) -> () = _mm512_storeu_ps(to, self);
    }
    #[inline(always)]
    unsafe fn count(mask: __mmask16) -> u32 {
        mask.count_ones()
    }
    #[inline(always)]
    unsafe fn both(one: __mmask16, other: __mmask16) -> __mmask16 {
        one & other
    }
    samples!(
        __m512i,
        gathered_512,
        _mm512_set1_epi32,
        _mm512_cvttps_epi32,
        _mm512_cvtepi32_ps,
        _mm512_add_epi32,
        _mm512_mullo_epi32,
        _mm512_and_si512,
        _mm512_srli_epi32,
        _mm512_min_epu32,
        _mm512_sub_ps
    );
}

/// With the arguments in the order of AVX2.
///
/// # Safety
/// The CPU has AVX-512F; the pixels at every index are good for four bytes.
#[inline(always)]
unsafe fn gathered_512<const SCALE: i32>(pixels: *const i32, index: __m512i) -> __m512i {
    // SAFETY: this function's own contract.
    unsafe { _mm512_i32gather_epi32::<SCALE>(index, pixels) }
}
