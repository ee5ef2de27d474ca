//! The operations that loops require of an instruction set, and the arithmetic they are written in.

use std::ops::{Add, BitAnd, Div, Mul, Sub};

/// The exponent bits of an f32.
pub(super) const EXPONENT: f32 = f32::INFINITY;

/// f32 numbers in one register.
///
/// # Safety
/// The CPU has the instructions; pointers are valid for `N` floats; tables have at least `last` + 2 numbers of 16 bits
/// or `last` + 4 of 8 bits.
pub trait Register: Copy {
    /// Number of lanes; divides the sixteen of a block.
    const N: usize;
    /// A truth value for each lane.
    type Mask: Copy;
    /// An i32 for each lane.
    type IntLanes: Copy;

    unsafe fn splat(value: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    unsafe fn store(self, to: *mut f32);
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn sub(self, other: Self) -> Self;
    unsafe fn mul(self, other: Self) -> Self;
    unsafe fn div(self, other: Self) -> Self;
    unsafe fn sqrt(self) -> Self;
    unsafe fn abs(self) -> Self;
    unsafe fn floor(self) -> Self;
    unsafe fn power_of_two_below(self) -> Self;
    unsafe fn min(self, other: Self) -> Self;
    unsafe fn max(self, other: Self) -> Self;
    unsafe fn mul_add(self, factor: Self, summand: Self) -> Self;
    unsafe fn greater(self, other: Self) -> Self::Mask;
    unsafe fn at_least(self, other: Self) -> Self::Mask;
    unsafe fn equal(self, other: Self) -> Self::Mask;
    unsafe fn both(one: Self::Mask, other: Self::Mask) -> Self::Mask;
    unsafe fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    unsafe fn bits(mask: Self::Mask) -> u32;
    /// Rounds towards zero; `i32::MIN` where the result does not fit.
    unsafe fn truncate(self) -> Self::IntLanes;
    unsafe fn float(whole: Self::IntLanes) -> Self;
    /// `row * stride + column`, wrapping.
    unsafe fn index(column: Self::IntLanes, row: Self::IntLanes, stride: i32) -> Self::IntLanes;
    /// The numbers at `index`, unsigned and clamped to `last`, and the numbers right after them.
    unsafe fn pairs(table: &[u16], index: Self::IntLanes, last: u32) -> [Self; 2];
    /// The same for bytes.
    unsafe fn byte_pairs(table: &[u8], index: Self::IntLanes, last: u32) -> [Self; 2];
}

/// Defines methods of `Register` that are one intrinsic each.
macro_rules! intrinsics {
    ($($name:ident($($argument:ident: $kind:ty),*) -> $result:ty = $body:expr;)*) => {$(
        #[inline(always)]
        #[allow(unused_unsafe, reason = "plain arithmetic needs none")]
        unsafe fn $name($($argument: $kind),*) -> $result {
            // SAFETY: the trait's contract: the CPU has the instructions, pointers are valid for N.
            unsafe { $body }
        }
    )*};
}

pub(super) use intrinsics;

/// f32 numbers in a register that the CPU has: only instructions make them.
#[derive(Debug, Clone, Copy)]
pub struct Lanes<R>(pub(super) R);

/// A truth value for each lane.
#[derive(Clone, Copy)]
pub struct Mask<R: Register>(R::Mask);

/// A pixel type that [`Lanes::sample`] reads.
pub trait Pixel: Sized {
    /// The numbers at `index` and those right after them; arbitrary numbers where the table does not have both.
    fn pairs<R: Register>(table: &[Self], index: IntLanes<R>) -> [Lanes<R>; 2];
}

/// An i32 for each lane.
#[derive(Clone, Copy)]
pub struct IntLanes<R: Register>(R::IntLanes);

/// Four neighbouring pixels and the position between them.
#[derive(Clone, Copy)]
pub struct Sample<R> {
    pub upper_left: Lanes<R>,
    pub upper_right: Lanes<R>,
    pub lower_left: Lanes<R>,
    pub lower_right: Lanes<R>,
    pub du: Lanes<R>,
    pub dv: Lanes<R>,
}

impl<R: Register> Sample<R> {
    /// Positive unless one of the pixels has no data.
    #[inline(always)]
    pub fn has_data(&self) -> Lanes<R> {
        self.upper_left * self.upper_right * (self.lower_left * self.lower_right)
    }
}

macro_rules! operators {
    ($($of:ident::$name:ident),*) => {$(
        impl<R: Register> $of for Lanes<R> {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                // SAFETY: whoever made the lanes vouched for the instructions.
                Self(unsafe { R::$name(self.0, other.0) })
            }
        }
    )*};
}

