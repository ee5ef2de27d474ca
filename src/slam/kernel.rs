//! The vector instructions that a loop is compiled for: the one place that asks the CPU for them.
//!
//! A loop is a `Body`, one source; it is compiled for every instruction set and run with one that the CPU has. The
//! portable one is plain arithmetic without fused multiply-add and gives the same bits on every CPU.

pub(in crate::slam) mod lanes_kernel;
#[cfg(target_arch = "aarch64")]
mod neon_kernel;
mod portable_kernel;
#[cfg(target_arch = "x86_64")]
mod x86_kernel;

use serde::{Deserialize, Serialize};

use crate::slam::kernel::lanes_kernel::Lanes;

/// Which instructions the loops over points use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SimdMode {
    /// The fastest that the CPU has; the last digits of results depend on it.
    #[default]
    Auto,
    /// Plain arithmetic: the same bits on every CPU.
    Portable,
}

/// An instruction set that this CPU has: only [`Kernel::available`] and the like make the vector ones.
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
    pub(in crate::slam) fn run<B: Body>(self, body: B) -> B::Output {
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
}

/// What a loop does.
pub(in crate::slam) trait Body {
    /// Its result.
    type Output;
    /// Runs it. All that does arithmetic must be inlined, closures too: what is not is compiled for every CPU, and slow.
    fn run<I: Instructions>(self, instructions: I) -> Self::Output;
}

/// An instruction set; a value of it says that the CPU has it.
///
/// # Safety
/// Only who knows that the CPU has what `Lanes` and the constants stand for can make a value.
pub unsafe trait Instructions: Copy {
    /// Its registers of f32.
    type Lanes: Lanes;
    /// AVX2 is among them.
    const HAS_AVX2: bool = false;
}

/// Plain arithmetic, the explanation of the others.
#[derive(Debug, Clone, Copy)]
pub struct Portable;

// SAFETY: every CPU has them.
unsafe impl Instructions for Portable {
    type Lanes = portable_kernel::FourLanes;
}

/// Instructions beyond those that every CPU has: their type, and the one place that compiles a body for them.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! instructions {
    ($name:ident, $run:ident, $features:literal, $lanes:ty, $has_avx2:literal) => {
        #[derive(Clone, Copy)]
        struct $name(());

        // SAFETY: only the function below makes a value.
        unsafe impl Instructions for $name {
            type Lanes = $lanes;
            const HAS_AVX2: bool = $has_avx2;
        }

        #[target_feature(enable = $features)]
        fn $run<B: Body>(body: B) -> B::Output {
            body.run($name(()))
        }
    };
}

#[cfg(target_arch = "x86_64")]
instructions!(Avx2, run_avx2, "avx2,fma", std::arch::x86_64::__m256, true);
#[cfg(target_arch = "x86_64")]
instructions!(
    Avx512,
    run_avx512,
    "avx512f,avx512vl,avx512bw,avx512dq",
    std::arch::x86_64::__m512,
    true
);
#[cfg(target_arch = "aarch64")]
instructions!(Neon, run_neon, "neon", std::arch::aarch64::float32x4_t, false);
