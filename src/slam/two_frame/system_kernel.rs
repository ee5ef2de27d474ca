//! Loops over all points, compiled for the vector units of the processor.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::kernel::{Body, Instructions, Kernel};
use crate::slam::two_frame::elimination::{Elimination, neighbour_medians};
use crate::slam::two_frame::points::NeighbourBlock;
use crate::slam::two_frame::state::State;
use crate::slam::two_frame::system::{LevelView, System};

impl System {
    /// Evaluates every point at `state`. Sums are in the order of the points.
    pub fn evaluate(&mut self, level: &LevelView<'_>, state: &State) {
        Kernel::fastest().run(Evaluation { system: self, level, state });
    }
}

/// [`System::evaluate_blocks`].
pub(super) struct Evaluation<'a> {
    pub system: &'a mut System,
    pub level: &'a LevelView<'a>,
    pub state: &'a State,
}

impl Body for Evaluation<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) {
        self.system.evaluate_blocks(instructions, self.level, self.state);
    }
}

/// [`Elimination::reduce`].
pub(super) struct Reduction<'a> {
    pub elimination: &'a mut Elimination,
    pub system: &'a System,
    pub inverse_depths: &'a [f32],
    pub medians: &'a [f32],
}

impl Body for Reduction<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        self.elimination.reduce(self.system, self.inverse_depths, self.medians);
    }
}

/// [`neighbour_medians`].
pub(super) struct Medians<'a> {
    pub neighbours: &'a [NeighbourBlock],
    pub inverse_depths: &'a [f32],
    pub medians: &'a mut Vec<f32>,
}

impl Body for Medians<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        neighbour_medians(self.neighbours, self.inverse_depths, self.medians);
    }
}
