//! ROS images (`sensor_msgs/Image`) and their grey values.

use crate::capture::decode_error::MAX_SIDE;
use crate::capture::v4l::pixel_format::{InvalidPicture, PixelFormat, unpack_gray};
use crate::slam::image::gray::gray_from_rgb;

/// A ROS image; none of its fields is trusted.
#[derive(Debug, Clone, Copy)]
pub struct RosImage<'a> {
    /// Name of the format, such as `mono8`.
    pub encoding: &'a str,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Bytes from row to row.
    pub step: u32,
    /// Whether values of more than one byte have their high byte first.
    pub is_bigendian: bool,
    /// The rows.
    pub data: &'a [u8],
}

/// Why an image cannot be converted to grey values.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RosImageError {
    /// A format without grey values, or an unknown one.
    #[error(
        "encoding `{0}` is not supported; supported are mono8, mono16, rgb8, bgr8, rgba8, bgra8, 8UC1, 8UC3, 8UC4, 16UC1, rgb16, bgr16, bayer_*8, bayer_*16, yuv422, yuv422_yuy2, uyvy, yuyv, nv12, nv21, nv24"
    )]
    Encoding(String),
    /// An invalid size, or one other than the buffer's.
    #[error("an image of {0}x{1} pixels; a side has 2 to 8192, and the size must not change")]
    Size(u32, u32),
    /// Rows or bytes that do not fit the size.
    #[error(transparent)]
    Picture(#[from] InvalidPicture),
    /// Rows too short for their pixels, or too few bytes.
    #[error("{found} bytes in rows of {step} for {width}x{height} pixels of {encoding}")]
    Short {
        /// Bytes found.
        found: usize,
        /// Bytes from row to row.
        step: u32,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// The format.
        encoding: String,
    },
}

/// Layout of a pixel's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Samples {
    /// Interleaved: channels per pixel, bytes per channel, and the positions of red and blue; green is second.
    Colour { channels: usize, bytes: usize, red: usize, blue: usize },
    /// One colour per pixel; red at this column and row of each 2 x 2, blue diagonally opposite.
    Bayer { bytes: usize, red: (usize, usize) },
    /// Grey of two bytes, high byte first.
    WideGray,
}