operators!(Add::add, Sub::sub, Mul::mul, Div::div);

macro_rules! methods {
    ($($(#[$doc:meta])* $name:ident($($argument:ident),*) -> $Result:ident;)*) => {$(
        $(#[$doc])*
        #[inline(always)]
        pub fn $name(self, $($argument: Self),*) -> $Result<R> {
            // SAFETY: whoever made the lanes vouched for the instructions.
            $Result(unsafe { R::$name(self.0, $($argument.0),*) })
        }
    )*};
}

impl<R: Register> Lanes<R> {
    methods! {
        /// Square root.
        sqrt() -> Lanes;
        /// Absolute value.
        abs() -> Lanes;
        /// Rounds down; for numbers that fit an `i32`.
        floor() -> Lanes;
        /// The largest power of two not above a number of at least 1.
        power_of_two_below() -> Lanes;
        /// The smaller one; `other` where this is NaN.
        min(other) -> Lanes;
        /// The larger one; `other` where this is NaN.
        max(other) -> Lanes;
        /// `self * factor + summand`.
        mul_add(factor, summand) -> Lanes;
        /// Whether this is greater.
        greater(other) -> Mask;
        /// Whether this is greater or equal.
        at_least(other) -> Mask;
        /// Whether both are equal.
        equal(other) -> Mask;
        /// Rounds towards zero.
        truncate() -> IntLanes;
    }

    /// Stores the lanes; panics if `to` has fewer numbers than lanes.
    #[inline(always)]
    pub fn store(self, to: &mut [f32]) {
        let to = &mut to[..R::N];
        // SAFETY: whoever made the lanes vouched for the instructions; there are N numbers.
        unsafe { self.0.store(to.as_mut_ptr()) }
    }

    /// The lanes, followed by zeros.
    #[inline(always)]
    pub fn to_array<const M: usize>(self) -> [f32; M] {
        let mut array = [0.0; M];
        self.store(&mut array);
        array
    }

    /// The four pixels around (u, v) in rows of `stride`; arbitrary pixels where the image does not have all of them.
    #[inline(always)]
    pub fn sample<P: Pixel>(image: &[P], stride: usize, u: Self, v: Self) -> Sample<R> {
        let (column, row) = (u.truncate(), v.truncate());
        // SAFETY: whoever made the lanes vouched for the instructions.
        let index = IntLanes(unsafe { R::index(column.0, row.0, stride as i32) });
        let [upper_left, upper_right] = P::pairs(&image[..image.len() - stride], index);
        let [lower_left, lower_right] = P::pairs(&image[stride..], index);
        let (du, dv) = (u - column.float(), v - row.float());
        Sample { upper_left, upper_right, lower_left, lower_right, du, dv }
    }
}

impl<R: Register> IntLanes<R> {
    /// The same numbers as f32.
    #[inline(always)]
    pub fn float(self) -> Lanes<R> {
        // SAFETY: whoever made the lanes vouched for the instructions.
        Lanes(unsafe { R::float(self.0) })
    }
}

macro_rules! pixels {
    ($($Pixel:ty, $pairs:ident, $behind:literal;)*) => {$(
        impl Pixel for $Pixel {
            #[inline(always)]
            fn pairs<R: Register>(table: &[Self], index: IntLanes<R>) -> [Lanes<R>; 2] {
                // Indices must fit an i32.
                assert!(($behind..1 << 31).contains(&table.len()), "size of a table");
                let last = (table.len() - $behind) as u32;
                // SAFETY: whoever made the lanes vouched for the instructions; four bytes are read at `last`.
                unsafe { R::$pairs(table, index.0, last) }.map(Lanes)
            }
        }
    )*};
}

pixels! {
    u16, pairs, 2;
    u8, byte_pairs, 4;
}

impl<R: Register> Mask<R> {
    /// `yes` where the mask is set, `no` elsewhere.
    #[inline(always)]
    pub fn select(self, yes: Lanes<R>, no: Lanes<R>) -> Lanes<R> {
        // SAFETY: whoever made the lanes vouched for the instructions.
        Lanes(unsafe { R::select(self.0, yes.0, no.0) })
    }

    /// Number of lanes that are set.
    #[inline(always)]
    pub fn count(self) -> u32 {
        self.bits().count_ones()
    }

    /// A bit for each lane.
    #[inline(always)]
    pub fn bits(self) -> u32 {
        // SAFETY: as above.
        unsafe { R::bits(self.0) }
    }
}

impl<R: Register> BitAnd for Mask<R> {
    type Output = Self;

    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        // SAFETY: whoever made the lanes vouched for the instructions.
        Self(unsafe { R::both(self.0, other.0) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::kernel::{Body, Instructions, Kernel};

    /// Results of every unfused operation on some numbers, as bits.
    struct Everything;

    impl Body for Everything {
        type Output = Vec<u32>;

        fn run<I: Instructions>(self, instructions: I) -> Vec<u32> {
            let lanes = instructions.eight();
            let number = |x: f32| lanes.splat(x);
            let table: Vec<u16> = (0..1000).map(|i| (i * 7919 % 65_536) as u16).collect();
            let bytes: Vec<u8> = table.iter().map(|x| (x % 256) as u8).collect();
            let numbers =
                [0.0, -0.5, 1.0, 3.75, 1023.9, -7.0, 0.1, 998.0, f32::NAN, 2.5, 1e6, -1.0]
                    .into_iter()
                    .chain([-0.0, 3e9, f32::INFINITY, f32::NEG_INFINITY, -0.999, 8_388_609.0]);
            let numbers: Vec<f32> = numbers.collect();
            let starts = 0..=numbers.len() - 8;
            let mut bits = Vec::new();
            for (i, j) in starts.clone().flat_map(|i| starts.clone().map(move |j| (i, j))) {
                let (a, b) = (lanes.load(&numbers[i..]), lanes.load(&numbers[j..]));
                let power = a.abs().max(number(1.0)).power_of_two_below();
                let [left, right] = u16::pairs(&table, a.truncate());
                let Sample { upper_right, lower_left, du, dv, .. } =
                    Lanes::sample(&bytes, 30, a.min(number(20.0)), b);
                let less = b.greater(a).select(left, a.abs().sqrt());
                let both = (a.at_least(b) & a.equal(b)).select(left, right);
                let sums = [a + b, a - b, a * b, a / b, a.floor(), power, left, right, less, both];
                for x in sums.into_iter().chain([upper_right, lower_left, du, dv]) {
                    // NaN payloads are not compared.
                    let x: [f32; 8] = x.to_array();
                    bits.extend(x.map(|x| if x.is_nan() { 0 } else { x.to_bits() }));
                }
                bits.extend([b.greater(a), a.equal(b)].map(Mask::bits));
            }
            bits
        }
    }

    #[test]
    fn eight_lanes_give_the_same_bits_with_every_kernel() {
        let portable = Kernel::Portable.run(Everything);
        assert!(portable.len() > 1000);
        for kernel in Kernel::available() {
            assert_eq!(kernel.run(Everything), portable, "{kernel:?}");
        }
    }
}
