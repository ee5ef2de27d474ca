//! Numbers and lengths as text.

/// A length in metres, in the unit that keeps it readable.
pub(super) fn length(metres: f64) -> String {
    if metres < 0.01 {
        format!("{:.2} mm", 1e3 * metres)
    } else if metres < 1.0 {
        format!("{:.2} cm", 1e2 * metres)
    } else {
        format!("{metres:.2} m")
    }
}

/// Strips zeros at the end of the decimals, and a point without decimals.
pub(crate) fn without_zeros(text: &str) -> &str {
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.'),
        false => text,
    }
}

/// A number with spaces between groups of three digits.
pub(super) fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut out = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push('\u{202f}');
        }
        out.push(digit);
    }
    out
}