impl RosImage<'_> {
    /// Writes the `width * height` grey values. Values of 16 bits keep their upper eight.
    pub fn unpack_gray(&self, gray: &mut [u8]) -> Result<(), RosImageError> {
        let (width, height) = (self.width as usize, self.height as usize);
        let sides = 2..=MAX_SIDE;
        if !sides.contains(&width) || !sides.contains(&height) || gray.len() != width * height {
            return Err(RosImageError::Size(self.width, self.height));
        }
        if let Some(format) = self.camera_format() {
            let (step, samples) = (self.step as usize, &mut Vec::new());
            return Ok(unpack_gray(format, self.data, step, (width, height), samples, gray)?);
        }
        let samples = self.samples().ok_or_else(|| RosImageError::Encoding(self.shown()))?;
        let pixel_bytes = match samples {
            Samples::Colour { channels, bytes, .. } => channels * bytes,
            Samples::Bayer { bytes, .. } => bytes,
            Samples::WideGray => 2,
        };
        let row_bytes = width * pixel_bytes;
        let step = self.step as usize;
        let needed = (height - 1).saturating_mul(step).saturating_add(row_bytes);
        if step < row_bytes || self.data.len() < needed {
            return Err(RosImageError::Short {
                found: self.data.len(),
                step: self.step,
                width: self.width,
                height: self.height,
                encoding: self.shown(),
            });
        }
        for (v, gray) in gray.chunks_exact_mut(width).enumerate() {
            match samples {
                Samples::Bayer { bytes, red } => self.unpack_bayer_row(v, bytes, red, gray),
                _ => self.unpack_row(&self.data[v * step..][..row_bytes], samples, gray),
            }
        }
        Ok(())
    }

    /// The name of the format, shortened for an error.
    fn shown(&self) -> String {
        const MAX_SHOWN: usize = 40;
        self.encoding.escape_debug().take(MAX_SHOWN).collect()
    }

    /// The camera format with the same bytes.
    fn camera_format(&self) -> Option<PixelFormat> {
        Some(match self.encoding {
            "mono8" | "8UC1" => PixelFormat::Grey,
            "mono16" | "16UC1" if !self.is_bigendian => PixelFormat::Y16,
            "rgb8" => PixelFormat::Rgb3,
            "bgr8" | "8UC3" => PixelFormat::Bgr3,
            "yuv422" | "uyvy" => PixelFormat::Uyvy,
            "yuv422_yuy2" | "yuyv" => PixelFormat::Yuyv,
            // Planes: the first one is luma.
            "nv12" | "nv21" | "nv24" => PixelFormat::Nv12,
            _ => return None,
        })
    }

    fn samples(&self) -> Option<Samples> {
        let colour = |channels, bytes, red, blue| Samples::Colour { channels, bytes, red, blue };
        Some(match self.encoding {
            "mono16" | "16UC1" => Samples::WideGray,
            "rgba8" => colour(4, 1, 0, 2),
            "bgra8" | "8UC4" => colour(4, 1, 2, 0),
            "rgb16" => colour(3, 2, 0, 2),
            "bgr16" | "16UC3" => colour(3, 2, 2, 0),
            "rgba16" => colour(4, 2, 0, 2),
            "bgra16" | "16UC4" => colour(4, 2, 2, 0),
            bayer => {
                let (pattern, bits) = bayer.strip_prefix("bayer_")?.split_at_checked(4)?;
                let bytes = match bits {
                    "8" => 1,
                    "16" => 2,
                    _ => return None,
                };
                let red = match pattern {
                    "rggb" => (0, 0),
                    "grbg" => (1, 0),
                    "gbrg" => (0, 1),
                    "bggr" => (1, 1),
                    _ => return None,
                };
                Samples::Bayer { bytes, red }
            }
        })
    }

    /// The upper eight bits of the value at `index` in a row of values of `bytes` bytes.
    fn value(&self, row: &[u8], index: usize, bytes: usize) -> u8 {
        let high = if bytes == 2 && !self.is_bigendian { 1 } else { 0 };
        row[index * bytes + high]
    }

    fn unpack_row(&self, row: &[u8], samples: Samples, gray: &mut [u8]) {
        for (u, gray) in gray.iter_mut().enumerate() {
            *gray = match samples {
                Samples::Colour { channels, bytes, red, blue } => {
                    let channel = |at| self.value(row, u * channels + at, bytes);
                    gray_from_rgb([channel(red), channel(1), channel(blue)])
                }
                Samples::WideGray | Samples::Bayer { .. } => row[2 * u],
            };
        }
    }

    /// Converts a row of one colour per pixel: each colour is the mean of its pixels among the nine around.
    fn unpack_bayer_row(&self, v: usize, bytes: usize, red: (usize, usize), gray: &mut [u8]) {
        let (width, height, step) = (self.width as usize, self.height as usize, self.step as usize);
        let rows = around(v, height).map(|row| &self.data[row * step..]);
        let parity_rows = around(v, height).map(|row| (row + red.1) % 2);
        for (u, gray) in gray.iter_mut().enumerate() {
            // Red, green, blue: sum and count.
            let mut sums = [(0_u32, 0_u32); 3];
            for column in around(u, width) {
                let parity_column = (column + red.0) % 2;
                for (row, parity_row) in rows.iter().zip(parity_rows) {
                    let colour = parity_column + parity_row;
                    sums[colour].0 += u32::from(self.value(row, column, bytes));
                    sums[colour].1 += 1;
                }
            }
            let own = (u + red.0) % 2 + parity_rows[1];
            let mean = |colour: usize| match colour == own && colour != 1 {
                // Its own colour is measured here.
                true => self.value(rows[1], u, bytes),
                false => ((sums[colour].0 + sums[colour].1 / 2) / sums[colour].1.max(1)) as u8,
            };
            *gray = gray_from_rgb([mean(0), mean(1), mean(2)]);
        }
    }
}

