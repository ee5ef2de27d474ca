//! Eight numbers at a time, in the vector registers that the processor has.
//!
//! No operation is fused or reordered, so all versions give the same bits.

use std::array::from_fn;
use std::ops::{Add, Div, Mul, Sub};

/// How many numbers are computed together.
pub const LANES: usize = 8;
/// A bit for each lane.
pub const ALL_LANES: u32 = (1 << LANES) - 1;

/// Arithmetic on [`LANES`] numbers.
pub trait Lanes: Copy {
    /// The numbers.
    type F: Copy
        + Add<Output = Self::F>
        + Sub<Output = Self::F>
        + Mul<Output = Self::F>
        + Div<Output = Self::F>;

    /// The same number in all lanes.
    fn splat(self, x: f32) -> Self::F;
    /// The first [`LANES`] numbers of a slice; panics on a shorter one.
    fn load(self, from: &[f32]) -> Self::F;
    /// All numbers.
    fn store(self, x: Self::F) -> [f32; LANES];
    /// The larger one; `b` where `a` is NaN.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// The smaller one; `b` where `a` is NaN.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// Without the sign.
    fn abs(self, x: Self::F) -> Self::F;
    /// Square root.
    fn sqrt(self, x: Self::F) -> Self::F;
    /// The whole number below; of numbers that fit an `i32`.
    fn floor(self, x: Self::F) -> Self::F;
    /// The power of two below a number of at least 1.
    fn power_of_two_below(self, x: Self::F) -> Self::F;
    /// `yes` where `a < b`, else `no`.
    fn if_less(self, a: Self::F, b: Self::F, yes: Self::F, no: Self::F) -> Self::F;
    /// `yes` where `a` and `b` are equal, else `no`.
    fn if_equal(self, a: Self::F, b: Self::F, yes: Self::F, no: Self::F) -> Self::F;
    /// A bit for each lane in which `a < b`.
    fn less_bits(self, a: Self::F, b: Self::F) -> u32;
    /// A bit for each lane in which both are equal.
    fn equal_bits(self, a: Self::F, b: Self::F) -> u32;
    /// The entries of a table at some places, and those right after them. Places outside the table give any entry.
    /// The table has at least two.
    fn pairs(self, table: &[u16], at: Self::F) -> [Self::F; 2];
}

/// A computation on lanes.
pub trait LaneWork {
    /// Its result.
    type Output;
    /// Computes it. All that does arithmetic must be inlined, closures too: what is not is compiled for processors
    /// without AVX2, and slow.
    fn run<L: Lanes>(self, lanes: L) -> Self::Output;
}

#[cfg(test)]
thread_local! {
    /// Whether this thread computes as on a processor without vector registers.
    pub static IS_PORTABLE: std::cell::Cell<bool> = const { std::cell::Cell::new(false) };
}

/// Computes with the best lanes that this processor has.
pub fn with_lanes<W: LaneWork>(work: W) -> W::Output {
    #[cfg(test)]
    if IS_PORTABLE.get() {
        return work.run(Portable);
    }
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2, as was just asked.
        return unsafe { with_avx2(work) };
    }
    work.run(Portable)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn with_avx2<W: LaneWork>(work: W) -> W::Output {
    // SAFETY: the processor has AVX2, without which this function is not called.
    work.run(unsafe { Avx2::new() })
}

/// Plain Rust for every processor: the reference for the others.
#[derive(Debug, Clone, Copy)]
pub struct Portable;

/// Lanes of [`Portable`].
#[derive(Debug, Clone, Copy)]
pub struct Eight([f32; LANES]);

macro_rules! lane_by_lane {
    ($($of:ident :: $name:ident),*) => {$(
        impl $of for Eight {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self(from_fn(|i| self.0[i].$name(other.0[i])))
            }
        }
    )*};
}

lane_by_lane!(Add::add, Sub::sub, Mul::mul, Div::div);

impl Lanes for Portable {
    type F = Eight;

    #[inline(always)]
    fn splat(self, x: f32) -> Eight {
        Eight([x; LANES])
    }

    #[inline(always)]
    fn load(self, from: &[f32]) -> Eight {
        Eight(from_fn(|i| from[i]))
    }

    #[inline(always)]
    fn store(self, x: Eight) -> [f32; LANES] {
        x.0
    }

    #[inline(always)]
    fn max(self, a: Eight, b: Eight) -> Eight {
        Eight(from_fn(|i| if a.0[i] > b.0[i] { a.0[i] } else { b.0[i] }))
    }

    #[inline(always)]
    fn min(self, a: Eight, b: Eight) -> Eight {
        Eight(from_fn(|i| if a.0[i] < b.0[i] { a.0[i] } else { b.0[i] }))
    }

