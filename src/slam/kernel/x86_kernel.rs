//! AVX2 and AVX-512 lanes.

use std::arch::x86_64::*;

use crate::slam::kernel::lanes_kernel::{EXPONENT, Register, intrinsics};

impl Register for __m256 {
    const N: usize = 8;
    type Mask = __m256;
    type IntLanes = __m256i;

    intrinsics! {
        splat(value: f32) -> Self = _mm256_set1_ps(value);
        load(from: *const f32) -> Self = _mm256_loadu_ps(from);
        store(self: Self, to: *mut f32) -> () = _mm256_storeu_ps(to, self);
        add(self: Self, other: Self) -> Self = _mm256_add_ps(self, other);
        sub(self: Self, other: Self) -> Self = _mm256_sub_ps(self, other);
        mul(self: Self, other: Self) -> Self = _mm256_mul_ps(self, other);
        div(self: Self, other: Self) -> Self = _mm256_div_ps(self, other);
        sqrt(self: Self) -> Self = _mm256_sqrt_ps(self);
        abs(self: Self) -> Self = _mm256_andnot_ps(_mm256_set1_ps(-0.0), self);
        floor(self: Self) -> Self = _mm256_floor_ps(self);
        power_of_two_below(self: Self) -> Self = _mm256_and_ps(self, _mm256_set1_ps(EXPONENT));
        min(self: Self, other: Self) -> Self = _mm256_min_ps(self, other);
        max(self: Self, other: Self) -> Self = _mm256_max_ps(self, other);
        mul_add(self: Self, factor: Self, summand: Self) -> Self = _mm256_fmadd_ps(self, factor, summand);
        greater(self: Self, other: Self) -> __m256 = _mm256_cmp_ps::<_CMP_GT_OQ>(self, other);
        at_least(self: Self, other: Self) -> __m256 = _mm256_cmp_ps::<_CMP_GE_OQ>(self, other);
        equal(self: Self, other: Self) -> __m256 = _mm256_cmp_ps::<_CMP_EQ_OQ>(self, other);
        both(one: __m256, other: __m256) -> __m256 = _mm256_and_ps(one, other);
        select(mask: __m256, yes: Self, no: Self) -> Self = _mm256_blendv_ps(no, yes, mask);
        bits(mask: __m256) -> u32 = _mm256_movemask_ps(mask) as u32;
        truncate(self: Self) -> __m256i = _mm256_cvttps_epi32(self);
        float(whole: __m256i) -> Self = _mm256_cvtepi32_ps(whole);
        index(column: __m256i, row: __m256i, stride: i32) -> __m256i =
            _mm256_add_epi32(_mm256_mullo_epi32(row, _mm256_set1_epi32(stride)), column);
    }
    #[inline(always)]
    unsafe fn pairs(table: &[u16], index: __m256i, last: u32) -> [Self; 2] {
        // SAFETY: the trait's contract; two numbers are read at every index.
        unsafe {
            let index = _mm256_min_epu32(index, _mm256_set1_epi32(last as i32));
            let pairs = _mm256_i32gather_epi32::<2>(table.as_ptr().cast(), index);
            let low = _mm256_and_si256(pairs, _mm256_set1_epi32(0xFFFF));
            [low, _mm256_srli_epi32::<16>(pairs)].map(|half| _mm256_cvtepi32_ps(half))
        }
    }
    #[inline(always)]
    unsafe fn byte_pairs(table: &[u8], index: __m256i, last: u32) -> [Self; 2] {
        // SAFETY: the trait's contract; four bytes are read at every index.
        unsafe {
            let index = _mm256_min_epu32(index, _mm256_set1_epi32(last as i32));
            let words = _mm256_i32gather_epi32::<1>(table.as_ptr().cast(), index);
            let byte = |word| _mm256_cvtepi32_ps(_mm256_and_si256(word, _mm256_set1_epi32(255)));
            [words, _mm256_srli_epi32::<8>(words)].map(byte)
        }
    }
}

impl Register for __m512 {
    const N: usize = 16;
    type Mask = __mmask16;
    type IntLanes = __m512i;

    intrinsics! {
        splat(value: f32) -> Self = _mm512_set1_ps(value);
        load(from: *const f32) -> Self = _mm512_loadu_ps(from);
        store(self: Self, to: *mut f32) -> () = _mm512_storeu_ps(to, self);
        add(self: Self, other: Self) -> Self = _mm512_add_ps(self, other);
        sub(self: Self, other: Self) -> Self = _mm512_sub_ps(self, other);
        mul(self: Self, other: Self) -> Self = _mm512_mul_ps(self, other);
        div(self: Self, other: Self) -> Self = _mm512_div_ps(self, other);
        sqrt(self: Self) -> Self = _mm512_sqrt_ps(self);
        abs(self: Self) -> Self = _mm512_abs_ps(self);
        floor(self: Self) -> Self = _mm512_roundscale_ps::<_MM_FROUND_TO_NEG_INF>(self);
        power_of_two_below(self: Self) -> Self = _mm512_and_ps(self, _mm512_set1_ps(EXPONENT));
        min(self: Self, other: Self) -> Self = _mm512_min_ps(self, other);
        max(self: Self, other: Self) -> Self = _mm512_max_ps(self, other);
        mul_add(self: Self, factor: Self, summand: Self) -> Self = _mm512_fmadd_ps(self, factor, summand);
        greater(self: Self, other: Self) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(self, other);
        at_least(self: Self, other: Self) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_GE_OQ>(self, other);
        equal(self: Self, other: Self) -> __mmask16 = _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(self, other);
        both(one: __mmask16, other: __mmask16) -> __mmask16 = _kand_mask16(one, other);
        select(mask: __mmask16, yes: Self, no: Self) -> Self = _mm512_mask_blend_ps(mask, no, yes);
        bits(mask: __mmask16) -> u32 = _cvtmask16_u32(mask);
        truncate(self: Self) -> __m512i = _mm512_cvttps_epi32(self);
        float(whole: __m512i) -> Self = _mm512_cvtepi32_ps(whole);
        index(column: __m512i, row: __m512i, stride: i32) -> __m512i =
            _mm512_add_epi32(_mm512_mullo_epi32(row, _mm512_set1_epi32(stride)), column);
    }
    #[inline(always)]
    unsafe fn pairs(table: &[u16], index: __m512i, last: u32) -> [Self; 2] {
        // SAFETY: the trait's contract; two numbers are read at every index.
        unsafe {
            let index = _mm512_min_epu32(index, _mm512_set1_epi32(last as i32));
            let pairs = _mm512_i32gather_epi32::<2>(index, table.as_ptr().cast());
            let low = _mm512_and_si512(pairs, _mm512_set1_epi32(0xFFFF));
            [low, _mm512_srli_epi32::<16>(pairs)].map(|half| _mm512_cvtepi32_ps(half))
        }
    }
    #[inline(always)]
    unsafe fn byte_pairs(table: &[u8], index: __m512i, last: u32) -> [Self; 2] {
        // SAFETY: the trait's contract; four bytes are read at every index.
        unsafe {
            let index = _mm512_min_epu32(index, _mm512_set1_epi32(last as i32));
            let words = _mm512_i32gather_epi32::<1>(index, table.as_ptr().cast());
            let byte = |word| _mm512_cvtepi32_ps(_mm512_and_si512(word, _mm512_set1_epi32(255)));
            [words, _mm512_srli_epi32::<8>(words)].map(byte)
        }
    }
}
