//! The pixel formats of cameras, and their grey values.

use super::kernel::FIELD_NONE;
use super::video_device::{FourCc, Layout};
use crate::capture::jpeg_image::decode_gray_into;
use crate::slam::image::gray::{gray_from_interleaved, gray_from_rgb};

/// A format that can be converted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum PixelFormat {
    /// 8-bit grey.
    Grey = FourCc::new(b"GREY").0,
    /// A plane of luma, then one of chroma (4:2:0).
    Nv12 = FourCc::new(b"NV12").0,
    /// Alternating luma and chroma (4:2:2), luma first.
    Yuyv = FourCc::new(b"YUYV").0,
    /// The same, chroma first.
    Uyvy = FourCc::new(b"UYVY").0,
    /// 10 bits of grey in two bytes, little-endian.
    Y10 = FourCc::new(b"Y10 ").0,
    /// 12 bits of grey in two bytes.
    Y12 = FourCc::new(b"Y12 ").0,
    /// 16 bits of grey.
    Y16 = FourCc::new(b"Y16 ").0,
    /// Red, green, blue, a byte each.
    Rgb3 = FourCc::new(b"RGB3").0,
    /// The same, blue first.
    Bgr3 = FourCc::new(b"BGR3").0,
    /// A JPEG for each frame.
    Mjpeg = FourCc::new(b"MJPG").0,
}

impl PixelFormat {
    /// All of them, the cheapest to convert first.
    pub const ALL: [Self; 10] = [
        Self::Grey,
        Self::Nv12,
        Self::Yuyv,
        Self::Uyvy,
        Self::Y10,
        Self::Y12,
        Self::Y16,
        Self::Rgb3,
        Self::Bgr3,
        Self::Mjpeg,
    ];

    /// Its code.
    pub const fn code(self) -> FourCc {
        FourCc(self as u32)
    }

    /// The format of a code.
    pub fn of(code: FourCc) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.code() == code)
    }

    /// Bytes of a row whose grey values are needed; `None` for compressed pictures.
    pub(in crate::capture) fn row_bytes(self, width: usize) -> Option<usize> {
        match self {
            Self::Grey | Self::Nv12 => Some(width),
            // 4:2:2 without the last chroma: the last luma of an odd width is present nevertheless.
            Self::Yuyv | Self::Uyvy | Self::Y10 | Self::Y12 | Self::Y16 => width.checked_mul(2),
            Self::Rgb3 | Self::Bgr3 => width.checked_mul(3),
            Self::Mjpeg => None,
        }
    }
}

/// Why a buffer is not a picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidPicture {
    /// Fewer bytes than the picture needs.
    #[error("only {found} of {needed} bytes received")]
    Short {
        /// Bytes received.
        found: usize,
        /// Bytes needed.
        needed: usize,
    },
    /// Rows or sizes that do not match.
    #[error("rows of {stride} bytes for {width} pixels of {format:?}")]
    Stride {
        /// Bytes from row to row.
        stride: usize,
        /// Pixels in a row.
        width: usize,
        /// Their format.
        format: PixelFormat,
    },
    /// A torn or invalid JPEG.
    #[error("{0}")]
    Jpeg(String),
}

