//! The upper median of numbers of any precision.

use std::cmp::Ordering;

/// The upper median; `None` for no values. The values are reordered.
pub(in crate::slam) fn upper_median<T: Copy>(
    values: &mut [T],
    order: impl FnMut(&T, &T) -> Ordering,
) -> Option<T> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, order).1)
}
