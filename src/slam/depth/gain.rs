//! Weight of a depth observation against the estimate when a part of both errors is common.

/// Uncertainty of an inverse depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Uncertainty {
    /// Variance.
    pub variance: f32,
    /// The part that differs from one observation to the next: noise of the frame. The rest shifts all observations of
    /// the pixel together: noise of the keyframe, error of poses, slant.
    pub independent: f32,
}

/// The effect of fusing an observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gain {
    /// Weight of the observation.
    pub weight: f32,
    /// Uncertainty of the fused mean.
    pub left: Uncertainty,
}

impl Gain {
    /// The minimum-variance mean of two values with independent errors of variances v and n and one error common to
    /// both, with standard deviations a and b:
    /// ```text
    /// V(w) = (1−w)² v + w² n + ((1−w) a + w b)²      w = (v + a (a − b)) / (v + n + (a − b)²), within 0 and 1
    /// ```
    /// Equal views are averaged: v falls with their number and a² remains. A view in which the common error weighs less
    /// (a longer baseline) takes over.
    #[inline(always)]
    pub fn of(known: Uncertainty, found: Uncertainty) -> Self {
        let a = (known.variance - known.independent).max(0.0).sqrt();
        let b = (found.variance - found.independent).max(0.0).sqrt();
        let difference = a - b;
        let spread = known.independent + found.independent + difference * difference;
        let towards = known.independent + a * difference;
        let weight = (towards / spread.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
        let kept = 1.0 - weight;
        let independent = kept * kept * known.independent + weight * weight * found.independent;
        let common = kept * a + weight * b;
        Self { weight, left: Uncertainty { variance: independent + common * common, independent } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_views_are_averaged_and_their_common_error_stays() {
        let view = Uncertainty { variance: 5.0, independent: 4.0 };
        let (mut known, mut mean) = (view, 1.0);
        for n in 2..=10u8 {
            let gain = Gain::of(known, view);
            mean += gain.weight * (f32::from(n) - mean);
            known = gain.left;
            assert!((gain.weight - 1.0 / f32::from(n)).abs() < 1e-5);
        }
        // The mean of 1 to 10, equally weighted.
        assert!((mean - 5.5).abs() < 1e-4, "{mean}");
        assert!((known.independent - 0.4).abs() < 1e-5);
        assert!((known.variance - 1.4).abs() < 1e-5);
    }

    #[test]
    fn the_weight_minimises_the_variance() {
        let left = |known: Uncertainty, found: Uncertainty, w: f32| {
            let common = |u: Uncertainty| (u.variance - u.independent).sqrt();
            let independent = (1.0 - w).powi(2) * known.independent + w * w * found.independent;
            independent + ((1.0 - w) * common(known) + w * common(found)).powi(2)
        };
        for i in 0..200u16 {
            let random = |step: u16| f32::from(i * step % 53 + 1) / 53.0;
            let of =
                |variance: f32, share: f32| Uncertainty { variance, independent: variance * share };
            let (known, found) = (of(random(7), random(11)), of(random(17), random(29)));
            let gain = Gain::of(known, found);
            assert!((gain.left.variance - left(known, found, gain.weight)).abs() < 1e-5);
            assert!(gain.left.independent <= gain.left.variance + 1e-6);
            for other in (0..=20u8).map(|step| f32::from(step) / 20.0) {
                assert!(gain.left.variance <= left(known, found, other) + 1e-5, "{i}: {other}");
            }
        }
    }

    #[test]
    fn an_estimate_better_in_every_part_is_unchanged() {
        let known = Uncertainty { variance: 1.0, independent: 0.0 };
        let gain = Gain::of(known, Uncertainty { variance: 9.0, independent: 0.0 });
        assert_eq!((gain.weight, gain.left), (0.0, known));
        let exact = Uncertainty { variance: 0.0, independent: 0.0 };
        assert_eq!(Gain::of(exact, exact).left, exact);
    }
}
