//! Grey values of a `sensor_msgs/Image`.

use crate::capture::bag::BagImageError;
use crate::capture::bag::message::Image;
use crate::capture::image_file::DecodeError;
use crate::slam::image::gray::gray_from_rgb;

/// How a pixel gives its grey value: bytes of a pixel, and what is made of them.
type Pixel = (usize, fn(&[u8]) -> u8);

/// The encodings of `sensor_msgs/image_encodings.hpp` that are read.
fn pixel_of(encoding: &str, is_bigendian: bool) -> Option<Pixel> {
    Some(match encoding {
        "mono8" | "8UC1" => (1, |p| p[0]),
        // The high byte: cameras fill 16 bits from the top.
        "mono16" | "16UC1" if is_bigendian => (2, |p| p[0]),
        "mono16" | "16UC1" => (2, |p| p[1]),
        "rgb8" => (3, |p| gray_from_rgb([p[0], p[1], p[2]])),
        "bgr8" | "8UC3" => (3, |p| gray_from_rgb([p[2], p[1], p[0]])),
        "rgba8" => (4, |p| gray_from_rgb([p[0], p[1], p[2]])),
        "bgra8" | "8UC4" => (4, |p| gray_from_rgb([p[2], p[1], p[0]])),
        // UYVY, by ROS's older name too: a luma in every second byte.
        "yuv422" | "uyvy" => (2, |p| p[1]),
        "yuv422_yuy2" | "yuyv" => (2, |p| p[0]),
        // The plane of luma comes first.
        "nv12" | "nv21" | "nv24" => (1, |p| p[0]),
        _ => return None,
    })
}

/// Writes the grey values of an image of `width * height` pixels, ITU-R BT.601's luma of colours.
pub fn gray_into(
    image: &Image<'_>,
    width: usize,
    height: usize,
    gray: &mut [u8],
) -> Result<(), BagImageError> {
    let found = (image.width as usize, image.height as usize);
    if found != (width, height) || gray.len() != width * height {
        return Err(DecodeError::Size { found, expected: (width, height) }.into());
    }
    let shown = || image.encoding.chars().take(40).collect::<String>();
    let (bytes, value) = pixel_of(&image.encoding, image.is_bigendian != 0)
        .ok_or_else(|| BagImageError::Encoding(shown()))?;
    let step = image.step as usize;
    // The last row may end with its last pixel.
    let needed = (height - 1).saturating_mul(step).saturating_add(width * bytes);
    if step < width * bytes || image.data.len() < needed {
        let (found, encoding) = (image.data.len(), shown());
        let needed = needed.max(height * width * bytes);
        return Err(BagImageError::Length { found, needed, width, height, encoding });
    }
    for (row, gray) in image.data.chunks(step).zip(gray.chunks_exact_mut(width)) {
        for (pixel, gray) in row.chunks_exact(bytes).zip(gray) {
            *gray = value(pixel);
        }
    }
    Ok(())
}
