//! λ of the alignment's Levenberg–Marquardt: zero at first, because Gauss–Newton mostly converges.

/// λ after the first failure, and the bound below which a success sets it to zero.
const FIRST_DAMPING: f64 = 0.2;

/// Failures in a row after which a level counts as converged: λ has grown by 2¹⁵ by then.
const MAX_FAILURES: u32 = 5;

/// λ and the number of failures in a row.
#[derive(Default)]
pub(super) struct Damping {
    pub(super) lambda: f64,
    failures: u32,
}

impl Damping {
    /// Records an accepted step.
    pub(super) fn succeed(&mut self) {
        self.lambda = if self.lambda <= FIRST_DAMPING { 0.0 } else { 0.5 * self.lambda };
        self.failures = 0;
    }

    /// Records a rejected or missing step; returns whether to give up the level.
    pub(super) fn fail(&mut self) -> bool {
        self.failures += 1;
        let growth = f64::from(1u32 << self.failures.min(20));
        self.lambda = if self.lambda == 0.0 { FIRST_DAMPING } else { self.lambda * growth };
        self.failures > MAX_FAILURES
    }
}
