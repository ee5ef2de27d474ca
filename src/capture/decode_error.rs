//! Errors in the bytes of an image of any format.

/// Largest width and height of an image, pixels; more indicates a broken header, not a camera.
pub const MAX_SIDE: usize = 8192;

/// Why the bytes of an image cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// No bytes.
    #[error("is empty; copy the file again or remove it from the sequence")]
    Empty,
    /// Neither PNG nor JPEG.
    #[error("is neither PNG nor JPEG (it begins with {found:02x?}); convert it to one of them")]
    NotAnImage {
        /// The first bytes.
        found: Vec<u8>,
    },
    /// Truncated or corrupt.
    #[error("is a damaged {format} ({reason}); copy the file again or remove it from the sequence")]
    Damaged {
        /// The format indicated by its first bytes.
        format: &'static str,
        /// The decoder's error.
        reason: String,
    },
    /// A size other than the camera's.
    #[error(
        "is {}x{} pixels, but the rig expects {}x{}; use the rig this sequence was recorded with",
        found.0, found.1, expected.0, expected.1
    )]
    Size {
        /// Width and height in the file.
        found: (usize, usize),
        /// Width and height of the rig.
        expected: (usize, usize),
    },
    /// Samples of another kind than needed.
    #[error("holds {found} where {expected} is needed; export it again in that format")]
    Samples {
        /// Colour type and bit depth in the file.
        found: String,
        /// The kind needed.
        expected: &'static str,
    },
}