    #[inline(always)]
    fn abs(self, x: Eight) -> Eight {
        Eight(x.0.map(f32::abs))
    }

    #[inline(always)]
    fn sqrt(self, x: Eight) -> Eight {
        Eight(x.0.map(f32::sqrt))
    }

    /// Without the call that the baseline instruction set needs for it.
    #[inline(always)]
    fn floor(self, x: Eight) -> Eight {
        /// From here on all numbers are whole.
        const WHOLE: f32 = 8_388_608.0;
        Eight(x.0.map(|x| {
            // NaN stays too.
            if !(x.abs() < WHOLE) {
                return x;
            }
            let towards_zero = x as i32 as f32;
            let below = if towards_zero > x { towards_zero - 1.0 } else { towards_zero };
            below.copysign(x)
        }))
    }

    #[inline(always)]
    fn power_of_two_below(self, x: Eight) -> Eight {
        Eight(x.0.map(|x| f32::from_bits(x.to_bits() & EXPONENT)))
    }

    #[inline(always)]
    fn if_less(self, a: Eight, b: Eight, yes: Eight, no: Eight) -> Eight {
        Eight(from_fn(|i| if a.0[i] < b.0[i] { yes.0[i] } else { no.0[i] }))
    }

    #[inline(always)]
    fn if_equal(self, a: Eight, b: Eight, yes: Eight, no: Eight) -> Eight {
        Eight(from_fn(|i| if a.0[i] == b.0[i] { yes.0[i] } else { no.0[i] }))
    }

    #[inline(always)]
    fn less_bits(self, a: Eight, b: Eight) -> u32 {
        (0..LANES).fold(0, |bits, i| bits | u32::from(a.0[i] < b.0[i]) << i)
    }

    #[inline(always)]
    fn equal_bits(self, a: Eight, b: Eight) -> u32 {
        (0..LANES).fold(0, |bits, i| bits | u32::from(a.0[i] == b.0[i]) << i)
    }

    #[inline(always)]
    fn pairs(self, table: &[u16], at: Eight) -> [Eight; 2] {
        let last = table.len() - 2;
        let mut pairs = [[0.0; LANES]; 2];
        for (i, &at) in at.0.iter().enumerate() {
            let at = if at > -1.0 { (at as usize).min(last) } else { last };
            pairs[0][i] = f32::from(table[at]);
            pairs[1][i] = f32::from(table[at + 1]);
        }
        pairs.map(Eight)
    }
}

/// The bits of a number's exponent.
const EXPONENT: u32 = 0x7F80_0000;

