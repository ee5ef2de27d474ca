//! Statistics of a list of errors.

use serde::{Deserialize, Serialize};

/// Statistics of non-negative errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ErrorStatistics {
    /// Root mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Median; the mean of the middle two of an even number.
    pub median: f64,
    /// Largest.
    pub max: f64,
}

impl ErrorStatistics {
    /// Statistics of `errors`; `None` for no errors, or where a sum is not finite.
    pub fn of(errors: &[f64]) -> Option<Self> {
        let count = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / count;
        let rmse = (errors.iter().map(|e| e * e).sum::<f64>() / count).sqrt();
        let max = errors.iter().copied().fold(0.0, f64::max);
        (mean.is_finite() && rmse.is_finite()).then(|| Self {
            rmse,
            mean,
            median: median(errors).unwrap_or(f64::NAN),
            max,
        })
    }
}

/// The median, the mean of the middle two of an even number; `None` for no values.
pub fn median(values: &[f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let mut sorted = values.to_vec();
    let middle = sorted.len() / 2;
    let even = sorted.len().is_multiple_of(2);
    let (below, upper, _) = sorted.select_nth_unstable_by(middle, f64::total_cmp);
    let upper = *upper;
    let lower = below.iter().copied().max_by(f64::total_cmp);
    Some(if even { lower.map_or(upper, |lower| 0.5 * (lower + upper)) } else { upper })
}

/// The smallest value that at least `share` (0 to 1) of the values do not exceed (nearest rank); `None` for no values.
/// `sorted` is in ascending order.
pub fn percentile(sorted: &[f64], share: f64) -> Option<f64> {
    let rank = (share.clamp(0.0, 1.0) * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied()
}

/// The [`percentile`] of each of `shares`; `values` are in any order.
pub fn percentiles<const N: usize>(
    values: impl IntoIterator<Item = f64>,
    shares: [f64; N],
) -> Option<[f64; N]> {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    let mut found = shares;
    for share in &mut found {
        *share = percentile(&sorted, *share)?;
    }
    Some(found)
}

/// Ratio of the largest to the smallest of positive values; `None` for fewer than two.
pub fn largest_over_smallest(values: impl Iterator<Item = f64> + Clone) -> Option<f64> {
    let largest = values.clone().fold(0.0, f64::max);
    let smallest = values.clone().fold(f64::INFINITY, f64::min);
    (values.count() > 1).then(|| largest / smallest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_of_odd_even_one_and_no_values() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[4.0, 1.0, 3.0, 2.0]), Some(2.5));
        assert_eq!(median(&[7.0]), Some(7.0));
        assert_eq!(median(&[]), None);
    }

    #[test]
    fn percentile_is_a_value_of_the_list() {
        let sorted: Vec<f64> = (1..=100).map(f64::from).collect();
        assert_eq!(percentile(&sorted, 0.5), Some(50.0));
        assert_eq!(percentile(&sorted, 0.99), Some(99.0));
        assert_eq!(percentile(&sorted, 1.0), Some(100.0));
        assert_eq!(percentile(&sorted, 0.0), Some(1.0));
        assert_eq!(percentile(&[], 0.5), None);
    }

    #[test]
    fn statistics_of_nothing_and_of_overflow_are_none() {
        assert_eq!(ErrorStatistics::of(&[]), None);
        assert_eq!(ErrorStatistics::of(&[1e200, 1.0]), None);
        let s = ErrorStatistics::of(&[3.0, 4.0]).unwrap();
        assert_eq!((s.mean, s.median, s.max), (3.5, 3.5, 4.0));
        assert!((s.rmse - 12.5f64.sqrt()).abs() < 1e-15);
    }
}