/// The indices before, at and after `at`; beyond an end the one on the other side, which has the same colour.
fn around(at: usize, length: usize) -> [usize; 3] {
    let before = if at == 0 { 1 } else { at - 1 };
    let after = if at + 1 == length { length - 2 } else { at + 1 };
    [before, at, after]
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [&str; 28] = [
        "mono8",
        "8UC1",
        "mono16",
        "16UC1",
        "rgb8",
        "bgr8",
        "8UC3",
        "rgba8",
        "bgra8",
        "8UC4",
        "rgb16",
        "bgr16",
        "16UC3",
        "rgba16",
        "bgra16",
        "16UC4",
        "bayer_rggb8",
        "bayer_grbg8",
        "bayer_gbrg8",
        "bayer_bggr16",
        "yuv422",
        "uyvy",
        "yuv422_yuy2",
        "yuyv",
        "nv12",
        "nv21",
        "nv24",
        "bayer_rggb16",
    ];

    fn unpack(encoding: &str, is_bigendian: bool, data: &[u8], step: u32) -> Vec<u8> {
        let image = RosImage { encoding, width: 2, height: 2, step, is_bigendian, data };
        let mut gray = vec![0; 4];
        image.unpack_gray(&mut gray).unwrap_or_else(|error| panic!("{encoding}: {error}"));
        gray
    }

    #[test]
    fn channels_and_bytes_follow_the_encoding() {
        let red = [76; 4];
        assert_eq!(unpack("rgb8", false, &[255, 0, 0].repeat(4), 6), red);
        assert_eq!(unpack("bgr8", false, &[0, 0, 255].repeat(4), 6), red);
        assert_eq!(unpack("rgba8", false, &[255, 0, 0, 9].repeat(4), 8), red);
        assert_eq!(unpack("bgra8", false, &[0, 0, 255, 9].repeat(4), 8), red);
        assert_eq!(unpack("rgb16", false, &[7, 255, 0, 0, 0, 0].repeat(4), 12), red);
        assert_eq!(unpack("bgr16", true, &[0, 0, 0, 0, 255, 7].repeat(4), 12), red);
        assert_eq!(unpack("mono16", false, &[1, 90].repeat(4), 4), [90; 4]);
        assert_eq!(unpack("mono16", true, &[90, 1].repeat(4), 4), [90; 4]);
        assert_eq!(unpack("yuv422", false, &[1, 90].repeat(4), 4), [90; 4]);
        assert_eq!(unpack("yuv422_yuy2", false, &[90, 1].repeat(4), 4), [90; 4]);
        assert_eq!(unpack("nv21", false, &[90, 90, 90, 90, 1, 1], 2), [90; 4]);
        // Padding after a row is not part of its pixels.
        assert_eq!(unpack("mono8", false, &[5, 6, 0, 7, 8], 3), [5, 6, 7, 8]);
    }

    #[test]
    fn a_mosaic_gives_the_grey_of_its_colour() {
        let (red, green, blue) = (200_u8, 120, 40);
        let expected = gray_from_rgb([red, green, blue]);
        for (encoding, tile) in [
            ("bayer_rggb8", [red, green, green, blue]),
            ("bayer_grbg8", [green, red, blue, green]),
            ("bayer_gbrg8", [green, blue, red, green]),
            ("bayer_bggr8", [blue, green, green, red]),
        ] {
            let row = |v: usize| [tile[2 * v], tile[2 * v + 1]].repeat(3);
            let data = [row(0), row(1)].concat().repeat(2);
            let image = RosImage {
                encoding,
                width: 6,
                height: 4,
                step: 6,
                is_bigendian: false,
                data: &data,
            };
            let mut gray = vec![0; 24];
            image.unpack_gray(&mut gray).unwrap();
            assert_eq!(gray, [expected; 24], "{encoding}");
            let wide: Vec<u8> = data.iter().flat_map(|&value| [3, value]).collect();
            let encoding = encoding.replace('8', "16");
            let image = RosImage { encoding: &encoding, step: 12, data: &wide, ..image };
            image.unpack_gray(&mut gray).unwrap();
            assert_eq!(gray, [expected; 24], "{encoding}");
        }
    }

    #[test]
    fn invalid_images_are_errors() {
        let data = vec![1; 64];
        for encoding in ALL {
            for (width, height, step, length) in [
                (0, 4, 8, 64),
                (4, 1, 8, 64),
                (9000, 4, 8, 64),
                (4, 4, 0, 64),
                (4, 4, 3, 64),
                (4, 4, u32::MAX, 64),
                (4, 4, 16, 0),
                (4, 4, 48, 50),
            ] {
                let data = &data[..length];
                let image = RosImage { encoding, width, height, step, is_bigendian: false, data };
                let mut gray = vec![0; (width * height) as usize];
                assert!(
                    image.unpack_gray(&mut gray).is_err(),
                    "{encoding} {width} {step} {length}"
                );
                assert!(image.unpack_gray(&mut []).is_err());
            }
        }
        for encoding in ["", "32FC1", "bayer_", "bayer_rggb", "bayer_rggb12", "bayer_ä", "jpeg"] {
            let image = RosImage {
                encoding,
                width: 4,
                height: 4,
                step: 16,
                is_bigendian: false,
                data: &data,
            };
            let error = image.unpack_gray(&mut [0; 16]).unwrap_err();
            assert_eq!(error, RosImageError::Encoding(encoding.to_owned()));
        }
    }
}
