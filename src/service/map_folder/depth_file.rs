//! The file of one keyframe in a map folder: its image and its depth, little-endian.
//!
//! Layout: magic, version, detail (u32), keyframe (u64), width, height, number of points, step of the image's grey
//! levels, whether brightnesses follow (u32), bytes of the image (u64), smallest and largest logarithm of the inverse
//! depths and of the standard deviations (4 × f32), bytes of the positions and of the description (u32); the
//! description (`description`), with a separate checksum, so that damage there costs nothing else; the points'
//! positions (`pixels`); the image; the points' numbers, row-major; the CRC-32 of all this except the description
//! (u32). Version 1 has no description, neither of the last two byte counts, and one bit per pixel for the positions.
//!
//! In full detail the image is unchanged (step 0) and a point has its inverse depth and variance (f32), and its
//! brightness (f32) where that differs from the image's: the same bits are read back. In small detail the image is a
//! PNG of grey levels rounded to a step; a point has logarithms of inverse depth (u16) and standard deviation (u8).

mod description;
mod pixels;

use std::borrow::Cow;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use zerocopy::{FromBytes, Immutable, IntoBytes};

use crate::capture::decode_error::DecodeError;
use crate::capture::png_image::{decode_gray_into, encode_gray_small};
use crate::service::bytes::take;
use crate::slam::keyframe::{DepthPoint, Keyframe, MAX_KEYFRAME_POINTS};
use crate::wire::conversion::{MessageError, check_points};

/// First bytes of the file.
const MAGIC: [u8; 16] = *b"semidense depth\n";
/// Version of the layout.
const VERSION: u32 = 2;
/// The previous version, which can still be read.
const PREVIOUS_VERSION: u32 = 1;
/// Bytes before the description, and before the positions in the previous version.
const HEAD_BYTES: usize = PREVIOUS_HEAD_BYTES + size_of::<PartBytes>();
const PREVIOUS_HEAD_BYTES: usize = size_of::<Head>();
/// Bytes of the checksum.
const CHECKSUM_BYTES: usize = 4;

/// In small detail an image takes at most 1 bit in 4 of its size (2 per pixel) where a step allows it…
const SMALL_IMAGE_SHARE: usize = 4;
/// …and this many pixels share one point: with its position, less than half a byte per pixel in all.
const SMALL_PIXELS_PER_POINT: usize = 28;
/// Steps of grey levels to try, finest first; the last one is used where none is small enough.
const SMALL_STEPS: [u8; 5] = [1, 2, 4, 8, 16];
/// Steps of the two logarithms.
const INVERSE_DEPTH_STEPS: f32 = u16::MAX as f32;
const STD_DEV_STEPS: f32 = u8::MAX as f32;

/// How much of a keyframe is kept on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MapDetail {
    /// All of it, bit for bit: about 1.1 MB at 640×480.
    #[default]
    Full,
    /// At most 0.13 MB at 640×480: grey levels are rounded, and one point in nine is kept, the best of each group.
    Small,
}

