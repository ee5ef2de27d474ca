//! The loop over points. `accumulate_kernel` and `scatter_kernel` are the algorithms, each written once for all
//! instructions; `residual::accumulate_reference` is the scalar reference.

mod accumulate_kernel;
mod mode_kernel;
mod scatter_kernel;

use crate::slam::alignment::kernel::accumulate_kernel::Accumulation;
use crate::slam::alignment::kernel::scatter_kernel::Scattering;
use crate::slam::alignment::normal_equations::NormalEquations;
use crate::slam::alignment::points::LevelPoints;
use crate::slam::alignment::residual::Evaluation;
use crate::slam::alignment::scatter::GradientScatter;
use crate::slam::image::buffer::Image;
use crate::slam::kernel::Kernel;

impl Kernel {
    /// Sums the normal equations of `points` over `image`, the sums of a pyramid level, whose size `at` was made for;
    /// all zero if the sizes differ.
    pub fn accumulate(
        self,
        points: &LevelPoints,
        image: &Image<u16>,
        at: &Evaluation,
    ) -> NormalEquations {
        if !fits(image, at) {
            return NormalEquations::default();
        }
        self.run(Accumulation { points, image, at })
    }

    /// Measures the scatter of the gradient of the cost over `image`; empty if `at` was made for another size.
    /// `GradientScatter::reference` is the scalar reference.
    pub fn scatter(
        self,
        points: &LevelPoints,
        image: &Image<u16>,
        at: &Evaluation,
    ) -> GradientScatter {
        if !fits(image, at) {
            return GradientScatter::default();
        }
        self.run(Scattering { points, image, at })
    }
}

/// Whether a projection below the bound of `at` has a right and a lower neighbour.
fn fits(image: &Image<u16>, at: &Evaluation) -> bool {
    let (right, bottom) = (at.upper_bound[0] as usize, at.upper_bound[1] as usize);
    right < image.width() && bottom < image.height()
}
