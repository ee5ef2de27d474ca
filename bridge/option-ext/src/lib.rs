//! Whether an option holds a given value: the only function that `dirs-sys` uses of the crate of this name.

/// Adds [`OptionExt::contains`].
pub trait OptionExt<T> {
    /// Whether it holds a value equal to `value`.
    fn contains<U>(&self, value: &U) -> bool
    where
        U: PartialEq<T>;
}

impl<T> OptionExt<T> for Option<T> {
    fn contains<U>(&self, value: &U) -> bool
    where
        U: PartialEq<T>,
    {
        self.as_ref().is_some_and(|held| value == held)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_an_equal_value_is_contained() {
        assert!(OptionExt::contains(&Some(3), &3) && !OptionExt::contains(&Some(3), &4));
        assert!(!OptionExt::contains(&None::<i32>, &3));
    }
}