#[cfg(target_arch = "x86_64")]
pub use avx2::Avx2;

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;
    use std::ops::{Add, Div, Mul, Sub};

    use super::{EXPONENT, LANES, Lanes};

    /// Eight lanes of AVX2.
    #[derive(Debug, Clone, Copy)]
    pub struct Avx2(());

    impl Avx2 {
        /// # Safety
        /// The processor has AVX2.
        #[inline(always)]
        pub unsafe fn new() -> Self {
            Self(())
        }
    }

    /// Lanes of [`Avx2`], which alone makes them.
    #[derive(Debug, Clone, Copy)]
    pub struct Register(__m256);

    macro_rules! lane_by_lane {
        ($($of:ident :: $name:ident = $instruction:ident),*) => {$(
            impl $of for Register {
                type Output = Self;

                #[inline(always)]
                fn $name(self, other: Self) -> Self {
                    // SAFETY: whoever made the lanes vouched for AVX2.
                    Self(unsafe { $instruction(self.0, other.0) })
                }
            }
        )*};
    }

    lane_by_lane!(
        Add::add = _mm256_add_ps,
        Sub::sub = _mm256_sub_ps,
        Mul::mul = _mm256_mul_ps,
        Div::div = _mm256_div_ps
    );

    // Whoever made an `Avx2` vouched for what these instructions need.
    impl Lanes for Avx2 {
        type F = Register;

        #[inline(always)]
        fn splat(self, x: f32) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe { _mm256_set1_ps(x) })
        }

        #[inline(always)]
        fn load(self, from: &[f32]) -> Register {
            let from = &from[..LANES];
            // SAFETY: the processor has AVX2; the slice has eight numbers.
            Register(unsafe { _mm256_loadu_ps(from.as_ptr()) })
        }

        #[inline(always)]
        fn store(self, x: Register) -> [f32; LANES] {
            let mut to = [0.0; LANES];
            // SAFETY: the processor has AVX2; the array has eight numbers.
            unsafe { _mm256_storeu_ps(to.as_mut_ptr(), x.0) };
            to
        }

        #[inline(always)]
        fn max(self, a: Register, b: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe { _mm256_max_ps(a.0, b.0) })
        }

        #[inline(always)]
        fn min(self, a: Register, b: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe { _mm256_min_ps(a.0, b.0) })
        }

        #[inline(always)]
        fn abs(self, x: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), x.0) })
        }

        #[inline(always)]
        fn sqrt(self, x: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe { _mm256_sqrt_ps(x.0) })
        }

        #[inline(always)]
        fn floor(self, x: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe { _mm256_floor_ps(x.0) })
        }

        #[inline(always)]
        fn power_of_two_below(self, x: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe { _mm256_and_ps(x.0, _mm256_set1_ps(f32::from_bits(EXPONENT))) })
        }

        #[inline(always)]
        fn if_less(self, a: Register, b: Register, yes: Register, no: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe {
                _mm256_blendv_ps(no.0, yes.0, _mm256_cmp_ps::<_CMP_LT_OQ>(a.0, b.0))
            })
        }

        #[inline(always)]
        fn if_equal(self, a: Register, b: Register, yes: Register, no: Register) -> Register {
            // SAFETY: the processor has AVX2.
            Register(unsafe {
                _mm256_blendv_ps(no.0, yes.0, _mm256_cmp_ps::<_CMP_EQ_OQ>(a.0, b.0))
            })
        }

        #[inline(always)]
        fn less_bits(self, a: Register, b: Register) -> u32 {
            // SAFETY: the processor has AVX2.
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(a.0, b.0)) as u32 }
        }

        #[inline(always)]
        fn equal_bits(self, a: Register, b: Register) -> u32 {
            // SAFETY: the processor has AVX2.
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_EQ_OQ>(a.0, b.0)) as u32 }
        }

        #[inline(always)]
        fn pairs(self, table: &[u16], at: Register) -> [Register; 2] {
            assert!((2..=1 << 31).contains(&table.len()), "size of the table");
            let last = (table.len() - 2) as i32;
            // SAFETY: the processor has AVX2. Every place, unsigned, is at most the last but one of the table, which
            // an i32 holds, and four bytes are read there.
            unsafe {
                let at = _mm256_min_epu32(_mm256_cvttps_epi32(at.0), _mm256_set1_epi32(last));
                let pairs = _mm256_i32gather_epi32::<2>(table.as_ptr().cast(), at);
                let low = _mm256_and_si256(pairs, _mm256_set1_epi32(0xFFFF));
                let high = _mm256_srli_epi32::<16>(pairs);
                [low, high].map(|half| Register(_mm256_cvtepi32_ps(half)))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation on some numbers, as bits.
    struct Everything;

    impl LaneWork for Everything {
        type Output = Vec<u32>;

        fn run<L: Lanes>(self, lanes: L) -> Vec<u32> {
            let number = |x: f32| lanes.splat(x);
            let table: Vec<u16> = (0..1000).map(|i| (i * 7919 % 65_536) as u16).collect();
            let numbers =
                [0.0, -0.5, 1.0, 3.75, 1023.9, -7.0, 0.1, 998.0, f32::NAN, 2.5, 1e6, -1.0]
                    .into_iter()
                    .chain([-0.0, 3e9, f32::INFINITY, f32::NEG_INFINITY, -0.999, 8_388_609.0]);
            let numbers: Vec<f32> = numbers.collect();
            let starts = 0..=numbers.len() - LANES;
            let mut bits = Vec::new();
            for (i, j) in starts.clone().flat_map(|i| starts.clone().map(move |j| (i, j))) {
                let (a, b) = (lanes.load(&numbers[i..]), lanes.load(&numbers[j..]));
                let (sum, size) = (a + b, lanes.abs(a));
                let whole = lanes.floor(a);
                let power = lanes.power_of_two_below(lanes.max(size, number(1.0)));
                let [left, right] = lanes.pairs(&table, a);
                let less = lanes.if_less(a, b, left, lanes.sqrt(size));
                let equal = lanes.if_equal(a, b, left, right);
                for x in [sum, a - b, a * b, a / b, whole, power, left, right, less, equal] {
                    // One NaN is as good as another.
                    bits.extend(lanes.store(x).map(|x| if x.is_nan() { 0 } else { x.to_bits() }));
                }
                bits.extend([lanes.less_bits(a, b), lanes.equal_bits(a, b)]);
            }
            bits
        }
    }

    #[test]
    fn all_lanes_give_the_same_bits() {
        let portable = Everything.run(Portable);
        assert!(portable.len() > 1000);
        assert_eq!(portable, with_lanes(Everything));
    }
}
