//! Byte layout of a stream of frames: for each frame a header of 64 bytes, then the picture. All numbers are
//! little-endian; docs/sources.md has the table.

use crate::capture::decode_error::MAX_SIDE;
use crate::capture::v4l::pixel_format::PixelFormat;
use crate::capture::v4l::video_device::FourCc;

/// First bytes of every header; the digit is the version.
pub const MAGIC: [u8; 8] = *b"SDFRAME1";
/// Bytes of a header.
pub const HEADER_BYTES: usize = 64;
/// Longest plausible exposure, nanoseconds.
const MAX_EXPOSURE_NANOS: u64 = 60_000_000_000;
/// A JPEG is no larger than its pixels in colour plus a header.
const JPEG_BYTES_PER_PIXEL: u64 = 3;
const JPEG_HEADER_BYTES: u64 = 65_536;

/// The clock of a stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum StreamClock {
    /// CLOCK_MONOTONIC of this machine.
    Monotonic = 0,
    /// CLOCK_REALTIME, of this machine or of one that is synchronised with it.
    Realtime = 1,
    /// Any other: a recording's, a simulation's. Latency counts from arrival.
    Other = 2,
}

/// The header of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamHeader {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Bytes from row to row; 0 for a JPEG.
    pub stride: u32,
    /// The picture's format.
    pub format: PixelFormat,
    /// Bytes of the picture.
    pub bytes: u32,
    /// Clock of the stamp.
    pub clock: StreamClock,
    /// Middle of the exposure, nanoseconds.
    pub stamp_nanos: i64,
    /// Exposure time, nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// The sender's number of the frame: a gap means frames that it lost.
    pub sequence: u64,
    /// Sensor gain, 0 where unknown.
    pub gain: f32,
}

/// Why bytes are not the header of a frame.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum HeaderError {
    /// Anything but a stream of frames.
    #[error("not a stream of frames: a header does not begin with SDFRAME1")]
    Magic,
    /// An invalid size.
    #[error("an image of {0}x{1} pixels; a side has 1 to 8192")]
    Size(u32, u32),
    /// An unknown format.
    #[error("an image in the format `{0}`, which is not supported")]
    Format(FourCc),
    /// Rows too short for their pixels, or a JPEG that has rows.
    #[error("rows of {0} bytes, which do not fit the format and the width")]
    Stride(u32),
    /// More or fewer bytes than the picture needs.
    #[error("an image of {0} bytes, which do not fit its format and size")]
    Bytes(u32),
    /// An unknown clock.
    #[error("a stamp of clock {0}; 0 is CLOCK_MONOTONIC, 1 CLOCK_REALTIME, 2 any other")]
    Clock(u32),
    /// An invalid value, or a reserved field that is not zero.
    #[error("an exposure, gain, stamp or reserved field out of its range")]
    Value,
}

impl StreamHeader {
    /// A packed picture of 8-bit grey.
    pub fn gray(size: (u32, u32), clock: StreamClock, stamp_nanos: i64, sequence: u64) -> Self {
        let (width, height) = size;
        Self {
            width,
            height,
            stride: width,
            format: PixelFormat::Grey,
            bytes: width.saturating_mul(height),
            clock,
            stamp_nanos,
            exposure_nanos: 0,
            sequence,
            gain: 0.0,
        }
    }

    /// The header's bytes.
    pub fn to_bytes(&self) -> [u8; HEADER_BYTES] {
        let mut bytes = [0; HEADER_BYTES];
        let mut put = |at: usize, value: &[u8]| bytes[at..at + value.len()].copy_from_slice(value);
        put(0, &MAGIC);
        put(8, &self.width.to_le_bytes());
        put(12, &self.height.to_le_bytes());
        put(16, &self.stride.to_le_bytes());
        put(20, &self.format.code().0.to_le_bytes());
        put(24, &self.bytes.to_le_bytes());
        put(28, &(self.clock as u32).to_le_bytes());
        put(32, &self.stamp_nanos.to_le_bytes());
        put(40, &self.exposure_nanos.to_le_bytes());
        put(48, &self.sequence.to_le_bytes());
        put(56, &self.gain.to_le_bytes());
        bytes
    }

    /// Reads and checks a header.
    pub fn from_bytes(bytes: &[u8; HEADER_BYTES]) -> Result<Self, HeaderError> {
        let four = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        let word = |at: usize| u32::from_le_bytes(four(at));
        let long = |at: usize| u64::from(word(at)) | u64::from(word(at + 4)) << 32;
        if bytes[..MAGIC.len()] != MAGIC {
            return Err(HeaderError::Magic);
        }
        let code = FourCc(word(20));
        let clock = match word(28) {
            0 => StreamClock::Monotonic,
            1 => StreamClock::Realtime,
            2 => StreamClock::Other,
            other => return Err(HeaderError::Clock(other)),
        };
        let header = Self {
            width: word(8),
            height: word(12),
            stride: word(16),
            format: PixelFormat::of(code).ok_or(HeaderError::Format(code))?,
            bytes: word(24),
            clock,
            stamp_nanos: long(32) as i64,
            exposure_nanos: long(40),
            sequence: long(48),
            gain: f32::from_le_bytes(four(56)),
        };
        header.check()?;
        if word(60) == 0 { Ok(header) } else { Err(HeaderError::Value) }
    }