/// Writes the grey values of a picture, `width * height` of them, row by row. Formats of more than
/// eight bits keep their upper eight.
///
/// `bytes` is what the driver reports as filled, `stride` the granted bytes from row to row; neither is trusted.
/// `samples` is reused memory of the JPEG decoder.
pub fn unpack_gray(
    format: PixelFormat,
    bytes: &[u8],
    stride: usize,
    (width, height): (usize, usize),
    samples: &mut Vec<u8>,
    gray: &mut [u8],
) -> Result<(), InvalidPicture> {
    let Some(row_bytes) = format.row_bytes(width) else {
        return decode_gray_into(bytes, width, height, samples, gray)
            .map_err(|error| InvalidPicture::Jpeg(error.to_string()));
    };
    if stride < row_bytes || width == 0 || gray.len() != width * height {
        return Err(InvalidPicture::Stride { stride, width, format });
    }
    // The last row needs no padding after it.
    let needed = height.saturating_sub(1).saturating_mul(stride).saturating_add(row_bytes);
    if bytes.len() < needed {
        return Err(InvalidPicture::Short { found: bytes.len(), needed });
    }
    for (gray, row) in gray.chunks_exact_mut(width).zip(bytes.chunks(stride)) {
        let row = &row[..row_bytes];
        match format {
            PixelFormat::Grey | PixelFormat::Nv12 => gray.copy_from_slice(row),
            PixelFormat::Yuyv => every_second(&row[..2 * width - 1], gray),
            PixelFormat::Uyvy => every_second(&row[1..], gray),
            PixelFormat::Y10 => upper_bits::<2>(row, gray),
            PixelFormat::Y12 => upper_bits::<4>(row, gray),
            PixelFormat::Rgb3 => gray_from_interleaved::<3>(row, gray),
            PixelFormat::Bgr3 => gray_from_bgr(row, gray),
            PixelFormat::Y16 | PixelFormat::Mjpeg => upper_bits::<8>(row, gray),
        }
    }
    Ok(())
}

/// Byte 0, 2, 4, …
fn every_second(row: &[u8], gray: &mut [u8]) {
    let whole = row.len() / 2;
    for (gray, pair) in gray.iter_mut().zip(row.chunks_exact(2)) {
        *gray = pair[0];
    }
    // An odd row ends with half a pair.
    if let (Some(gray), [last]) = (gray.get_mut(whole), row.chunks_exact(2).remainder()) {
        *gray = *last;
    }
}

/// Colour with blue first.
fn gray_from_bgr(row: &[u8], gray: &mut [u8]) {
    for (gray, pixel) in gray.iter_mut().zip(row.chunks_exact(3)) {
        *gray = gray_from_rgb([pixel[2], pixel[1], pixel[0]]);
    }
}

/// Little-endian values without their lower `SHIFT` bits; values that exceed eight bits are white.
fn upper_bits<const SHIFT: u32>(row: &[u8], gray: &mut [u8]) {
    for (gray, pair) in gray.iter_mut().zip(row.chunks_exact(2)) {
        *gray = (u16::from_le_bytes([pair[0], pair[1]]) >> SHIFT).min(255) as u8;
    }
}

