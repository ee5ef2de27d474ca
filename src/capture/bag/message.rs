//! The ROS 2 messages that are read, in CDR. Large fields borrow the file's bytes.

use byteorder::{BigEndian, LittleEndian};
use serde::Deserialize;

use crate::capture::ros_image::RosImage;

/// Bytes before a message: encoding and options.
const HEADER_BYTES: usize = 4;

/// Why bytes cannot be decoded as a message.
#[derive(Debug, thiserror::Error)]
pub enum CdrError {
    /// An encoding other than plain CDR.
    #[error("its encoding is not plain CDR")]
    Encoding,
    /// They end early, or hold an invalid value.
    #[error("{0}")]
    Content(#[from] cdr_encoding::Error),
}

/// Decodes a message from `bytes`; bytes after it are ignored, so that a type may be the beginning of others.
pub fn decode<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, CdrError> {
    let Some((header, content)) = bytes.split_at_checked(HEADER_BYTES) else {
        return Err(CdrError::Encoding);
    };
    match header {
        [0, 1, ..] => Ok(cdr_encoding::from_bytes::<T, LittleEndian>(content)?.0),
        [0, 0, ..] => Ok(cdr_encoding::from_bytes::<T, BigEndian>(content)?.0),
        _ => Err(CdrError::Encoding),
    }
}

/// `std_msgs/Header`, with which every message here begins.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Stamped {
    sec: i32,
    nanosec: u32,
    _frame_id: String,
}

impl Stamped {
    /// The stamp, nanoseconds.
    pub fn stamp_nanos(&self) -> i64 {
        i64::from(self.sec) * 1_000_000_000 + i64::from(self.nanosec)
    }
}

/// `sensor_msgs/Image`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Image<'a> {
    _header: Stamped,
    /// Height, pixels.
    pub height: u32,
    /// Width, pixels.
    pub width: u32,
    /// Format of a pixel.
    pub encoding: String,
    /// Whether numbers are big endian.
    pub is_bigendian: u8,
    /// Bytes from row to row.
    pub step: u32,
    /// The pixels.
    #[serde(with = "serde_bytes")]
    pub data: &'a [u8],
}

impl Image<'_> {
    /// The image without its header.
    pub fn as_ros(&self) -> RosImage<'_> {
        let &Self { height, width, ref encoding, is_bigendian, step, data, .. } = self;
        RosImage { encoding, width, height, step, is_bigendian: is_bigendian != 0, data }
    }
}

/// `sensor_msgs/CompressedImage`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct CompressedImage<'a> {
    _header: Stamped,
    _format: String,
    /// The encoded image file.
    #[serde(with = "serde_bytes")]
    pub data: &'a [u8],
}

/// `sensor_msgs/CameraInfo`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct CameraInfo {
    _header: Stamped,
    /// Height of the image, pixels.
    pub height: u32,
    /// Width of the image, pixels.
    pub width: u32,
    /// Name of the lens model.
    pub distortion_model: String,
    /// Coefficients of the lens.
    pub d: Vec<f64>,
    /// Intrinsics of the raw image, row-major 3×3.
    pub k: [f64; 9],
    _r: [f64; 9],
    /// Projection of the rectified image, row-major 3×4.
    pub p: [f64; 12],
    /// Sensor columns per pixel; 0 and 1 mean the same.
    pub binning_x: u32,
    /// Sensor rows per pixel.
    pub binning_y: u32,
    /// Offset, height and width of the image's region of the sensor; a width of 0 means all of it.
    pub roi: [u32; 4],
}

/// `semidense_msgs/Frame` of our own recordings.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct FrameRecord {
    /// Header of its image.
    pub header: Stamped,
    /// Number of the frame at its source.
    pub sequence: u64,
    /// Its stamp, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    _clock_nanos: i64,
    /// Exposure time in nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// Sensor gain, 0 where unknown.
    pub gain: f32,
}
