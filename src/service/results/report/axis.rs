//! Axes of a chart: ranges that contain the points, ticks at round numbers.

/// A range of values shown on an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Lower end.
    pub low: f64,
    /// Upper end, above the lower.
    pub high: f64,
}

/// Margin beyond the outermost points, as a share of the range.
const MARGIN_RATIO: f64 = 0.04;

/// Number of ticks to aim for.
const TICKS: f64 = 6.0;

impl Range {
    /// The range of the finite `values`, with a margin; 0 to 1 where there are none.
    pub fn around(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = values
            .filter(|value| value.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let width = high - low;
        if !width.is_finite() {
            return Self { low: 0.0, high: 1.0 };
        }
        // A constant is shown in the middle of a range of its own size.
        let margin =
            if width > 1e-12 * high.abs().max(low.abs()) { MARGIN_RATIO * width } else { 0.0 };
        if margin > 0.0 {
            return Self { low: low - margin, high: high + margin };
        }
        let half = if high == 0.0 { 1.0 } else { 0.5 * high.abs() };
        Self { low: low - half, high: high + half }
    }

    /// The range from zero to its upper end, for quantities that cannot be negative.
    pub fn begun_at_zero(self) -> Self {
        Self { low: 0.0, high: if self.high > 0.0 { self.high } else { 1.0 } }
    }

    /// Length of the range.
    pub fn width(self) -> f64 {
        self.high - self.low
    }

    /// A range of `width` about the same middle.
    pub fn widened_to(self, width: f64) -> Self {
        let middle = 0.5 * (self.low + self.high);
        Self { low: middle - 0.5 * width, high: middle + 0.5 * width }
    }

    /// For a range of decimal logarithms: the powers of ten within, with their text.
    pub fn decade_ticks(self) -> Vec<(f64, String)> {
        let exponents = self.low.ceil() as i32..=self.high.floor() as i32;
        // A range of f64 spans some six hundred decades.
        let stride = (exponents.clone().count() as f64 / TICKS).ceil().max(1.0) as usize;
        let tick = |exponent: i32| {
            let decimals = usize::try_from(-exponent).unwrap_or(0);
            let value = 10f64.powi(exponent);
            (value, format!("{value:.decimals$}"))
        };
        exponents.step_by(stride).map(tick).collect()
    }

    /// Round values within the range, with their text.
    pub fn ticks(self) -> Vec<(f64, String)> {
        let step = round_step(self.width() / TICKS);
        let decimals = (-step.log10().floor()).clamp(0.0, 12.0) as usize;
        let first = (self.low / step).ceil();
        let count = (self.high / step).floor() - first;
        if !count.is_finite() || count < 0.0 {
            return Vec::new();
        }
        let tick = |i: usize| {
            let value = (first + i as f64) * step;
            let text = format!("{value:.decimals$}");
            // A tick at −0 is written as 0.
            let zero = text.trim_start_matches('-').chars().all(|c| c == '0' || c == '.');
            (value, if zero { "0".to_owned() } else { text })
        };
        (0..=count as usize).map(tick).collect()
    }
}

/// The smallest of 1, 2, 5 × 10ⁿ that is at least `least`.
pub(super) fn round_step(least: f64) -> f64 {
    let decade = 10f64.powf(least.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|f| f * decade >= least * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * decade
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let ticks = Range { low: -0.03, high: 1.04 }.ticks();
        let texts: Vec<&str> = ticks.iter().map(|(_, text)| text.as_str()).collect();
        assert_eq!(texts, ["0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        let texts: Vec<String> =
            Range { low: 995.0, high: 1252.0 }.ticks().into_iter().map(|t| t.1).collect();
        assert_eq!(texts, ["1000", "1050", "1100", "1150", "1200", "1250"]);
    }

    #[test]
    fn ranges_accept_any_values() {
        assert_eq!(Range::around([].into_iter()), Range { low: 0.0, high: 1.0 });
        assert_eq!(Range::around([f64::NAN].into_iter()), Range { low: 0.0, high: 1.0 });
        assert_eq!(Range::around([4.0].into_iter()), Range { low: 2.0, high: 6.0 });
        assert_eq!(Range::around([0.0, 0.0].into_iter()), Range { low: -1.0, high: 1.0 });
        for values in [[1e300, -1e300], [1e-300, 2e-300], [5.0, 5.0 + 1e-15]] {
            let range = Range::around(values.into_iter());
            assert!(range.width() > 0.0 && range.ticks().len() < 20, "{values:?}");
        }
    }
}
