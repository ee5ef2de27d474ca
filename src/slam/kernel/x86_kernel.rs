//! AVX2 and AVX-512 lanes.

use std::arch::x86_64::*;

use crate::slam::kernel::lanes_kernel::{Lanes, Sample};

/// Defines methods of `Lanes` that are one intrinsic each.
macro_rules! intrinsics {
    ($($name:ident($($argument:ident: $kind:ty),*) -> $result:ty = $body:expr;)*) => {$(
        #[inline(always)]
        unsafe fn $name($($argument: $kind),*) -> $result {
            // SAFETY: the trait's contract: the CPU has the instructions, pointers are good for N.
            unsafe { $body }
        }
    )*};
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
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the trait's contract.
        unsafe { _mm256_storeu_ps(to, self) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_add_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_sub_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_mul_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_div_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn sqrt(self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_sqrt_ps(self) }
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_min_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_max_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, summand: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm256_fmadd_ps(self, factor, summand) }
    }
    #[inline(always)]
    unsafe fn greater(self, other: Self) -> __m256 {
        // SAFETY: the trait's contract.
        unsafe { _mm256_cmp_ps::<_CMP_GT_OQ>(self, other) }
    }
    #[inline(always)]
    unsafe fn at_least(self, other: Self) -> __m256 {
        // SAFETY: the trait's contract.
        unsafe { _mm256_cmp_ps::<_CMP_GE_OQ>(self, other) }
    }
    #[inline(always)]
    unsafe fn sample(image: &[u16], stride: usize, u: Self, v: Self) -> Sample<Self> {
        // SAFETY: the trait's contract; every index and its right and lower neighbour lie within
        // the image, so that each gather reads two of its pixels.
        unsafe {
            let (column, row) = (_mm256_cvttps_epi32(u), _mm256_cvttps_epi32(v));
            let stride = _mm256_set1_epi32(stride as i32);
            let upper = _mm256_add_epi32(_mm256_mullo_epi32(row, stride), column);
            let lower = _mm256_add_epi32(upper, stride);
            let pixels = image.as_ptr().cast::<i32>();
            let upper = _mm256_i32gather_epi32::<2>(pixels, upper);
            let lower = _mm256_i32gather_epi32::<2>(pixels, lower);
            let low = _mm256_set1_epi32(0xFFFF);
            let left = |pair: __m256i| _mm256_cvtepi32_ps(_mm256_and_si256(pair, low));
            let right = |pair: __m256i| _mm256_cvtepi32_ps(_mm256_srli_epi32::<16>(pair));
            Sample {
                upper_left: left(upper),
                upper_right: right(upper),
                lower_left: left(lower),
                lower_right: right(lower),
                du: _mm256_sub_ps(u, _mm256_cvtepi32_ps(column)),
                dv: _mm256_sub_ps(v, _mm256_cvtepi32_ps(row)),
            }
        }
    }
    #[inline(always)]
    unsafe fn sample_bytes(image: &[u8], stride: usize, u: Self, v: Self) -> Sample<Self> {
        // SAFETY: the trait's contract; an index is at most that of the pixel with a row and four bytes behind it,
        // unsigned, so that each gather reads four bytes of the image.
        unsafe {
            let (column, row) = (_mm256_cvttps_epi32(u), _mm256_cvttps_epi32(v));
            let last = _mm256_set1_epi32((image.len() - stride - 4) as i32);
            let stride = _mm256_set1_epi32(stride as i32);
            let index = _mm256_add_epi32(_mm256_mullo_epi32(row, stride), column);
            let index = _mm256_min_epu32(index, last);
            let pixels = image.as_ptr().cast::<i32>();
            let words = |index| _mm256_i32gather_epi32::<1>(pixels, index);
            let (upper, lower) = (words(index), words(_mm256_add_epi32(index, stride)));
            let byte = _mm256_set1_epi32(255);
            let left = |word: __m256i| _mm256_cvtepi32_ps(_mm256_and_si256(word, byte));
            let right = |word: __m256i| left(_mm256_srli_epi32::<8>(word));
            Sample {
                upper_left: left(upper),
                upper_right: right(upper),
                lower_left: left(lower),
                lower_right: right(lower),
                du: _mm256_sub_ps(u, _mm256_cvtepi32_ps(column)),
                dv: _mm256_sub_ps(v, _mm256_cvtepi32_ps(row)),
            }
        }
    }
}

