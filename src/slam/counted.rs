//! Counts with their nouns: 1 pair, 2 pairs.

use std::fmt::Display;

/// `count` followed by `noun`, which gets a plural s unless the count is 1.
pub fn counted<T: Display + PartialEq + From<u8>>(count: T, noun: &str) -> String {
    let s = if count == T::from(1) { "" } else { "s" };
    format!("{count} {noun}{s}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_count_of_one_takes_the_singular() {
        assert_eq!(counted(1_u32, "time stamp"), "1 time stamp");
        assert_eq!([0, 2].map(|count: usize| counted(count, "pair")), ["0 pairs", "2 pairs"]);
    }
}
