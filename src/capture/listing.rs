//! Text lists of recordings: rows with line numbers, stamps exact to the nanosecond, poses.

use std::path::Path;

use crate::capture::input_file;
use crate::capture::source_error::SourceError;
use crate::slam::geometry::se3::SE3;

/// Largest list, bytes: about three hours at 100 Hz with 1 kB per line.
const MAX_LIST_BYTES: u64 = 1 << 30;

const NANOS_PER_SECOND_DIGITS: i32 = 9;

/// A line of a list that is neither empty nor a comment (`#`).
#[derive(Debug, Clone, Copy)]
pub struct Row<'a> {
    path: &'a Path,
    line: usize,
    /// The line without surrounding blanks.
    pub text: &'a str,
    /// Whether the line begins with blanks.
    pub is_indented: bool,
}

impl Row<'_> {
    /// Returns an error about this line: the problem and what to do.
    pub fn error(&self, problem: impl Into<String>) -> SourceError {
        SourceError::Line { path: self.path.to_owned(), line: self.line, problem: problem.into() }
    }

    /// Reads a stamp in seconds.
    pub fn seconds(&self, text: &str) -> Result<i64, SourceError> {
        nanos_from_seconds(text).ok_or_else(|| {
            self.error(format!("`{text}` is not a time stamp in seconds, like 1305033527.670034"))
        })
    }

    /// Reads a stamp in whole nanoseconds.
    pub fn nanos(&self, text: &str) -> Result<i64, SourceError> {
        text.parse().map_err(|_| {
            self.error(format!(
                "`{text}` is not a time stamp in nanoseconds, like 1403636579763555584"
            ))
        })
    }

    /// Reads a finite number.
    pub fn number(&self, text: &str) -> Result<f64, SourceError> {
        let number = text.parse().ok().filter(|x: &f64| x.is_finite());
        number.ok_or_else(|| self.error(format!("`{text}` is not a finite number")))
    }

    /// Reads a pose from its numbers; the quaternion is normalised.
    pub fn pose(
        &self,
        [qx, qy, qz, qw]: [&str; 4],
        [x, y, z]: [&str; 3],
    ) -> Result<SE3, SourceError> {
        let translation = [self.number(x)?, self.number(y)?, self.number(z)?];
        let quaternion_xyzw =
            [self.number(qx)?, self.number(qy)?, self.number(qz)?, self.number(qw)?];
        SE3::try_from_parts(quaternion_xyzw, translation).ok_or_else(|| {
            self.error("its quaternion has zero length, so it is not a rotation; remove the line")
        })
    }

    /// Checks that `nanos` is later than the stamp of the previous row.
    pub fn check_after(&self, before: Option<i64>, nanos: i64) -> Result<(), SourceError> {
        let problem = match before {
            Some(before) if nanos == before => "has the same time stamp as",
            Some(before) if nanos < before => "has an earlier time stamp than",
            _ => return Ok(()),
        };
        Err(self.error(format!(
            "{problem} the entry before it; sort the list by time and keep one entry for each"
        )))
    }
}

/// Reads a text file of bounded size.
pub fn read_text(path: &Path) -> Result<String, SourceError> {
    input_file::read_text(path, MAX_LIST_BYTES)
        .map_err(|source| SourceError::Read { path: path.to_owned(), source })
}

/// Reads the entries of the list at `path`, one per row, whose stamps must increase; `read` returns stamp and entry.
pub fn read_list<T>(
    path: &Path,
    read: impl Fn(&Row<'_>) -> Result<(i64, T), SourceError>,
) -> Result<Vec<T>, SourceError> {
    let text = read_text(path)?;
    let (mut entries, mut before) = (Vec::new(), None);
    for row in rows(path, &text) {
        let (nanos, entry) = read(&row)?;
        row.check_after(before.replace(nanos), nanos)?;
        entries.push(entry);
    }
    Ok(entries)
}

/// Returns the rows of a list that was read from `path`.
pub fn rows<'a>(path: &'a Path, text: &'a str) -> impl Iterator<Item = Row<'a>> {
    text.lines().enumerate().filter_map(move |(i, text)| {
        let text = text.trim_start_matches('\u{feff}');
        let is_indented = text.starts_with(char::is_whitespace);
        let text = text.trim();
        let holds_entry = !text.is_empty() && !text.starts_with('#');
        holds_entry.then_some(Row { path, line: i + 1, text, is_indented })
    })
}

/// Converts a decimal number of seconds to nanoseconds exactly: without a binary fraction in between. Digits below a
/// nanosecond are truncated. `None` if it is not a number or exceeds i64.
pub fn nanos_from_seconds(text: &str) -> Option<i64> {
    let (mantissa, exponent) = match text.split_once(['e', 'E']) {
        Some((mantissa, exponent)) => (mantissa, exponent.parse::<i16>().ok()?),
        None => (text, 0),
    };
    let (negative, mantissa) = match mantissa.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, mantissa.strip_prefix('+').unwrap_or(mantissa)),
    };
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    if whole.is_empty() && fraction.is_empty() {
        return None;
    }
    // Digits up to this place, counted from the decimal point, belong to the result.
    let mut places = whole.len() as i64 + i64::from(exponent) + i64::from(NANOS_PER_SECOND_DIGITS);
    let mut magnitude: i64 = 0;
    for digit in whole.chars().chain(fraction.chars()) {
        let digit = i64::from(digit.to_digit(10)?);
        if places > 0 {
            magnitude = magnitude.checked_mul(10)?.checked_add(digit)?;
            places -= 1;
        }
    }
    while places > 0 && magnitude != 0 {
        magnitude = magnitude.checked_mul(10)?;
        places -= 1;
    }
    Some(if negative { -magnitude } else { magnitude })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_are_exact() {
        for (text, nanos) in [
            ("1305033527.670034", 1_305_033_527_670_034_000),
            ("1403636579.763555584", 1_403_636_579_763_555_584),
            ("0.000000", 0),
            ("0.1", 100_000_000),
            ("12", 12_000_000_000),
            ("12.", 12_000_000_000),
            (".5", 500_000_000),
            ("-0.25", -250_000_000),
            ("+3.000000001", 3_000_000_001),
            ("1.0000000019", 1_000_000_001),
            ("1.305033527670034e+09", 1_305_033_527_670_034_000),
            ("25e-3", 25_000_000),
            ("1e-30000", 0),
        ] {
            assert_eq!(nanos_from_seconds(text), Some(nanos), "{text}");
        }
        for text in
            ["", ".", "-", "nan", "inf", "1,5", "1.2.3", "1e99", "99999999999", "0x10", "1e"]
        {
            assert_eq!(nanos_from_seconds(text), None, "{text}");
        }
    }

    #[test]
    fn rows_skip_comments_and_count_lines() {
        let text = "# head\r\n\r\n1 a\r\n  2 b  \n";
        let found: Vec<_> = rows(Path::new("list"), text).map(|r| (r.line, r.text)).collect();
        assert_eq!(found, [(3, "1 a"), (4, "2 b")]);
    }
}
