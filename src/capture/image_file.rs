//! Image files: PNG and JPEG, recognised by content, never by name, read as grey values or depth.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use crate::capture::decode_error::{DecodeError, MAX_SIDE};
use crate::capture::{input_file, jpeg_image, png_image};
use crate::slam::image::buffer::Image;

/// Largest image file: 16-bit RGBA of the largest size, uncompressed.
const MAX_FILE_BYTES: u64 = (MAX_SIDE * MAX_SIDE * 8) as u64;

/// Steps per metre of a 16-bit depth PNG, as defined by TUM RGB-D; 0 is "no depth".
pub const DEPTH_STEPS_PER_METRE: f32 = 5000.0;

/// Why an image file cannot be read or written; names the file.
#[derive(Debug, thiserror::Error)]
pub enum ImageFileError {
    /// The file cannot be opened or read.
    #[error("{}: cannot be read: {source}; restore it or remove it from the sequence", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The content is not the image needed.
    #[error("{} {source}", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// The problem.
        source: DecodeError,
    },
    /// The file cannot be written.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

/// Reads image files one after another, reusing memory.
#[derive(Debug, Default)]
pub struct ImageFileReader {
    bytes: Vec<u8>,
    samples: Vec<u8>,
}

impl ImageFileReader {
    /// Reads the PNG or JPEG at `path`, which must have `width * height` pixels, as grey values
    /// (ITU-R BT.601 luma of colours).
    pub fn read_gray_into(
        &mut self,
        path: &Path,
        width: usize,
        height: usize,
        gray: &mut [u8],
    ) -> Result<(), ImageFileError> {
        self.load(path)?;
        let Self { bytes, samples } = self;
        decode_gray_into(bytes, width, height, samples, gray)
            .map_err(|source| ImageFileError::Decode { path: path.to_owned(), source })
    }

    /// Whether any pixel of the file that was read last, which has `width * height` pixels, is transparent.
    pub fn is_transparent(&self, width: usize, height: usize) -> Result<bool, DecodeError> {
        let is_png = self.bytes.starts_with(&png_image::SIGNATURE);
        Ok(is_png && png_image::is_transparent(&self.bytes, width, height)?)
    }

    /// Reads the 16-bit grey PNG at `path` as depth in metres, 0 where there is none.
    pub fn read_depth(
        &mut self,
        path: &Path,
        width: usize,
        height: usize,
    ) -> Result<Image<f32>, ImageFileError> {
        self.load(path)?;
        let decode = |bytes: &[u8]| -> Result<Image<f32>, DecodeError> {
            if !bytes.starts_with(&png_image::SIGNATURE) {
                let found = "another format".to_owned();
                return Err(DecodeError::Samples { found, expected: "a 16-bit grey PNG" });
            }
            let steps = png_image::decode_u16(bytes, width, height)?;
            let metres = steps.iter().map(|&s| f32::from(s) / DEPTH_STEPS_PER_METRE).collect();
            let found = (steps.len(), 1);
            Image::try_from_pixels(width, height, metres)
                .ok_or(DecodeError::Size { found, expected: (width, height) })
        };
        decode(&self.bytes)
            .map_err(|source| ImageFileError::Decode { path: path.to_owned(), source })
    }

    fn load(&mut self, path: &Path) -> Result<(), ImageFileError> {
        input_file::read_into(path, MAX_FILE_BYTES, &mut self.bytes)
            .map_err(|source| ImageFileError::Read { path: path.to_owned(), source })
    }
}

/// Decodes PNG or JPEG bytes of `width * height` pixels into grey values; `samples` is reused
/// memory.
pub fn decode_gray_into(
    bytes: &[u8],
    width: usize,
    height: usize,
    samples: &mut Vec<u8>,
    gray: &mut [u8],
) -> Result<(), DecodeError> {
    if bytes.starts_with(&png_image::SIGNATURE) {
        png_image::decode_gray_into(bytes, width, height, samples, gray)
    } else if bytes.starts_with(&jpeg_image::SIGNATURE) {
        jpeg_image::decode_gray_into(bytes, width, height, samples, gray)
    } else if bytes.is_empty() {
        Err(DecodeError::Empty)
    } else {
        const SHOWN: usize = 8;
        let found = bytes.iter().take(SHOWN).copied().collect();
        Err(DecodeError::NotAnImage { found })
    }
}

/// Width and height of PNG or JPEG bytes, pixels.
pub fn image_size(bytes: &[u8]) -> Result<(usize, usize), DecodeError> {
    // The size is compared first; no image is 0 x 0.
    match decode_gray_into(bytes, 0, 0, &mut Vec::new(), &mut []) {
        Err(DecodeError::Size { found, .. }) => Ok(found),
        Err(error) => Err(error),
        Ok(()) => Ok((0, 0)),
    }
}

/// Writes an 8-bit grey PNG, under a temporary name first.
pub fn write_gray_png(
    path: &Path,
    width: usize,
    height: usize,
    pixels: &[u8],
) -> Result<(), ImageFileError> {
    write_png(path, png_image::encode_gray(width, height, png::BitDepth::Eight, pixels))
}

/// Writes a 16-bit grey PNG, for depth [`DEPTH_STEPS_PER_METRE`] to a metre and 0 for none, under a temporary name
/// first.
pub fn write_depth_png(
    path: &Path,
    width: usize,
    height: usize,
    steps: &[u16],
) -> Result<(), ImageFileError> {
    let samples: Vec<u8> = steps.iter().flat_map(|s| s.to_be_bytes()).collect();
    write_png(path, png_image::encode_gray(width, height, png::BitDepth::Sixteen, &samples))
}

fn write_png(
    path: &Path,
    encoded: Result<Vec<u8>, png::EncodingError>,
) -> Result<(), ImageFileError> {
    let write = || -> std::io::Result<()> {
        let bytes = encoded.map_err(std::io::Error::other)?;
        let mut temporary = path.as_os_str().to_owned();
        temporary.push(".partial");
        let written = File::create(&temporary)
            .and_then(|mut file| file.write_all(&bytes))
            .and_then(|()| std::fs::rename(&temporary, path));
        if written.is_err() {
            // The remains of a write to a full disc are useless; the first error is the one to report.
            let _ = std::fs::remove_file(&temporary);
        }
        written
    };
    write().map_err(|source| ImageFileError::Write { path: path.to_owned(), source })
}
