//! NEON lanes, four of them.

use std::arch::aarch64::*;

use crate::slam::kernel::lanes_kernel::{EXPONENT, Register, intrinsics};

impl Register for float32x4_t {
    const N: usize = 4;
    type Mask = uint32x4_t;
    type IntLanes = int32x4_t;

    intrinsics! {
        splat(value: f32) -> Self = vdupq_n_f32(value);
        load(from: *const f32) -> Self = vld1q_f32(from);
        store(self: Self, to: *mut f32) -> () = vst1q_f32(to, self);
        add(self: Self, other: Self) -> Self = vaddq_f32(self, other);
        sub(self: Self, other: Self) -> Self = vsubq_f32(self, other);
        mul(self: Self, other: Self) -> Self = vmulq_f32(self, other);
        div(self: Self, other: Self) -> Self = vdivq_f32(self, other);
        sqrt(self: Self) -> Self = vsqrtq_f32(self);
        abs(self: Self) -> Self = vabsq_f32(self);
        floor(self: Self) -> Self = vrndmq_f32(self);
        power_of_two_below(self: Self) -> Self = vreinterpretq_f32_u32(vandq_u32(
            vreinterpretq_u32_f32(self),
            vdupq_n_u32(EXPONENT.to_bits()),
        ));
        // If one operand is NaN (0/0 in Huber's weight), the other is returned, as on the other CPUs.
        min(self: Self, other: Self) -> Self = vminnmq_f32(self, other);
        max(self: Self, other: Self) -> Self = vmaxnmq_f32(self, other);
        mul_add(self: Self, factor: Self, summand: Self) -> Self = vfmaq_f32(summand, self, factor);
        greater(self: Self, other: Self) -> uint32x4_t = vcgtq_f32(self, other);
        at_least(self: Self, other: Self) -> uint32x4_t = vcgeq_f32(self, other);
        equal(self: Self, other: Self) -> uint32x4_t = vceqq_f32(self, other);
        both(one: uint32x4_t, other: uint32x4_t) -> uint32x4_t = vandq_u32(one, other);
        select(mask: uint32x4_t, yes: Self, no: Self) -> Self = vbslq_f32(mask, yes, no);
        bits(mask: uint32x4_t) -> u32 = vaddvq_u32(vandq_u32(mask, vld1q_u32([1, 2, 4, 8].as_ptr())));
        truncate(self: Self) -> int32x4_t = vcvtq_s32_f32(self);
        float(whole: int32x4_t) -> Self = vcvtq_f32_s32(whole);
        index(column: int32x4_t, row: int32x4_t, stride: i32) -> int32x4_t =
            vmlaq_s32(column, row, vdupq_n_s32(stride));
        pairs(table: &[u16], index: int32x4_t, last: u32) -> [Self; 2] =
            gathered::<u16, u32, 16>(table, index, last);
        byte_pairs(table: &[u8], index: int32x4_t, last: u32) -> [Self; 2] =
            gathered::<u8, u16, 8>(table, index, last);
    }
}

/// Gathers pairs of numbers of `BITS` bits: NEON has no gather instruction.
///
/// # Safety
/// The CPU has NEON; `table` has more than `last` + 1 numbers.
#[inline(always)]
unsafe fn gathered<Number, Pair: Into<u32>, const BITS: i32>(
    table: &[Number],
    index: int32x4_t,
    last: u32,
) -> [float32x4_t; 2] {
    // SAFETY: this function's own contract; a pair is two numbers of the table, the left one the lower half.
    unsafe {
        let mut pairs = [0; 4];
        vst1q_u32(pairs.as_mut_ptr(), vminq_u32(vreinterpretq_u32_s32(index), vdupq_n_u32(last)));
        for pair in &mut pairs {
            *pair = table.as_ptr().add(*pair as usize).cast::<Pair>().read_unaligned().into();
        }
        let pairs = vld1q_u32(pairs.as_ptr());
        let low = vandq_u32(pairs, vdupq_n_u32((1 << BITS) - 1));
        [low, vshrq_n_u32::<BITS>(pairs)].map(|half| vcvtq_f32_u32(half))
    }
}
