//! Lanes of plain arithmetic: the same bits on every CPU.

use std::array::from_fn;

use crate::slam::kernel::lanes_kernel::{EXPONENT, Register, intrinsics};

/// Lanes as an array.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(16))]
pub struct Numbers<const N: usize>([f32; N]);

impl<const N: usize> Numbers<N> {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(f32, f32) -> f32) -> Self {
        Self(from_fn(|lane| operation(self.0[lane], other.0[lane])))
    }

    #[inline(always)]
    fn compare(self, other: Self, operation: impl Fn(f32, f32) -> bool) -> [bool; N] {
        from_fn(|lane| operation(self.0[lane], other.0[lane]))
    }

    #[inline(always)]
    fn pairs<Number>(table: &[Number], index: [i32; N], last: u32) -> [Self; 2]
    where
        Number: Copy + Into<f32>,
    {
        [0, 1].map(|k| Self(index.map(|i| table[(i as u32).min(last) as usize + k].into())))
    }
}

impl<const N: usize> Register for Numbers<N> {
    const N: usize = N;
    type Mask = [bool; N];
    type IntLanes = [i32; N];

    intrinsics! {
        splat(value: f32) -> Self = Self([value; N]);
        load(from: *const f32) -> Self = Self(from.cast::<[f32; N]>().read_unaligned());
        store(self: Self, to: *mut f32) -> () = to.cast::<[f32; N]>().write_unaligned(self.0);
        add(self: Self, other: Self) -> Self = self.zip(other, |a, b| a + b);
        sub(self: Self, other: Self) -> Self = self.zip(other, |a, b| a - b);
        mul(self: Self, other: Self) -> Self = self.zip(other, |a, b| a * b);
        div(self: Self, other: Self) -> Self = self.zip(other, |a, b| a / b);
        sqrt(self: Self) -> Self = Self(self.0.map(f32::sqrt));
        abs(self: Self) -> Self = Self(self.0.map(f32::abs));
        floor(self: Self) -> Self = Self(self.0.map(floor));
        power_of_two_below(self: Self) -> Self =
            Self(self.0.map(|x| f32::from_bits(x.to_bits() & EXPONENT.to_bits())));
        min(self: Self, other: Self) -> Self = self.zip(other, |a, b| if a < b { a } else { b });
        max(self: Self, other: Self) -> Self = self.zip(other, |a, b| if a > b { a } else { b });
        // Not fused: a CPU without the instruction would emulate it, and the bits must not differ.
        mul_add(self: Self, factor: Self, summand: Self) -> Self =
            Self(from_fn(|lane| self.0[lane] * factor.0[lane] + summand.0[lane]));
        greater(self: Self, other: Self) -> [bool; N] = self.compare(other, |a, b| a > b);
        at_least(self: Self, other: Self) -> [bool; N] = self.compare(other, |a, b| a >= b);
        equal(self: Self, other: Self) -> [bool; N] = self.compare(other, |a, b| a == b);
        both(one: [bool; N], other: [bool; N]) -> [bool; N] = from_fn(|lane| one[lane] & other[lane]);
        select(mask: [bool; N], yes: Self, no: Self) -> Self =
            Self(from_fn(|lane| if mask[lane] { yes.0[lane] } else { no.0[lane] }));
        bits(mask: [bool; N]) -> u32 =
            (0..N).fold(0, |bits, lane| bits | u32::from(mask[lane]) << lane);
        truncate(self: Self) -> [i32; N] = self.0.map(truncate);
        float(whole: [i32; N]) -> Self = Self(whole.map(|x| x as f32));
        index(column: [i32; N], row: [i32; N], stride: i32) -> [i32; N] =
            from_fn(|lane| row[lane].wrapping_mul(stride).wrapping_add(column[lane]));
        pairs(table: &[u16], index: [i32; N], last: u32) -> [Self; 2] = Self::pairs(table, index, last);
        byte_pairs(table: &[u8], index: [i32; N], last: u32) -> [Self; 2] =
            Self::pairs(table, index, last);
    }
}

/// Rounds down without the function call that the baseline instruction set needs for it.
#[inline(always)]
fn floor(x: f32) -> f32 {
    /// From here on all numbers are integers.
    const WHOLE: f32 = 8_388_608.0;
    // NaN is returned too.
    if !(x.abs() < WHOLE) {
        return x;
    }
    let towards_zero = x as i32 as f32;
    let below = if towards_zero > x { towards_zero - 1.0 } else { towards_zero };
    below.copysign(x)
}

/// Truncates like the vector instructions, where plain Rust would give the nearest i32, and 0 for NaN.
#[inline(always)]
fn truncate(x: f32) -> i32 {
    if x.abs() < -(i32::MIN as f32) { x as i32 } else { i32::MIN }
}