/// Whether a granted layout has whole pictures whose rows can hold their pixels.
pub fn is_usable(layout: &Layout) -> bool {
    let Some(format) = PixelFormat::of(layout.code) else { return false };
    let row_bytes = format.row_bytes(layout.width as usize);
    layout.field == FIELD_NONE && row_bytes.is_none_or(|bytes| layout.stride as usize >= bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::test_images::flat_block_jpeg;
    use proptest::prelude::*;

    /// The grey value of one pixel, by the formats' definitions.
    fn gray_at(format: PixelFormat, bytes: &[u8], stride: usize, u: usize, v: usize) -> u8 {
        let row = &bytes[v * stride..];
        let wide = |shift: u32| {
            let value = u32::from(row[2 * u]) + 256 * u32::from(row[2 * u + 1]);
            (value / 2_u32.pow(shift)).min(255) as u8
        };
        match format {
            PixelFormat::Grey | PixelFormat::Nv12 => row[u],
            PixelFormat::Yuyv => row[2 * u],
            PixelFormat::Uyvy => row[2 * u + 1],
            PixelFormat::Y10 => wide(2),
            PixelFormat::Y12 => wide(4),
            PixelFormat::Y16 => wide(8),
            PixelFormat::Rgb3 => gray_from_rgb([row[3 * u], row[3 * u + 1], row[3 * u + 2]]),
            PixelFormat::Bgr3 => gray_from_rgb([row[3 * u + 2], row[3 * u + 1], row[3 * u]]),
            PixelFormat::Mjpeg => unreachable!("compressed"),
        }
    }

    fn raw_format() -> impl Strategy<Value = PixelFormat> {
        (0..PixelFormat::ALL.len() - 1).prop_map(|i| PixelFormat::ALL[i])
    }

    proptest! {
        #[test]
        fn every_pixel_is_that_of_the_definition(
            format in raw_format(),
            width in 1_usize..40,
            height in 1_usize..12,
            padding in 0_usize..9,
            surplus in 0_usize..20,
            seed in any::<u64>(),
        ) {
            let row_bytes = format.row_bytes(width).unwrap();
            let stride = row_bytes + padding;
            let length = (height - 1) * stride + row_bytes + surplus;
            let bytes: Vec<u8> = (0..length as u64)
                .map(|i| (i.wrapping_mul(seed | 1).wrapping_add(seed >> 7) >> 11) as u8)
                .collect();
            let mut gray = vec![0; width * height];
            let size = (width, height);
            unpack_gray(format, &bytes, stride, size, &mut Vec::new(), &mut gray).unwrap();
            for (i, &value) in gray.iter().enumerate() {
                let (u, v) = (i % width, i / width);
                prop_assert_eq!(value, gray_at(format, &bytes, stride, u, v), "({}, {})", u, v);
            }
        }

        #[test]
        fn hostile_sizes_are_refused(
            format in (0..PixelFormat::ALL.len()).prop_map(|i| PixelFormat::ALL[i]),
            width in 0_usize..40,
            height in 0_usize..12,
            stride in prop_oneof![0_usize..100, Just(usize::MAX), Just(usize::MAX / 2)],
            bytes in proptest::collection::vec(any::<u8>(), 0..400),
        ) {
            let mut gray = vec![0; width * height];
            let size = (width, height);
            let result = unpack_gray(format, &bytes, stride, size, &mut Vec::new(), &mut gray);
            let needed = format.row_bytes(width).map(|row| {
                (row, (height.max(1) - 1).saturating_mul(stride).saturating_add(row))
            });
            let fits = needed.is_some_and(|(row, all)| width > 0 && stride >= row && bytes.len() >= all);
            prop_assert_eq!(result.is_ok(), fits, "{:?}", result);
        }
    }

    #[test]
    fn formats_have_their_codes() {
        for format in PixelFormat::ALL {
            assert_eq!(PixelFormat::of(format.code()), Some(format));
        }
        assert_eq!(PixelFormat::Y16.code().to_string(), "Y16");
        assert_eq!(PixelFormat::of(FourCc::new(b"RGB4")), None);
        assert_eq!(FourCc(0x0a).to_string(), "");
    }

    #[test]
    fn a_torn_jpeg_is_refused() {
        let jpeg = flat_block_jpeg(32, 24, 3, false, |_, _, _| 90);
        let mut gray = vec![0; 32 * 24];
        let mut unpack = |bytes: &[u8]| {
            unpack_gray(PixelFormat::Mjpeg, bytes, 0, (32, 24), &mut Vec::new(), &mut gray)
                .map(|()| gray[100])
        };
        assert_eq!(unpack(&jpeg), Ok(90));
        // Cameras send their pictures in buffers of fixed size.
        assert_eq!(unpack(&[&jpeg[..], &[0; 64]].concat()), Ok(90));
        for length in [0, 1, jpeg.len() / 2, jpeg.len() - 2, jpeg.len() - 1] {
            assert!(matches!(unpack(&jpeg[..length]), Err(InvalidPicture::Jpeg(_))), "{length}");
        }
    }

    #[test]
    fn a_usable_grant_has_whole_pictures_with_room_for_their_rows() {
        let layout = |code: &[u8; 4], stride, field| Layout {
            code: FourCc::new(code),
            width: 640,
            height: 480,
            stride,
            field,
        };
        assert!(is_usable(&layout(b"GREY", 640, 1)) && is_usable(&layout(b"YUYV", 1280, 1)));
        assert!(is_usable(&layout(b"MJPG", 0, 1)));
        assert!(!is_usable(&layout(b"YUYV", 640, 1)), "rows too short");
        assert!(!is_usable(&layout(b"GREY", 640, 4)), "interlaced");
        assert!(!is_usable(&layout(b"RGB4", 2560, 1)), "not known");
    }
}
