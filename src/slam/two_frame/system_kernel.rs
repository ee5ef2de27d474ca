//! The evaluation of all points, compiled for the vector units that the processor has.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::two_frame::system::{LevelView, State, System};

/// A version of [`System::evaluate_points`].
pub(super) type EvaluationKernel = fn(&mut System, &LevelView<'_>, &State);

/// The best version for this processor.
pub(super) fn evaluation_kernel() -> EvaluationKernel {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return |system, level, state| {
            // SAFETY: the processor has AVX2, as was just asked.
            unsafe { evaluate_avx2(system, level, state) }
        };
    }
    System::evaluate_points
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn evaluate_avx2(system: &mut System, level: &LevelView<'_>, state: &State) {
    system.evaluate_points(level, state);
}
