//! Vector instruction sets: the only module that queries the CPU for them.
//!
//! A loop is a `Body` with a single source, compiled for every instruction set and run with one that the CPU supports.
//! The portable version is plain arithmetic without fused multiply-add and gives the same bits on every CPU.

pub(crate) mod lanes_kernel;
#[cfg(target_arch = "aarch64")]
mod neon_kernel;
mod portable_kernel;
#[cfg(target_arch = "x86_64")]
mod x86_kernel;

use serde::{Deserialize, Serialize};

use crate::slam::kernel::lanes_kernel::{Lanes, Register};

/// The instructions that the loops over points use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SimdMode {
    /// The fastest that the CPU supports; the last digits of results depend on it.
    #[default]
    Auto,
    /// Plain arithmetic: the same bits on every CPU.
    Portable,
}

/// An instruction set that this CPU supports: the vector variants come only from [`Kernel::available`] and the like.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kernel {
    /// Plain arithmetic in four lanes.
    Portable,
    /// AVX2 and FMA, eight lanes.
    #[cfg(target_arch = "x86_64")]
    #[non_exhaustive]
    Avx2,
    /// AVX-512, sixteen lanes.
    #[cfg(target_arch = "x86_64")]
    #[non_exhaustive]
    Avx512,
    /// NEON, four lanes.
    #[cfg(target_arch = "aarch64")]
    #[non_exhaustive]
    Neon,
}

impl Kernel {
    /// Slowest first.
    #[cfg(target_arch = "x86_64")]
    const ALL: &[Self] = &[Self::Portable, Self::Avx2, Self::Avx512];
    /// Slowest first.
    #[cfg(target_arch = "aarch64")]
    const ALL: &[Self] = &[Self::Portable, Self::Neon];
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    const ALL: &[Self] = &[Self::Portable];

    /// Every kernel that this CPU can run, slowest first.
    pub fn available() -> Vec<Self> {
        Self::ALL.iter().copied().filter(|kernel| kernel.is_available()).collect()
    }

    /// The fastest kernel that this CPU can run.
    pub fn fastest() -> Self {
        let fastest = Self::ALL.iter().rev().find(|kernel| kernel.is_available());
        fastest.copied().unwrap_or(Self::Portable)
    }

    /// The kernel for `mode` on this CPU.
    pub fn choose(mode: SimdMode) -> Self {
        match mode {
            SimdMode::Portable => Self::Portable,
            SimdMode::Auto => Self::fastest(),
        }
    }

    fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
            }
            #[cfg(target_arch = "aarch64")]
            Self::Neon => std::arch::is_aarch64_feature_detected!("neon"),
        }
    }

    /// Runs a loop with these instructions.
    pub(crate) fn run<B: Body>(self, body: B) -> B::Output {
        match self {
            Self::Portable => body.run(Portable),
            // SAFETY: only `available` and `fastest` make this value, after they have found AVX2 and FMA.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { run_avx2(body) },
            // SAFETY: as above with AVX-512.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { run_avx512(body) },
            // SAFETY: as above with NEON.
            #[cfg(target_arch = "aarch64")]
            Self::Neon => unsafe { run_neon(body) },
        }
    }

    /// Runs a loop with these instructions in eight lanes. AVX-512 is not used: its comparisons go through mask
    /// registers and are slower at this width.
    #[cfg(feature = "cameras")]
    pub(crate) fn run_eight<B: Body>(self, body: B) -> B::Output {
        match self {
            // SAFETY: as above; a CPU with AVX-512 has AVX2 and FMA.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 | Self::Avx512 => unsafe { run_avx2(body) },
            _ => body.run(PortableEight),
        }
    }
}

/// A loop, compiled for each instruction set.
pub(crate) trait Body {
    /// The result of the loop.
    type Output;
    /// Runs the loop. All arithmetic must be inlined, closures too: otherwise it is compiled for every CPU, and slow.
    fn run<I: Instructions>(self, instructions: I) -> Self::Output;
}

/// An instruction set; a value of it proves that the CPU supports it.
///
/// # Safety
/// A value may be made only where the CPU is known to support the instructions behind `Register` and the constants.
pub unsafe trait Instructions: Copy {
    /// Its registers of f32.
    type Register: Register;
    /// Number of their lanes.
    const N: usize = Self::Register::N;
    /// Whether AVX2 is included.
    const HAS_AVX2: bool = false;
    /// The same CPU with registers of eight lanes.
    type Eight: Instructions;

    /// The instructions for loops whose results depend on the number of lanes.
    fn eight(self) -> Self::Eight;

    /// Broadcasts a number to all lanes.
    #[inline(always)]
    fn splat(self, value: f32) -> Lanes<Self::Register> {
        // SAFETY: a value of the instructions proves that the CPU has them.
        Lanes(unsafe { Self::Register::splat(value) })
    }

    /// Loads the first numbers of a slice; panics if there are fewer than lanes.
    #[inline(always)]
    fn load(self, from: &[f32]) -> Lanes<Self::Register> {
        let from = &from[..Self::N];
        // SAFETY: as above; there are N numbers.
        Lanes(unsafe { Self::Register::load(from.as_ptr()) })
    }
}

/// A register of f32 of these instructions.
pub type Floats<I> = Lanes<<I as Instructions>::Register>;

/// Plain arithmetic, the reference for the others.
#[derive(Debug, Clone, Copy)]
pub struct Portable;

/// Plain arithmetic in eight lanes.
#[derive(Debug, Clone, Copy)]
pub struct PortableEight;

macro_rules! portable {
    ($name:ident, $lanes:literal) => {
        // SAFETY: every CPU has them.
        unsafe impl Instructions for $name {
            type Register = portable_kernel::Numbers<$lanes>;
            type Eight = PortableEight;

            #[inline(always)]
            fn eight(self) -> PortableEight {
                PortableEight
            }
        }
    };
}

portable!(Portable, 4);
portable!(PortableEight, 8);

/// Defines instructions beyond the baseline: their type, and the only function that compiles a body for them.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! instructions {
    ($name:ident, $run:ident, $features:literal, $register:ty, $has_avx2:literal, $Eight:ty = $eight:expr) => {
        #[derive(Clone, Copy)]
        struct $name(());

        // SAFETY: only the function below, and instructions that include these, make a value.
        unsafe impl Instructions for $name {
            type Register = $register;
            const HAS_AVX2: bool = $has_avx2;
            type Eight = $Eight;

            #[inline(always)]
            fn eight(self) -> $Eight {
                $eight
            }
        }

        #[target_feature(enable = $features)]
        fn $run<B: Body>(body: B) -> B::Output {
            body.run($name(()))
        }
    };
}

#[cfg(target_arch = "x86_64")]
instructions!(Avx2, run_avx2, "avx2,fma", std::arch::x86_64::__m256, true, Avx2 = Avx2(()));
#[cfg(target_arch = "x86_64")]
instructions!(
    Avx512,
    run_avx512,
    "avx512f,avx512vl,avx512bw,avx512dq",
    std::arch::x86_64::__m512,
    true,
    Avx2 = Avx2(())
);
#[cfg(target_arch = "aarch64")]
instructions!(
    Neon,
    run_neon,
    "neon",
    std::arch::aarch64::float32x4_t,
    false,
    PortableEight = PortableEight
);
