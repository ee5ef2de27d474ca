//! The search for a patch along a line of a frame: 1-px steps, then Gauss–Newton. Both filters search this way.

use crate::slam::depth::patch_kernel::{huber, slope, sums};
use crate::slam::depth::pattern::{PATTERN, sum_of_samples};
use crate::slam::image::quads_kernel::{Sampled, Sampler};
use crate::slam::kernel::Instructions;

/// Maximum number of positions in one search: bounds the time per pixel.
pub const MAX_STEPS: usize = 100;
/// Costs that are compared at once.
const LANES: usize = 8;
/// Room for the costs, including those that belong to the minimum at the last one.
const MAX_COSTS: usize = (MAX_STEPS + 2).next_multiple_of(LANES);

/// The patch as a function of its position λ along the line, pixels from λ = 0.
pub(super) struct Along<'a, S> {
    pub(super) frame: Sampled<'a, S>,
    /// Brightness of the patch as it would appear in the frame.
    pub(super) intensity: &'a [f32; 8],
    /// Unit vector towards larger inverse depth.
    pub(super) direction: (f32, f32),
    /// Position of each sample at λ = 0.
    pub(super) u: [f32; 8],
    pub(super) v: [f32; 8],
}

/// The best of several positions.
pub(super) struct Best {
    pub(super) lambda: f32,
    /// Samples of the frame there, kept for the refinement.
    pub(super) seen: [f32; 8],
    /// Σ ρ(residual) there, Huber's ρ.
    pub(super) cost: f32,
    /// The least cost outside the same minimum.
    pub(super) second: f32,
}

impl<S: Instructions> Along<'_, S> {
    /// The position λ alone.
    #[inline(always)]
    pub(super) fn evaluate_at(&self, lambda: f32) -> Best {
        let seen = self.sample_at(lambda);
        Best { lambda, seen, cost: self.cost(&seen), second: f32::INFINITY }
    }

    /// The best of `first` and the `steps` positions after it, a pixel apart; at most [`MAX_STEPS`] in all.
    #[inline(always)]
    pub(super) fn scan(&self, first: f32, steps: usize) -> Best {
        /// Steps this close to the minimum belong to it.
        const SAME_MINIMUM_STEPS: usize = 2;
        let mut costs = [f32::INFINITY; MAX_COSTS];
        for (begin, costs) in (0..=steps).step_by(LANES).zip(costs.chunks_exact_mut(LANES)) {
            let mut terms = [[f32::INFINITY; 8]; LANES];
            for (step, terms) in (begin..=steps).zip(&mut terms) {
                *terms = self.terms(&self.sample_at(first + step as f32));
            }
            costs.copy_from_slice(&sums(self.frame.sampler, &terms));
        }
        // The minimum is searched afterwards: along the way a new minimum is an unpredictable branch.
        let padded = (steps + 1).next_multiple_of(LANES);
        let least = minimum(&costs[..padded]);
        let best = costs[..=steps].iter().position(|&cost| cost == least).unwrap_or(0);
        let lambda = first + best as f32;
        let cost = costs[best];
        costs[best.saturating_sub(SAME_MINIMUM_STEPS)..=best + SAME_MINIMUM_STEPS]
            .fill(f32::INFINITY);
        Best { lambda, seen: self.sample_at(lambda), cost, second: self::minimum(&costs[..padded]) }
    }

    /// Gauss–Newton along the line from `best` with clamped steps until the cost stops falling: the final position and
    /// its cost. `gradients_at` gives the gradients along the line by sample, grey levels per pixel.
    #[inline(always)]
    pub(super) fn refine(
        &self,
        best: &Best,
        gradients_at: impl Fn(f32) -> [f32; 8],
        reach: f32,
    ) -> (f32, f32) {
        const MAX_ITERATIONS: usize = 4;
        const MAX_STEP_PX: f32 = 0.75;
        /// Avoids division by zero for a patch without gradient, grey levels².
        const MIN_INFORMATION: f32 = 1e-6;
        /// Step below which further ones change the depth less than sampling noise.
        const CONVERGED_PX: f32 = 0.03;
        let start = best.lambda;
        let (mut lambda, mut cost, mut seen) = (start, best.cost, best.seen);
        for _ in 0..MAX_ITERATIONS {
            let [gradient, information] =
                slope(self.frame.sampler, &seen, self.intensity, &gradients_at(lambda));
            let step = -gradient / (information + MIN_INFORMATION);
            let next = (lambda + step.clamp(-MAX_STEP_PX, MAX_STEP_PX))
                .clamp(start - reach, start + reach);
            let moved = (next - lambda).abs();
            let there = self.sample_at(next);
            let cost_there = self.cost(&there);
            if !(cost_there < cost) {
                break;
            }
            (lambda, cost, seen) = (next, cost_there, there);
            if moved < CONVERGED_PX {
                break;
            }
        }
        (lambda, cost)
    }

    /// Gradients of the frame along the line under the patch, grey levels per pixel.
    #[inline(always)]
    pub(super) fn gradients(&self, lambda: f32) -> [f32; 8] {
        let (ahead, behind) = (self.sample_at(lambda + 1.0), self.sample_at(lambda - 1.0));
        let mut gradients = [0.0; 8];
        for k in 0..PATTERN.len() {
            gradients[k] = 0.5 * (ahead[k] - behind[k]);
        }
        gradients
    }

    /// Whether the frame has no data under the patch at λ, in whole or in part.
    #[inline(always)]
    pub(super) fn is_hidden(&self, lambda: f32) -> bool {
        self.frame.image.has_hidden() && self.sample_at(lambda).contains(&0.0)
    }

    /// Samples of the frame under the patch.
    #[inline(always)]
    fn sample_at(&self, lambda: f32) -> [f32; 8] {
        let (du, dv) = (lambda * self.direction.0, lambda * self.direction.1);
        let Sampled { image, sampler } = self.frame;
        sampler.sample(image, &self.u.map(|u| u + du), &self.v.map(|v| v + dv))
    }

    #[inline(always)]
    fn cost(&self, samples: &[f32; 8]) -> f32 {
        sum_of_samples(&self.terms(samples))
    }

    #[inline(always)]
    fn terms(&self, samples: &[f32; 8]) -> [f32; 8] {
        huber(self.frame.sampler, samples, self.intensity)
    }
}

/// The least of several costs, in whole registers; infinite if all are NaN.
#[inline(always)]
fn minimum(costs: &[f32]) -> f32 {
    let lower = |one: f32, other: f32| if other < one { other } else { one };
    let mut least = [f32::INFINITY; LANES];
    for costs in costs.chunks_exact(LANES) {
        for (least, &cost) in least.iter_mut().zip(costs) {
            *least = lower(*least, cost);
        }
    }
    least.into_iter().fold(f32::INFINITY, lower)
}
