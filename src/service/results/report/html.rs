//! Pieces of HTML: escaped text, pictures as data addresses.

/// Escapes the characters that have a meaning in HTML and SVG.
pub fn escaped(text: &str) -> String {
    // The ampersand first: the others bring their own.
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    text.replace('"', "&quot;").replace('\'', "&#39;")
}

/// The bytes of a PNG file as a `data:` address.
pub fn png_address(bytes: &[u8]) -> String {
    String::from("data:image/png;base64,") + &base64(bytes)
}

/// Bytes as base64 (RFC 4648 §4).
pub fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::new();
    out.reserve(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let byte = |i: usize| u32::from(chunk.get(i).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for i in 0..4 {
            let letter = LETTERS[(bits >> (18 - 6 * i) & 63) as usize];
            out.push(if i <= chunk.len() { char::from(letter) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_matches_the_standard() {
        let vectors =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg==")];
        for (bytes, letters) in vectors {
            assert_eq!(png_address(bytes.as_bytes()), format!("data:image/png;base64,{letters}"));
        }
        assert!(png_address(&[0xff, 0xef, 0xbe]).ends_with("/+++"));
    }

    #[test]
    fn markup_is_escaped() {
        assert_eq!(escaped("a<b & \"c'>"), "a&lt;b &amp; &quot;c&#39;&gt;");
    }
}