/// Why the file of a keyframe cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DepthFileError {
    /// It is not the file of a keyframe.
    #[error("it is not a keyframe of a map")]
    Magic,
    /// Another version wrote it.
    #[error("it has version {0}, but this program reads up to version {VERSION}")]
    Version(u32),
    /// It is cut short or too long.
    #[error("it has {found} bytes instead of {expected}")]
    Length {
        /// Bytes found.
        found: usize,
        /// Bytes according to its head.
        expected: usize,
    },
    /// A bit is wrong.
    #[error("its checksum is wrong: it is damaged")]
    Checksum,
    /// It belongs to another keyframe or to another image size.
    #[error("it belongs to another keyframe")]
    Foreign,
    /// A number in its head is invalid.
    #[error("invalid {what} = {value}")]
    Head {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: u64,
    },
    /// Its image cannot be decoded.
    #[error("its image {0}")]
    Image(#[from] DecodeError),
    /// Its points are invalid.
    #[error(transparent)]
    Points(#[from] MessageError),
}

/// Most bytes of the file of a keyframe with this many pixels.
pub fn max_file_bytes(num_pixels: usize) -> usize {
    // A PNG of noise is a little larger than its samples.
    let image = 2 * num_pixels + 4096;
    let points = pixels::bit_bytes(num_pixels) + 12 * MAX_KEYFRAME_POINTS;
    HEAD_BYTES + description::MAX_BYTES + image + points + CHECKSUM_BYTES
}

/// Most points that small detail keeps of an image with this many pixels.
fn max_small_points(num_pixels: usize) -> usize {
    num_pixels.div_ceil(SMALL_PIXELS_PER_POINT).min(MAX_KEYFRAME_POINTS)
}

/// The bytes of a keyframe that has image and depth, and its description if any. Its points are sorted; those outside
/// the image and all but one per pixel are left out.
pub fn encode(keyframe: &Keyframe, detail: MapDetail) -> Vec<u8> {
    let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
    let mut points = in_row_major_order(keyframe);
    let (mut step, mut coded, mut is_own_brightness) = (0, Cow::from(&keyframe.image[..]), false);
    match detail {
        MapDetail::Full => {
            is_own_brightness = points
                .iter()
                .any(|point| point.intensity != brightness(&keyframe.image, width, point));
        }
        MapDetail::Small => {
            points = best_of_groups(&points, max_small_points(width * height));
            let (by, small) = small_image(&keyframe.image, width, height);
            (step, coded) = (by, Cow::from(small));
        }
    }
    let depths = Logarithms::of(points.iter().map(|point| point.inverse_depth));
    let deviations = Logarithms::of(points.iter().map(|point| point.variance.sqrt()));
    let pixel = |point: &DepthPoint| usize::from(point.v) * width + usize::from(point.u);
    let places = pixels::encode(points.iter().map(pixel), width * height);
    let described = keyframe.description.as_deref().map(description::encode).unwrap_or_default();
    let head = Head {
        magic: MAGIC,
        version: VERSION,
        detail: u32::from(detail == MapDetail::Small),
        keyframe_id: keyframe.keyframe_id,
        width: width as u32,
        height: height as u32,
        num_points: points.len() as u32,
        step: u32::from(step),
        is_own_brightness: u32::from(is_own_brightness),
        image_bytes: coded.len() as u64,
        depths,
        deviations,
    };
    let sizes = PartBytes { places: places.len() as u32, description: described.len() as u32 };
    let mut bytes = Vec::with_capacity(max_file_bytes(width * height).min(1 << 21));
    for part in [head.as_bytes(), sizes.as_bytes(), &described, &places, &coded[..]] {
        bytes.extend(part);
    }
    for point in &points {
        match detail {
            MapDetail::Full => {
                bytes.extend([point.inverse_depth, point.variance].as_bytes());
                if is_own_brightness {
                    bytes.extend(point.intensity.to_le_bytes());
                }
            }
            MapDetail::Small => {
                let depth = depths.code(point.inverse_depth, INVERSE_DEPTH_STEPS) as u16;
                bytes.extend(depth.to_le_bytes());
                bytes.push(deviations.code(point.variance.sqrt(), STD_DEV_STEPS) as u8);
            }
        }
    }
    bytes.extend([0; CHECKSUM_BYTES]);
    seal(&mut bytes);
    bytes
}

/// Writes the correct checksum into a file's bytes.
pub fn seal(bytes: &mut [u8]) {
    let checksum = expected_checksum(bytes);
    if let Some(end) = bytes.last_chunk_mut::<CHECKSUM_BYTES>() {
        *end = checksum.to_le_bytes();
    }
}

/// The checksum of everything except the description.
fn expected_checksum(bytes: &[u8]) -> u32 {
    let mut rest = bytes;
    let parts = take_head(&mut rest).and_then(|(_, parts)| parts);
    let described = parts.map_or(0, |parts| parts.description as usize);
    let (head, body) = bytes.split_at(bytes.len() - rest.len());
    let body = body.get(described..).unwrap_or_default();
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(head);
    hasher.update(&body[..body.len().saturating_sub(CHECKSUM_BYTES)]);
    hasher.finalize()
}

/// The checksum at the end of a file's bytes; 0 where they are too few.
pub fn checksum_of(bytes: &[u8]) -> u32 {
    bytes.last_chunk::<CHECKSUM_BYTES>().map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

/// Gives `keyframe` the image and the points of its file, and the description where that is intact. On an error the
/// keyframe is unchanged.
pub fn decode_into(bytes: &[u8], keyframe: &mut Keyframe) -> Result<(), DepthFileError> {
    let mut rest = bytes;
    let (head, part_bytes) = take_head(&mut rest).ok_or(DepthFileError::Length {
        found: bytes.len(),
        expected: PREVIOUS_HEAD_BYTES + CHECKSUM_BYTES,
    })?;
    let sizes = head.check(part_bytes, keyframe)?;
    let parts = sizes.description + sizes.places + sizes.image + sizes.numbers;
    let expected = bytes.len() - rest.len() + parts + CHECKSUM_BYTES;
    if bytes.len() != expected {
        return Err(DepthFileError::Length { found: bytes.len(), expected });
    }
    if expected_checksum(bytes) != checksum_of(bytes) {
        return Err(DepthFileError::Checksum);
    }
    let (described, rest) = rest.split_at(sizes.description);
    let (places, rest) = rest.split_at(sizes.places);
    let (coded, rest) = rest.split_at(sizes.image);
    let numbers = &rest[..sizes.numbers];
    let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
    let image = match head.step {
        0 => coded.to_vec(),
        step => {
            let mut image = vec![0; width * height];
            decode_gray_into(coded, width, height, &mut Vec::new(), &mut image)?;
            image.iter_mut().for_each(|code| *code = level(*code, step as u8));
            image
        }
    };
    let pixels = pixels::decode(places, width * height, head.num_points as usize)
        .ok_or(DepthFileError::Head { what: "points", value: u64::from(head.num_points) })?;
    let mut points = Vec::with_capacity(pixels.len());
    for (pixel, number) in pixels.into_iter().zip(numbers.chunks_exact(sizes.a_point.max(1))) {
        let (u, v) = ((pixel % width) as u16, (pixel / width) as u16);
        let intensity = f32::from(image.get(pixel).copied().unwrap_or_default());
        points.push(head.point(number, DepthPoint { u, v, intensity, ..DepthPoint::default() }));
    }
    check_points(&points, &keyframe.intrinsics)?;
    let description = description::decode(described, &keyframe.intrinsics);
    (keyframe.image, keyframe.points) = (image.into(), points);
    keyframe.description = description.map(Arc::new);
    Ok(())
}

/// The head of a file, before its parts.
#[derive(FromBytes, IntoBytes, Immutable)]
#[repr(C, packed)]
struct Head {
    magic: [u8; 16],
    version: u32,
    detail: u32,
    keyframe_id: u64,
    width: u32,
    height: u32,
    num_points: u32,
    step: u32,
    is_own_brightness: u32,
    image_bytes: u64,
    depths: Logarithms,
    deviations: Logarithms,
}

/// The rest of the head since the second version.
#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
struct PartBytes {
    places: u32,
    description: u32,
}

fn take_head(bytes: &mut &[u8]) -> Option<(Head, Option<PartBytes>)> {
    let head: Head = take(bytes)?;
    let parts = if head.version == PREVIOUS_VERSION { None } else { Some(take(bytes)?) };
    Some((head, parts))
}

/// Bytes of the parts of a file.
struct Sizes {
    description: usize,
    places: usize,
    image: usize,
    numbers: usize,
    a_point: usize,
}

impl Head {
    /// Checks the head before any of it is trusted; returns the sizes of the parts.
    fn check(&self, parts: Option<PartBytes>, of: &Keyframe) -> Result<Sizes, DepthFileError> {
        if self.magic != MAGIC {
            return Err(DepthFileError::Magic);
        }
        if self.version != PREVIOUS_VERSION && self.version != VERSION {
            return Err(DepthFileError::Version(self.version));
        }
        let (width, height) = (of.intrinsics.width, of.intrinsics.height);
        let is_its = self.keyframe_id == of.keyframe_id
            && (self.width as usize, self.height as usize) == (width, height);
        if !is_its {
            return Err(DepthFileError::Foreign);
        }
        let is_small = self.detail == 1;
        let most_image = if is_small { max_file_bytes(width * height) } else { width * height };
        let bit_bytes = pixels::bit_bytes(width * height);
        let place_bytes = parts.map_or(bit_bytes, |parts| parts.places as usize);
        let description_bytes = parts.map_or(0, |parts| parts.description as usize);
        let checks = [
            ("detail", u64::from(self.detail), 1),
            ("points", u64::from(self.num_points), MAX_KEYFRAME_POINTS as u64),
            ("step", u64::from(self.step), if is_small { 255 } else { 0 }),
            ("brightness", u64::from(self.is_own_brightness), u64::from(!is_small)),
            ("image bytes", self.image_bytes, most_image as u64),
            ("place bytes", place_bytes as u64, bit_bytes as u64),
            ("description bytes", description_bytes as u64, description::MAX_BYTES as u64),
        ];
        let wrong = checks.into_iter().find(|(_, value, most)| value > most);
        let least_image = if is_small { 0 } else { most_image as u64 };
        let wrong = wrong
            .or((self.image_bytes < least_image).then_some(("image bytes", self.image_bytes, 0)))
            .or((is_small && self.step == 0).then_some(("step", 0, 0)));
        if let Some((what, value, _)) = wrong {
            return Err(DepthFileError::Head { what, value });
        }
        let a_point = match is_small {
            true => 3,
            false => 8 + 4 * self.is_own_brightness as usize,
        };
        Ok(Sizes {
            description: description_bytes,
            places: place_bytes,
            image: self.image_bytes as usize,
            numbers: self.num_points as usize * a_point,
            a_point,
        })
    }

    /// Decodes a point; `at` has the pixel and its brightness.
    fn point(&self, mut numbers: &[u8], at: DepthPoint) -> DepthPoint {
        if self.detail == 0 {
            let mut next = || take::<f32>(&mut numbers);
            return DepthPoint {
                inverse_depth: next().unwrap_or_default(),
                variance: next().unwrap_or_default(),
                intensity: next().unwrap_or(at.intensity),
                ..at
            };
        }
        let [low, high, deviation] = numbers.first_chunk::<3>().copied().unwrap_or_default();
        let code = f32::from(u16::from_le_bytes([low, high]));
        let std_dev = self.deviations.value(f32::from(deviation), STD_DEV_STEPS);
        DepthPoint {
            inverse_depth: self.depths.value(code, INVERSE_DEPTH_STEPS),
            variance: std_dev * std_dev,
            ..at
        }
    }
}

/// The range of the logarithms of some numbers, which are coded in equal steps of it.
#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
struct Logarithms {
    least: f32,
    most: f32,
}

impl Logarithms {
    fn of(numbers: impl Iterator<Item = f32>) -> Self {
        let logarithms = numbers.map(f32::ln).filter(|logarithm| logarithm.is_finite());
        let range = logarithms.fold(None, |range: Option<Self>, of| match range {
            Some(range) => Some(Self { least: range.least.min(of), most: range.most.max(of) }),
            None => Some(Self { least: of, most: of }),
        });
        range.unwrap_or(Self { least: 0.0, most: 0.0 })
    }

    fn code(&self, number: f32, steps: f32) -> f32 {
        let width = self.most - self.least;
        let share = if width > 0.0 { (number.ln() - self.least) / width } else { 0.0 };
        (share * steps).round().clamp(0.0, steps)
    }

    fn value(self, code: f32, steps: f32) -> f32 {
        (self.least + code / steps * (self.most - self.least)).exp()
    }
}

/// The points inside the image, in row-major order, one per pixel.
fn in_row_major_order(keyframe: &Keyframe) -> Vec<DepthPoint> {
    let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
    let inside = |p: &&DepthPoint| usize::from(p.u) < width && usize::from(p.v) < height;
    let mut points: Vec<DepthPoint> = keyframe.points.iter().filter(inside).copied().collect();
    let pixel = |point: &DepthPoint| (point.v, point.u);
    if !points.is_sorted_by_key(pixel) {
        points.sort_by_key(pixel);
    }
    points.dedup_by_key(|point| pixel(point));
    points
}

/// At most `most` points: of each group of consecutive points the one with the lowest relative variance.
fn best_of_groups(points: &[DepthPoint], most: usize) -> Vec<DepthPoint> {
    let group = points.len().div_ceil(most.max(1)).max(1);
    let spread = |p: &DepthPoint| p.variance / (p.inverse_depth * p.inverse_depth);
    let is_usable = |p: &&DepthPoint| p.inverse_depth > 0.0 && p.variance > 0.0;
    let best = |group: &[DepthPoint]| {
        group.iter().filter(is_usable).min_by(|a, b| spread(a).total_cmp(&spread(b))).copied()
    };
    points.chunks(group).filter_map(best).collect()
}

fn brightness(image: &[u8], width: usize, at: &DepthPoint) -> f32 {
    let pixel = usize::from(at.v) * width + usize::from(at.u);
    f32::from(image.get(pixel).copied().unwrap_or_default())
}

/// The image as a PNG in the finest step of grey levels that is small enough, and that step.
fn small_image(image: &[u8], width: usize, height: usize) -> (u8, Vec<u8>) {
    let mut smallest = (0, Vec::new());
    for step in SMALL_STEPS {
        let codes: Vec<u8> = image.iter().map(|grey| grey / step).collect();
        // Into memory, of the right size: cannot fail.
        smallest = (step, encode_gray_small(width, height, &codes).unwrap_or_default());
        if smallest.1.len() <= image.len() / SMALL_IMAGE_SHARE {
            break;
        }
    }
    smallest
}

/// The grey level in the middle of a step.
fn level(code: u8, step: u8) -> u8 {
    code.saturating_mul(step).saturating_add(step / 2)
}

#[cfg(test)]
mod tests;
