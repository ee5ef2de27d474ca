//! NEON lanes, four of them.

use std::arch::aarch64::*;

use crate::slam::kernel::lanes_kernel::{Lanes, Sample, intrinsics};

impl Lanes for float32x4_t {
    const N: usize = 4;
    type Mask = uint32x4_t;

    intrinsics! {
        splat(value: f32) -> Self = vdupq_n_f32(value);
        load(from: *const f32) -> Self = vld1q_f32(from);
        add(self: Self, other: Self) -> Self = vaddq_f32(self, other);
        sub(self: Self, other: Self) -> Self = vsubq_f32(self, other);
        mul(self: Self, other: Self) -> Self = vmulq_f32(self, other);
        div(self: Self, other: Self) -> Self = vdivq_f32(self, other);
        sqrt(self: Self) -> Self = vsqrtq_f32(self);
        // The number where the other is not one (0/0 in Huber's weight), as on the other CPUs.
        min(self: Self, other: Self) -> Self = vminnmq_f32(self, other);
        max(self: Self, other: Self) -> Self = vmaxnmq_f32(self, other);
        mul_add(self: Self, factor: Self, summand: Self) -> Self = vfmaq_f32(summand, self, factor);
        greater(self: Self, other: Self) -> uint32x4_t = vcgtq_f32(self, other);
        at_least(self: Self, other: Self) -> uint32x4_t = vcgeq_f32(self, other);
        both(one: uint32x4_t, other: uint32x4_t) -> uint32x4_t = vandq_u32(one, other);
        select(mask: uint32x4_t, yes: Self, no: Self) -> Self = vbslq_f32(mask, yes, no);
        count(mask: uint32x4_t) -> u32 = vaddvq_u32(vshrq_n_u32::<31>(mask));
        store(self: Self, to: *mut f32) -> () = vst1q_f32(to, self);
    }
    #[inline(always)]
    unsafe fn sample(image: &[u16], stride: usize, u: Self, v: Self) -> Sample<Self> {
        // SAFETY: the trait's contract; every index and its right and lower neighbour lie within
        // the image, so that each load reads two of its pixels.
        unsafe {
            let (column, row) = (vcvtq_u32_f32(u), vcvtq_u32_f32(v));
            let upper = vmlaq_u32(column, row, vdupq_n_u32(stride as u32));
            let lower = vaddq_u32(upper, vdupq_n_u32(stride as u32));
            let pixels = image.as_ptr();
            let pair = |index: u32| pixels.add(index as usize).cast::<u32>().read_unaligned();
            // There is no gather; little-endian: the left pixel is the lower half of a pair.
            let pairs = |index: uint32x4_t| {
                let pairs = vdupq_n_u32(pair(vgetq_lane_u32::<0>(index)));
                let pairs = vsetq_lane_u32::<1>(pair(vgetq_lane_u32::<1>(index)), pairs);
                let pairs = vsetq_lane_u32::<2>(pair(vgetq_lane_u32::<2>(index)), pairs);
                vsetq_lane_u32::<3>(pair(vgetq_lane_u32::<3>(index)), pairs)
            };
            let (upper, lower) = (pairs(upper), pairs(lower));
            let low = vdupq_n_u32(0xFFFF);
            let left = |pair: uint32x4_t| vcvtq_f32_u32(vandq_u32(pair, low));
            let right = |pair: uint32x4_t| vcvtq_f32_u32(vshrq_n_u32::<16>(pair));
            Sample {
                upper_left: left(upper),
                upper_right: right(upper),
                lower_left: left(lower),
                lower_right: right(lower),
                du: vsubq_f32(u, vcvtq_f32_u32(column)),
                dv: vsubq_f32(v, vcvtq_f32_u32(row)),
            }
        }
    }
    #[inline(always)]
    unsafe fn sample_bytes(image: &[u8], stride: usize, u: Self, v: Self) -> Sample<Self> {
        // SAFETY: the trait's contract; an index is at most that of the pixel with a row and four bytes behind it,
        // unsigned, so that each load reads two bytes of the image.
        unsafe {
            let (column, row) = (vcvtq_s32_f32(u), vcvtq_s32_f32(v));
            let index = vmlaq_s32(column, row, vdupq_n_s32(stride as i32));
            let last = vdupq_n_u32((image.len() - stride - 4) as u32);
            let upper = vminq_u32(vreinterpretq_u32_s32(index), last);
            let lower = vaddq_u32(upper, vdupq_n_u32(stride as u32));
            let pixels = image.as_ptr();
            let pair =
                |index: u32| u32::from(pixels.add(index as usize).cast::<u16>().read_unaligned());
            // There is no gather; little-endian: the left pixel is the lower byte of a pair.
            let pairs = |index: uint32x4_t| {
                let pairs = vdupq_n_u32(pair(vgetq_lane_u32::<0>(index)));
                let pairs = vsetq_lane_u32::<1>(pair(vgetq_lane_u32::<1>(index)), pairs);
                let pairs = vsetq_lane_u32::<2>(pair(vgetq_lane_u32::<2>(index)), pairs);
                vsetq_lane_u32::<3>(pair(vgetq_lane_u32::<3>(index)), pairs)
            };
            let (upper, lower) = (pairs(upper), pairs(lower));
            let left = |pair: uint32x4_t| vcvtq_f32_u32(vandq_u32(pair, vdupq_n_u32(255)));
            let right = |pair: uint32x4_t| vcvtq_f32_u32(vshrq_n_u32::<8>(pair));
            Sample {
                upper_left: left(upper),
                upper_right: right(upper),
                lower_left: left(lower),
                lower_right: right(lower),
                du: vsubq_f32(u, vcvtq_f32_s32(column)),
                dv: vsubq_f32(v, vcvtq_f32_s32(row)),
            }
        }
    }
}
