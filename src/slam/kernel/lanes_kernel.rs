//! What the loop over points asks of an instruction set.

/// Neighbouring pixels of one projection, as sums of the pyramid, and where it lies between them.
#[derive(Clone, Copy)]
pub struct Sample<L> {
    pub upper_left: L,
    pub upper_right: L,
    pub lower_left: L,
    pub lower_right: L,
    pub du: L,
    pub dv: L,
}

/// Some f32 in one register.
///
/// # Safety
/// Callers make sure that the CPU has the instructions, and give pointers to `N` floats.
pub trait Lanes: Copy {
    /// Number of lanes; divides the sixteen of a block.
    const N: usize;
    /// A truth value for each lane.
    type Mask: Copy;

    unsafe fn splat(value: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    unsafe fn store(self, to: *mut f32);
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn sub(self, other: Self) -> Self;
    unsafe fn mul(self, other: Self) -> Self;
    unsafe fn div(self, other: Self) -> Self;
    unsafe fn sqrt(self) -> Self;
    unsafe fn min(self, other: Self) -> Self;
    unsafe fn max(self, other: Self) -> Self;
    /// `self * factor + summand`.
    unsafe fn mul_add(self, factor: Self, summand: Self) -> Self;
    unsafe fn greater(self, other: Self) -> Self::Mask;
    unsafe fn at_least(self, other: Self) -> Self::Mask;
    unsafe fn both(one: Self::Mask, other: Self::Mask) -> Self::Mask;
    /// `yes` where the mask is set, `no` elsewhere.
    unsafe fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    unsafe fn count(mask: Self::Mask) -> u32;
    /// The four pixels around (u, v) in rows of `stride`; all lie within `image`.
    unsafe fn sample(image: &[u16], stride: usize, u: Self, v: Self) -> Sample<Self>;
    /// The same of bytes, at least `stride` + 4 of them; some pixels where (u, v) is not between the first column and
    /// row and the last but two.
    unsafe fn sample_bytes(image: &[u8], stride: usize, u: Self, v: Self) -> Sample<Self>;
}

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

pub(super) use intrinsics;
