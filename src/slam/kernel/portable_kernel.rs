//! Four lanes of plain arithmetic: the same bits on every CPU.

use crate::slam::kernel::lanes_kernel::{Lanes, Sample};

/// Four floats.
#[derive(Clone, Copy)]
#[repr(C, align(16))]
pub struct FourLanes([f32; 4]);

impl FourLanes {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| operation(self.0[lane], other.0[lane])))
    }

    #[inline(always)]
    fn compare(self, other: Self, operation: impl Fn(f32, f32) -> bool) -> [bool; 4] {
        std::array::from_fn(|lane| operation(self.0[lane], other.0[lane]))
    }
}

// SAFETY of every function: plain arithmetic; `load` and `store` get pointers to four floats.
impl Lanes for FourLanes {
    const N: usize = 4;
    type Mask = [bool; 4];

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Self([value; 4])
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller points to four floats.
        Self(unsafe { from.cast::<[f32; 4]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller points to four floats.
        unsafe { to.cast::<[f32; 4]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
    #[inline(always)]
    unsafe fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, summand: Self) -> Self {
        // Not fused: a CPU without the instruction would emulate it, and the bits must not differ.
        Self(std::array::from_fn(|lane| self.0[lane] * factor.0[lane] + summand.0[lane]))
    }
    #[inline(always)]
    unsafe fn greater(self, other: Self) -> [bool; 4] {
        self.compare(other, |a, b| a > b)
    }
    #[inline(always)]
    unsafe fn at_least(self, other: Self) -> [bool; 4] {
        self.compare(other, |a, b| a >= b)
    }
    #[inline(always)]
    unsafe fn both(one: [bool; 4], other: [bool; 4]) -> [bool; 4] {
        std::array::from_fn(|lane| one[lane] & other[lane])
    }
    #[inline(always)]
    unsafe fn select(mask: [bool; 4], yes: Self, no: Self) -> Self {
        Self(std::array::from_fn(|lane| if mask[lane] { yes.0[lane] } else { no.0[lane] }))
    }
    #[inline(always)]
    unsafe fn count(mask: [bool; 4]) -> u32 {
        mask.iter().map(|&set| u32::from(set)).sum()
    }
    #[inline(always)]
    unsafe fn sample(image: &[u16], stride: usize, u: Self, v: Self) -> Sample<Self> {
        let mut pixels = [[0.0f32; 4]; 6];
        for lane in 0..4 {
            let (column, row) = (u.0[lane] as usize, v.0[lane] as usize);
            let upper = column + row * stride;
            pixels[0][lane] = f32::from(image[upper]);
            pixels[1][lane] = f32::from(image[upper + 1]);
            pixels[2][lane] = f32::from(image[upper + stride]);
            pixels[3][lane] = f32::from(image[upper + stride + 1]);
            pixels[4][lane] = u.0[lane] - column as f32;
            pixels[5][lane] = v.0[lane] - row as f32;
        }
        let [upper_left, upper_right, lower_left, lower_right, du, dv] = pixels.map(Self);
        Sample { upper_left, upper_right, lower_left, lower_right, du, dv }
    }
    #[inline(always)]
    unsafe fn sample_bytes(image: &[u8], stride: usize, u: Self, v: Self) -> Sample<Self> {
        let last = image.len() - stride - 4;
        let mut pixels = [[0.0f32; 4]; 6];
        for lane in 0..4 {
            let (column, row) = (u.0[lane] as i32, v.0[lane] as i32);
            let index = row.wrapping_mul(stride as i32).wrapping_add(column);
            let upper = (index as u32 as usize).min(last);
            pixels[0][lane] = f32::from(image[upper]);
            pixels[1][lane] = f32::from(image[upper + 1]);
            pixels[2][lane] = f32::from(image[upper + stride]);
            pixels[3][lane] = f32::from(image[upper + stride + 1]);
            pixels[4][lane] = u.0[lane] - column as f32;
            pixels[5][lane] = v.0[lane] - row as f32;
        }
        let [upper_left, upper_right, lower_left, lower_right, du, dv] = pixels.map(Self);
        Sample { upper_left, upper_right, lower_left, lower_right, du, dv }
    }
}
