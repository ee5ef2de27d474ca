//! Robust kernels: the cost of a constraint with a large error.

/// Growth of a constraint's cost with its squared error e = rᵀΛr; `threshold` is the √e up to which it counts in full,
/// or nearly.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum RobustKernel {
    /// e: for a constraint that is never wrong, such as that of a keyframe to the next.
    #[default]
    None,
    /// Huber: 2k√e − k² beyond k. Convex; a false constraint keeps pulling.
    Huber {
        /// k.
        threshold: f64,
    },
    /// Cauchy: k² ln(1 + e/k²). A false constraint pulls with 2k²/√e.
    Cauchy {
        /// k.
        threshold: f64,
    },
    /// Dynamic covariance scaling (Agarwal, Tipaldi, Spinello, Stachniss, Burgard 2013): k²(3e − k²)/(e + k²) beyond k,
    /// bounded by 3k². A false constraint is rejected.
    DynamicCovariance {
        /// k, the paper's √Φ.
        threshold: f64,
    },
}

/// Cost and weight of a constraint at an error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RobustCost {
    /// ρ(e).
    pub cost: f64,
    /// ρ'(e): 1 in full, towards 0 for an outlier.
    pub weight: f64,
}

impl RobustKernel {
    /// The √e up to which a constraint counts in full; `None` if always.
    pub fn threshold(&self) -> Option<f64> {
        match *self {
            Self::None => None,
            Self::Huber { threshold }
            | Self::Cauchy { threshold }
            | Self::DynamicCovariance { threshold } => Some(threshold),
        }
    }

    /// Whether the threshold is valid; its square is used.
    pub fn is_valid(&self) -> bool {
        self.threshold().is_none_or(|k| k > 0.0 && (k * k).is_normal())
    }

    /// ρ and ρ' at the squared error `e`.
    pub fn at(&self, e: f64) -> RobustCost {
        let square = |threshold: f64| threshold * threshold;
        match *self {
            Self::None => RobustCost { cost: e, weight: 1.0 },
            Self::Huber { threshold } => {
                let k2 = square(threshold);
                if e <= k2 {
                    return RobustCost { cost: e, weight: 1.0 };
                }
                let root = (k2 * e).sqrt();
                RobustCost { cost: 2.0 * root - k2, weight: root / e }
            }
            Self::Cauchy { threshold } => {
                let k2 = square(threshold);
                RobustCost { cost: k2 * (e / k2).ln_1p(), weight: k2 / (k2 + e) }
            }
            Self::DynamicCovariance { threshold } => {
                let k2 = square(threshold);
                if e <= k2 {
                    return RobustCost { cost: e, weight: 1.0 };
                }
                let scale = 2.0 * k2 / (k2 + e);
                RobustCost { cost: k2 * (3.0 * e - k2) / (e + k2), weight: scale * scale }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weight_is_the_slope_of_the_cost_and_small_errors_count_in_full() {
        let threshold = 2.5;
        for kernel in [
            RobustKernel::None,
            RobustKernel::Huber { threshold },
            RobustKernel::Cauchy { threshold },
            RobustKernel::DynamicCovariance { threshold },
        ] {
            assert_eq!(kernel.at(0.0), RobustCost { cost: 0.0, weight: 1.0 });
            // On both sides of the threshold's square, 6.25.
            for e in [0.1, 3.0, 7.0, 40.0, 1e4] {
                const STEP: f64 = 1e-4;
                let cost = |e: f64| kernel.at(e).cost;
                let slope = (cost(e + STEP) - cost(e - STEP)) / (2.0 * STEP);
                let weight = kernel.at(e).weight;
                assert!((slope - weight).abs() < 1e-6, "{kernel:?} {e}: {slope} {weight}");
            }
        }
        let rejected = RobustKernel::DynamicCovariance { threshold }.at(1e12).cost;
        assert!((rejected - 3.0 * threshold * threshold).abs() < 1e-6);
    }
}
