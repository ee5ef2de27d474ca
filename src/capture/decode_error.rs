//! What can be wrong with the bytes of an image, of any format.

/// Largest width and height of an image, pixels; more is a broken header, not a camera.
pub const MAX_SIDE: usize = 8192;

/// What is wrong with the bytes of an image.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// Not a single byte.
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
        /// The format that its first bytes name.
        format: &'static str,
        /// What the decoder met.
        reason: String,
    },
    /// Another size than the camera's.
    #[error(
        "is {}x{} pixels where the rig says {}x{}; use the rig this sequence was recorded with",
        found.0, found.1, expected.0, expected.1
    )]
    Size {
        /// Width and height in the file.
        found: (usize, usize),
        /// Width and height of the rig.
        expected: (usize, usize),
    },
    /// Another kind of samples than needed.
    #[error("holds {found} where {expected} is needed; export it again in that format")]
    Samples {
        /// Colour type and bit depth in the file.
        found: String,
        /// What is needed.
        expected: &'static str,
    },
}