impl Lanes for __m512 {
    const N: usize = 16;
    type Mask = __mmask16;

    intrinsics! {
        splat(value: f32) -> Self = _mm512_set1_ps(value);
        load(from: *const f32) -> Self = _mm512_loadu_ps(from);
        select(mask: __mmask16, yes: Self, no: Self) -> Self = _mm512_mask_blend_ps(mask, no, yes);
    }
    #[inline(always)]
    unsafe fn count(mask: __mmask16) -> u32 {
        mask.count_ones()
    }
    #[inline(always)]
    unsafe fn both(one: __mmask16, other: __mmask16) -> __mmask16 {
        one & other
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the trait's contract.
        unsafe { _mm512_storeu_ps(to, self) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_add_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_sub_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_mul_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_div_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn sqrt(self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_sqrt_ps(self) }
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_min_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_max_ps(self, other) }
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, summand: Self) -> Self {
        // SAFETY: the trait's contract.
        unsafe { _mm512_fmadd_ps(self, factor, summand) }
    }
    #[inline(always)]
    unsafe fn greater(self, other: Self) -> __mmask16 {
        // SAFETY: the trait's contract.
        unsafe { _mm512_cmp_ps_mask::<_CMP_GT_OQ>(self, other) }
    }
    #[inline(always)]
    unsafe fn at_least(self, other: Self) -> __mmask16 {
        // SAFETY: the trait's contract.
        unsafe { _mm512_cmp_ps_mask::<_CMP_GE_OQ>(self, other) }
    }
    #[inline(always)]
    unsafe fn sample(image: &[u16], stride: usize, u: Self, v: Self) -> Sample<Self> {
        // SAFETY: the trait's contract; every index and its right and lower neighbour lie within
        // the image, so that each gather reads two of its pixels.
        unsafe {
            let (column, row) = (_mm512_cvttps_epi32(u), _mm512_cvttps_epi32(v));
            let stride = _mm512_set1_epi32(stride as i32);
            let upper = _mm512_add_epi32(_mm512_mullo_epi32(row, stride), column);
            let lower = _mm512_add_epi32(upper, stride);
            let pixels = image.as_ptr().cast::<i32>();
            let upper = _mm512_i32gather_epi32::<2>(upper, pixels);
            let lower = _mm512_i32gather_epi32::<2>(lower, pixels);
            let low = _mm512_set1_epi32(0xFFFF);
            let left = |pair: __m512i| _mm512_cvtepi32_ps(_mm512_and_si512(pair, low));
            let right = |pair: __m512i| _mm512_cvtepi32_ps(_mm512_srli_epi32::<16>(pair));
            Sample {
                upper_left: left(upper),
                upper_right: right(upper),
                lower_left: left(lower),
                lower_right: right(lower),
                du: _mm512_sub_ps(u, _mm512_cvtepi32_ps(column)),
                dv: _mm512_sub_ps(v, _mm512_cvtepi32_ps(row)),
            }
        }
    }
    #[inline(always)]
    unsafe fn sample_bytes(image: &[u8], stride: usize, u: Self, v: Self) -> Sample<Self> {
        // SAFETY: the trait's contract; an index is at most that of the pixel with a row and four bytes behind it,
        // unsigned, so that each gather reads four bytes of the image.
        unsafe {
            let (column, row) = (_mm512_cvttps_epi32(u), _mm512_cvttps_epi32(v));
            let last = _mm512_set1_epi32((image.len() - stride - 4) as i32);
            let stride = _mm512_set1_epi32(stride as i32);
            let index = _mm512_add_epi32(_mm512_mullo_epi32(row, stride), column);
            let index = _mm512_min_epu32(index, last);
            let pixels = image.as_ptr().cast::<i32>();
            let words = |index| _mm512_i32gather_epi32::<1>(index, pixels);
            let (upper, lower) = (words(index), words(_mm512_add_epi32(index, stride)));
            let byte = _mm512_set1_epi32(255);
            let left = |word: __m512i| _mm512_cvtepi32_ps(_mm512_and_si512(word, byte));
            let right = |word: __m512i| left(_mm512_srli_epi32::<8>(word));
            Sample {
                upper_left: left(upper),
                upper_right: right(upper),
                lower_left: left(lower),
                lower_right: right(lower),
                du: _mm512_sub_ps(u, _mm512_cvtepi32_ps(column)),
                dv: _mm512_sub_ps(v, _mm512_cvtepi32_ps(row)),
            }
        }
    }
}
