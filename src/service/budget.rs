//! The time budget of a frame: decides before each iteration whether it still fits.

use crate::service::clock::now_nanos;

/// Levels whose cost is kept; no pyramid is deeper.
const MAX_LEVELS: usize = 16;
/// Cap on one measurement, as a multiple of the running mean.
const LARGEST_RISE: f64 = 4.0;
/// Share of all costs kept when they forbid an iteration: a wrong cost is forgotten within a second.
const KEPT_AT_REFUSAL: f64 = 0.9;
/// Cost of ending a frame that is cut short, in iterations of the finest level: up to three evaluations there to choose
/// among the candidates, each compared, and one for the covariance.
const RESERVED_LOOKS: f64 = 11.0;
/// Weight of a new measurement in the running mean: it follows a change of load within a few frames.
const NEW_SHARE: f64 = 0.2;

/// Cost of an iteration at each pyramid level, learned from the time between two queries.
#[derive(Debug, Clone, Default)]
pub struct IterationCosts {
    nanos: [f64; MAX_LEVELS],
}

impl IterationCosts {
    /// Returns a closure that checks whether an iteration at a level fits before `deadline_nanos`.
    pub fn until(&mut self, deadline_nanos: i64) -> impl FnMut(usize) -> bool {
        let mut running: Option<(usize, i64)> = None;
        move |level| {
            let now = now_nanos();
            if let Some((level, since)) = running.take() {
                self.learn(level, now - since);
            }
            let fits = self.fits(level, now, deadline_nanos);
            if !fits {
                self.forget();
            }
            running = fits.then_some((level, now));
            fits
        }
    }

    fn learn(&mut self, level: usize, nanos: i64) {
        let Some(cost) = self.nanos.get_mut(level) else { return };
        let share = if *cost == 0.0 { 1.0 } else { NEW_SHARE };
        // One iteration during which another thread had the CPU does not predict the next.
        let sane = if *cost == 0.0 { f64::INFINITY } else { LARGEST_RISE * *cost };
        *cost += share * ((nanos as f64).min(sane) - *cost);
    }

    /// Trusts costs that forbid an iteration less: a level that is never tried is never measured again.
    fn forget(&mut self) {
        self.nanos.iter_mut().for_each(|cost| *cost *= KEPT_AT_REFUSAL);
    }

    fn fits(&self, level: usize, now: i64, deadline_nanos: i64) -> bool {
        let cost = self.nanos.get(level).copied().unwrap_or(0.0);
        let of_finest = self.nanos.iter().copied().find(|&cost| cost > 0.0).unwrap_or(0.0);
        now as f64 + cost + RESERVED_LOOKS * of_finest <= deadline_nanos as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_iteration_that_does_not_fit_is_refused() {
        let mut costs = IterationCosts::default();
        assert!(costs.fits(3, 100, 100), "nothing is known yet");
        costs.learn(0, 1000);
        let reserve = (RESERVED_LOOKS * 1000.0) as i64;
        assert!(costs.fits(0, 0, 1000 + reserve));
        assert!(!costs.fits(0, 1, 1000 + reserve));
        assert!(costs.fits(1, 1, 1000 + reserve), "another level has its own cost");
        costs.learn(0, 2000);
        assert_eq!(costs.nanos[0], 1200.0);
    }

    #[test]
    fn one_slow_iteration_does_not_forbid_all_that_follow() {
        let mut costs = IterationCosts::default();
        costs.learn(1, 50_000_000);
        let allowed = |costs: &mut IterationCosts| costs.until(now_nanos() + 16_000_000)(1);
        assert!(!allowed(&mut costs));
        assert!((0..60).any(|_| allowed(&mut costs)), "two seconds of frames at 30 Hz");
        let mut costs = IterationCosts::default();
        costs.learn(1, 150_000);
        costs.learn(1, 50_000_000);
        assert!(allowed(&mut costs));
    }

    #[test]
    fn a_deadline_in_the_past_refuses_everything() {
        let mut costs = IterationCosts::default();
        let mut budget = costs.until(now_nanos() - 1);
        assert!(!budget(0) && !budget(99));
    }
}
