//! The loop over points, for the instructions that the CPU has.
//!
//! `accumulate_kernel` is the algorithm, once, over any `lanes_kernel::Lanes`; the instruction sets are
//! chosen at run time. The portable one is plain arithmetic without fused multiply-add and gives
//! the same bits on every CPU. `residual::accumulate_reference` is the explanation of all.

mod accumulate_kernel;
pub(in crate::slam) mod lanes_kernel;
mod mode_kernel;
#[cfg(target_arch = "aarch64")]
mod neon_kernel;
pub(in crate::slam) mod portable_kernel;
mod scatter_kernel;
#[cfg(target_arch = "x86_64")]
mod x86_kernel;

use crate::slam::alignment::normal_equations::NormalEquations;
use crate::slam::alignment::points::LevelPoints;
use crate::slam::alignment::residual::Evaluation;
use crate::slam::alignment::scatter::GradientScatter;
use crate::slam::image::buffer::Image;
use serde::{Deserialize, Serialize};

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

/// An instruction set that this CPU has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kernel {
    /// Plain arithmetic in four lanes.
    Portable,
    /// AVX2 and FMA, eight lanes.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX-512, sixteen lanes.
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// NEON, four lanes.
    #[cfg(target_arch = "aarch64")]
    Neon,
}

impl Kernel {
    /// Every kernel that this CPU can run, slowest first.
    pub fn available() -> Vec<Self> {
        let mut kernels = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                kernels.push(Self::Avx2);
            }
            if is_x86_feature_detected!("avx512f") {
                kernels.push(Self::Avx512);
            }
        }
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") {
            kernels.push(Self::Neon);
        }
        kernels
    }

    /// The kernel for `mode` on this CPU.
    pub fn choose(mode: SimdMode) -> Self {
        match mode {
            SimdMode::Portable => Self::Portable,
            SimdMode::Auto => Self::available().pop().unwrap_or(Self::Portable),
        }
    }

    /// Sums the normal equations of `points` over `image`, the sums of a pyramid level, whose
    /// size `at` was made for; all zero where it was not.
    pub fn accumulate(
        self,
        points: &LevelPoints,
        image: &Image<u16>,
        at: &Evaluation,
    ) -> NormalEquations {
        if !fits(image, at) {
            return NormalEquations::default();
        }
        match self {
            // SAFETY: plain arithmetic needs no instructions; the bounds were checked above.
            Self::Portable => unsafe { portable_kernel::accumulate_portable(points, image, at) },
            // SAFETY: only `available` makes this value, after it has found AVX2 and FMA; the
            // bounds were checked above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { x86_kernel::accumulate_avx2(points, image, at) },
            // SAFETY: as above with AVX-512F.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { x86_kernel::accumulate_avx512(points, image, at) },
            // SAFETY: as above with NEON.
            #[cfg(target_arch = "aarch64")]
            Self::Neon => unsafe { neon_kernel::accumulate_neon(points, image, at) },
        }
    }

    /// Measures how the gradient of the cost scatters over `image`; nothing where `at` was made
    /// for another size. `GradientScatter::reference` is the explanation.
    pub fn scatter(
        self,
        points: &LevelPoints,
        image: &Image<u16>,
        at: &Evaluation,
    ) -> GradientScatter {
        if !fits(image, at) {
            return GradientScatter::default();
        }
        match self {
            // SAFETY: plain arithmetic needs no instructions; the bounds were checked above.
            Self::Portable => unsafe { portable_kernel::scatter_portable(points, image, at) },
            // SAFETY: only `available` makes this value, after it has found AVX2 and FMA; the
            // bounds were checked above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { x86_kernel::scatter_avx2(points, image, at) },
            // SAFETY: as above with AVX-512F.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { x86_kernel::scatter_avx512(points, image, at) },
            // SAFETY: as above with NEON.
            #[cfg(target_arch = "aarch64")]
            Self::Neon => unsafe { neon_kernel::scatter_neon(points, image, at) },
        }
    }
}

/// What the kernels rely on: a projection below the bound of `at` has a right and a lower neighbour.
fn fits(image: &Image<u16>, at: &Evaluation) -> bool {
    let (right, bottom) = (at.upper_bound[0] as usize, at.upper_bound[1] as usize);
    right < image.width() && bottom < image.height()
}
