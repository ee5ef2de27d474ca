//! Counts with their nouns: 1 pair, 2 pairs.

use std::fmt::Display;

/// `count` and `noun`, which takes an s but of one.
pub fn counted<T: Display + PartialEq + From<u8>>(count: T, noun: &str) -> String {
    let s = if count == T::from(1) { "" } else { "s" };
    format!("{count} {noun}{s}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_has_no_s() {
        assert_eq!(counted(1_u32, "time stamp"), "1 time stamp");
        assert_eq!([0, 2].map(|count: usize| counted(count, "pair")), ["0 pairs", "2 pairs"]);
    }
}