    fn check(&self) -> Result<(), HeaderError> {
        let sides = 1..=MAX_SIDE as u32;
        if !sides.contains(&self.width) || !sides.contains(&self.height) {
            return Err(HeaderError::Size(self.width, self.height));
        }
        let (width, height) = (u64::from(self.width), u64::from(self.height));
        let (stride, bytes) = (u64::from(self.stride), u64::from(self.bytes));
        match self.format.row_bytes(self.width as usize) {
            None if stride != 0 => return Err(HeaderError::Stride(self.stride)),
            None => {
                if bytes == 0 || bytes > JPEG_BYTES_PER_PIXEL * width * height + JPEG_HEADER_BYTES {
                    return Err(HeaderError::Bytes(self.bytes));
                }
            }
            Some(row) => {
                // No driver pads a row to twice its length.
                if stride < row as u64 || stride > 2 * row as u64 + 4096 {
                    return Err(HeaderError::Stride(self.stride));
                }
                let least = (height - 1) * stride + row as u64;
                // A plane of chroma may follow, and padding of the last row.
                if bytes < least || bytes > 2 * height * stride {
                    return Err(HeaderError::Bytes(self.bytes));
                }
            }
        }
        let is_gain = self.gain.is_finite() && self.gain >= 0.0;
        if !is_gain || self.exposure_nanos > MAX_EXPOSURE_NANOS || self.stamp_nanos < 0 {
            return Err(HeaderError::Value);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const GOOD: StreamHeader = StreamHeader {
        width: 640,
        height: 480,
        stride: 1280,
        format: PixelFormat::Yuyv,
        bytes: 614_400,
        clock: StreamClock::Realtime,
        stamp_nanos: 1_700_000_000_123_456_789,
        exposure_nanos: 8_000_000,
        sequence: u64::MAX,
        gain: 1.5,
    };

    #[test]
    fn a_header_survives_the_round_trip() {
        let gray = StreamHeader::gray((32, 24), StreamClock::Other, 5, 6);
        for header in [GOOD, gray] {
            assert_eq!(StreamHeader::from_bytes(&header.to_bytes()), Ok(header));
        }
        // The layout is a promise to other programs: spelled out once.
        let bytes = GOOD.to_bytes();
        assert_eq!(&bytes[..12], b"SDFRAME1\x80\x02\0\0");
        assert_eq!(&bytes[20..24], b"YUYV");
        assert_eq!(&bytes[32..40], &1_700_000_000_123_456_789_i64.to_le_bytes());
        assert_eq!(&bytes[60..], &[0; 4]);
    }

    #[test]
    fn invalid_headers_are_refused() {
        let refused = |change: &dyn Fn(&mut StreamHeader)| {
            let mut header = GOOD;
            change(&mut header);
            StreamHeader::from_bytes(&header.to_bytes()).unwrap_err()
        };
        assert_eq!(refused(&|h| h.width = 0), HeaderError::Size(0, 480));
        assert_eq!(refused(&|h| h.height = 8193), HeaderError::Size(640, 8193));
        assert_eq!(refused(&|h| h.stride = 1279), HeaderError::Stride(1279));
        assert_eq!(refused(&|h| h.stride = u32::MAX), HeaderError::Stride(u32::MAX));
        assert_eq!(refused(&|h| h.bytes = 614_399), HeaderError::Bytes(614_399));
        assert_eq!(refused(&|h| h.bytes = u32::MAX), HeaderError::Bytes(u32::MAX));
        assert_eq!(refused(&|h| h.gain = f32::NAN), HeaderError::Value);
        assert_eq!(refused(&|h| h.gain = -1.0), HeaderError::Value);
        assert_eq!(refused(&|h| h.exposure_nanos = u64::MAX), HeaderError::Value);
        assert_eq!(refused(&|h| h.stamp_nanos = -1), HeaderError::Value);
        let jpeg = |bytes| {
            let header = StreamHeader { format: PixelFormat::Mjpeg, stride: 0, bytes, ..GOOD };
            StreamHeader::from_bytes(&header.to_bytes())
        };
        assert!(jpeg(20_000).is_ok());
        assert_eq!(jpeg(0), Err(HeaderError::Bytes(0)));
        assert_eq!(jpeg(10_000_000), Err(HeaderError::Bytes(10_000_000)));
        let spoiled = |at: usize, value: u8| {
            let mut bytes = GOOD.to_bytes();
            bytes[at] = value;
            StreamHeader::from_bytes(&bytes).unwrap_err()
        };
        assert_eq!(spoiled(7, b'2'), HeaderError::Magic);
        assert_eq!(spoiled(20, b'?'), HeaderError::Format(FourCc::new(b"?UYV")));
        assert_eq!(spoiled(28, 3), HeaderError::Clock(3));
        assert_eq!(spoiled(63, 1), HeaderError::Value);
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_header_or_an_error(mut bytes in any::<[u8; HEADER_BYTES]>(), is_ours in any::<bool>()) {
            if is_ours {
                bytes[..8].copy_from_slice(&MAGIC);
                bytes[20..24].copy_from_slice(b"GREY");
                bytes[28..32].fill(0);
            }
            if let Ok(header) = StreamHeader::from_bytes(&bytes) {
                prop_assert_eq!(header.to_bytes(), bytes);
            }
        }
    }
}
