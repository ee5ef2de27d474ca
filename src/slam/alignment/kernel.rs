//! The loop over points, for the instructions that the CPU has.
//!
//! `accumulate_kernel` is the algorithm, once, over any `lanes_kernel::Lanes`; the instruction sets are
//! chosen at run time. The portable one is plain arithmetic without fused multiply-add and gives
//! the same bits on every CPU. `residual::accumulate_reference` is the explanation of all.

mod accumulate_kernel;
mod lanes_kernel;
mod portable_kernel;
#[cfg(target_arch = "x86_64")]
mod x86_kernel;

use crate::slam::alignment::normal_equations::NormalEquations;
use crate::slam::alignment::points::LevelPoints;
use crate::slam::alignment::residual::Evaluation;
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
        let (right, bottom) = (at.upper_bound[0] as usize, at.upper_bound[1] as usize);
        // What the kernels rely on: a projection below the bound has a right and a lower neighbour.
        if right >= image.width() || bottom >= image.height() {
            return NormalEquations::default();
        }
        match self {
            // SAFETY: plain arithmetic needs no instructions; the bounds were checked above.
            Self::Portable => unsafe {
                accumulate_kernel::accumulate::<portable_kernel::FourLanes>(points, image, at)
            },
            // SAFETY: only `available` makes this value, after it has found AVX2 and FMA; the
            // bounds were checked above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { x86_kernel::accumulate_avx2(points, image, at) },
            // SAFETY: as above with AVX-512F.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { x86_kernel::accumulate_avx512(points, image, at) },
        }
    }
}
