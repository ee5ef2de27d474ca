//! Appearance of an image: corners at several scales, each with an orientation and a binary descriptor (Rublee et al.
//! 2011).

use std::cmp::Reverse;

use super::corners::{Corner, CornerFinder};
use super::pattern::{ORIENTATIONS, Pattern, RADIUS_PX, WORDS};
use super::scales::{self, MAX_SCALES, Scale};
use crate::slam::image::NO_DATA;

/// Maximum number of features of an image.
pub const MAX_FEATURES: usize = 200;

/// A corner and its surroundings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Feature {
    /// Its position in the image.
    pub place: FeaturePlace,
    /// Results of the comparisons between surrounding pixels: which are darker than others.
    pub bits: [u64; WORDS],
}

/// Position of a feature in its image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FeaturePlace {
    /// Column, pixels of the image.
    pub u: u16,
    /// Row.
    pub v: u16,
    /// Step of its direction, 32 per turn.
    pub orientation: u8,
    /// Scale at which it was found.
    pub scale: u8,
}

/// Appearance of an image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Description {
    /// Size of the image, pixels.
    pub(super) width: u16,
    pub(super) height: u16,
    pub(super) features: Vec<Feature>,
    /// For each feature, comparisons that noise may flip; empty if read from disk.
    pub(super) unsure: Vec<[u64; WORDS]>,
}

impl Description {
    /// From stored features of an image of this size; `None` where one does not fit such an image, or there are none,
    /// or too many.
    pub fn of_features(width: usize, height: usize, features: Vec<Feature>) -> Option<Self> {
        let is_possible = |Feature { place, .. }: &Feature| {
            usize::from(place.u) < width
                && usize::from(place.v) < height
                && usize::from(place.orientation) < ORIENTATIONS
                && usize::from(place.scale) < MAX_SCALES
        };
        let is_some = (1..=MAX_FEATURES).contains(&features.len());
        let (width, height) = (u16::try_from(width), u16::try_from(height));
        (is_some && features.iter().all(is_possible)).then_some(())?;
        Some(Self { width: width.ok()?, height: height.ok()?, features, unsure: Vec::new() })
    }

    /// Its features.
    pub fn features(&self) -> &[Feature] {
        &self.features
    }
}

/// Describes images; owns the memory for that.
#[derive(Debug, Clone, Default)]
pub struct Describer {
    pattern: Pattern,
    scales: Vec<Scale>,
    sums: Vec<u16>,
    finder: CornerFinder,
    corners: Vec<Corner>,
    chosen: Vec<Corner>,
}

impl Describer {
    /// Describes an image, given row by row; `None` where it is too small, or shows nothing.
    pub fn describe(&mut self, pixels: &[u8], width: usize, height: usize) -> Option<Description> {
        /// Least side of a scale.
        const MIN_SIDE_PX: usize = 72;
        let is_sized = |side: usize| (MIN_SIDE_PX..=usize::from(u16::MAX)).contains(&side);
        if !is_sized(width) || !is_sized(height) || pixels.len() != width * height {
            return None;
        }
        scales::fill(&mut self.scales, pixels, width, height, &mut self.sums);
        let mut description = Description {
            width: width as u16,
            height: height as u16,
            features: Vec::with_capacity(MAX_FEATURES),
            unsure: Vec::with_capacity(MAX_FEATURES),
        };
        let areas: Vec<usize> = self.scales.iter().map(|s| s.width * s.height).collect();
        // The smallest scales first: their unused budget goes to the larger ones.
        for k in (0..self.scales.len()).rev() {
            let left = MAX_FEATURES - description.features.len();
            let share = areas[k] as f32 / areas[..=k].iter().sum::<usize>() as f32;
            let budget = if k == 0 { left } else { (left as f32 * share).ceil() as usize };
            let scale = &self.scales[k];
            for threshold in THRESHOLDS {
                let Scale { pixels, width, height, .. } = scale;
                self.finder.find(pixels, *width, *height, MARGIN_PX, threshold, &mut self.corners);
                if pixels.contains(&NO_DATA) {
                    self.corners.retain(|corner| is_whole(scale, corner));
                }
                if self.corners.len() >= MIN_CORNERS * budget {
                    break;
                }
            }
            choose(&mut self.corners, scale, budget, &mut self.chosen);
            for corner in &self.chosen {
                let (feature, unsure) = feature(scale, k, corner, &self.pattern);
                description.features.push(feature);
                description.unsure.push(unsure);
            }
        }
        (!description.features.is_empty()).then_some(description)
    }
}

/// Grey levels by which the circle around a corner differs: for clear corners, and where there are few of them just
/// above the noise of a small sensor.
const THRESHOLDS: [u8; 2] = [24, 8];
/// Corners that are enough to choose from, as a multiple of those wanted.
const MIN_CORNERS: usize = 3;
/// Pixels that a descriptor needs to the edge.
const MARGIN_PX: usize = RADIUS_PX as usize + 1;

/// Whether all of the pixels that describe a corner have data.
fn is_whole(scale: &Scale, corner: &Corner) -> bool {
    let (u, v) = (usize::from(corner.u), usize::from(corner.v));
    let mut rows =
        scale.pixels.chunks_exact(scale.width).skip(v - MARGIN_PX).take(2 * MARGIN_PX + 1);
    rows.all(|row| !row[u - MARGIN_PX..=u + MARGIN_PX].contains(&NO_DATA))
}

/// Chooses the strongest corners, spread over the image.
fn choose(corners: &mut [Corner], scale: &Scale, budget: usize, chosen: &mut Vec<Corner>) {
    /// Cells of the image that share the corners.
    const PARTS: [usize; 2] = [8, 6];
    /// Most corners of a cell, as a multiple of its share.
    const MAX_CELL_SHARES: usize = 3;
    /// Strongest corners that are considered, as a multiple of those wanted.
    const MAX_CONSIDERED: usize = 10;
    let most = (MAX_CELL_SHARES * budget).div_ceil(PARTS[0] * PARTS[1]);
    let mut counts = [0usize; PARTS[0] * PARTS[1]];
    let strongest = |corner: &Corner| (Reverse(corner.strength), corner.v, corner.u);
    let few = MAX_CONSIDERED * budget;
    let corners = match corners.len() > few && few > 0 {
        true => corners.select_nth_unstable_by_key(few, strongest).0,
        false => corners,
    };
    corners.sort_unstable_by_key(strongest);
    chosen.clear();
    for corner in corners.iter() {
        if chosen.len() == budget {
            break;
        }
        let column = usize::from(corner.u) * PARTS[0] / scale.width;
        let row = usize::from(corner.v) * PARTS[1] / scale.height;
        let count = &mut counts[row * PARTS[0] + column];
        if *count < most {
            *count += 1;
            chosen.push(*corner);
        }
    }
}

/// A corner's feature, and which comparisons are close.
fn feature(
    scale: &Scale,
    level: usize,
    corner: &Corner,
    pattern: &Pattern,
) -> (Feature, [u64; WORDS]) {
    let at = usize::from(corner.v) * scale.width + usize::from(corner.u);
    let orientation = orientation(scale, at);
    let width = scale.width as isize;
    let grey = |[x, y]: [i8; 2]| {
        let offset = y as isize * width + x as isize;
        i32::from(scale.blurred[at.wrapping_add_signed(offset)])
    };
    let mut bits = [0u64; WORDS];
    let mut differences = [0i16; 64 * WORDS];
    let mut sum = 0i32;
    for (k, [a, b]) in pattern.turned(orientation).iter().enumerate() {
        let difference = grey(*a) - grey(*b);
        bits[k / 64] |= u64::from(difference < 0) << (k % 64);
        differences[k] = difference.abs() as i16;
        sum += difference.abs();
    }
    // A third of the mean difference.
    let limit = (sum / (3 * 64 * WORDS as i32)) as i16;
    let mut unsure = [0u64; WORDS];
    for (k, difference) in differences.iter().enumerate() {
        unsure[k / 64] |= u64::from(*difference <= limit) << (k % 64);
    }
    let pixel = |k: u16| ((f32::from(k) + 0.5) * scale.factor - 0.5).round() as u16;
    let place =
        FeaturePlace { u: pixel(corner.u), v: pixel(corner.v), orientation, scale: level as u8 };
    (Feature { place, bits }, unsure)
}

/// Direction of the intensity centroid (Rosin 1999).
fn orientation(scale: &Scale, at: usize) -> u8 {
    let (mut across, mut down) = (0i32, 0i32);
    for y in -RADIUS_PX..=RADIUS_PX {
        let half = ((RADIUS_PX * RADIUS_PX - y * y) as f32).sqrt() as i32;
        let begin = at.wrapping_add_signed(y as isize * scale.width as isize - half as isize);
        let row = &scale.blurred[begin..begin + 2 * half as usize + 1];
        let mut sum = 0i32;
        for (x, grey) in (-half..=half).zip(row) {
            sum += i32::from(*grey);
            across += x * i32::from(*grey);
        }
        down += y * sum;
    }
    let turns = (down as f64).atan2(across as f64) / std::f64::consts::TAU;
    (turns * ORIENTATIONS as f64).round().rem_euclid(ORIENTATIONS as f64) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::places::tree::distance;
    use crate::slam::test_scene::{CAMERA, Scene};

    fn image() -> Vec<u8> {
        Scene::new(3).render(&CAMERA, &SE3::identity()).noisy(2.0, 1)
    }

    fn described(pixels: &[u8], width: usize, height: usize) -> Description {
        Describer::default().describe(pixels, width, height).unwrap()
    }

    /// Share of the features of one that another has within a few pixels, rotated by so many steps, with similar bits.
    fn share_found(
        one: &Description,
        other: &Description,
        turn: u8,
        map: impl Fn(&FeaturePlace) -> [f32; 2],
    ) -> f32 {
        let found = one.features.iter().filter(|a| {
            other.features.iter().any(|b| {
                let [u, v] = map(&a.place);
                let near = (u - f32::from(b.place.u)).hypot(v - f32::from(b.place.v)) <= 3.0;
                let turned = (a.place.orientation + turn + 1 + 32 - b.place.orientation) % 32 <= 2;
                near && turned && distance(&a.bits, &b.bits) <= 40
            })
        });
        found.count() as f32 / one.features.len() as f32
    }

    #[test]
    fn features_are_found_again_under_different_lighting() {
        let pixels = image();
        let (width, height) = (CAMERA.width, CAMERA.height);
        let here = described(&pixels, width, height);
        assert!(here.features.len() > 150, "{}", here.features.len());
        let darker: Vec<u8> = pixels.iter().map(|&grey| grey / 2 + 9).collect();
        let share =
            share_found(&here, &described(&darker, width, height), 0, |p| [p.u.into(), p.v.into()]);
        assert!(share > 0.6, "{share}");
    }

    #[test]
    fn features_are_found_again_in_a_rotated_image() {
        let pixels = image();
        let (width, height) = (CAMERA.width, CAMERA.height);
        // Right becomes down: column u of the new image is row height − 1 − u of the old.
        let turned: Vec<u8> = (0..width * height)
            .map(|k| pixels[(height - 1 - k % height) * width + k / height])
            .collect();
        let here = described(&pixels, width, height);
        let there = described(&turned, height, width);
        let quarter = ORIENTATIONS as u8 / 4;
        let to = |p: &FeaturePlace| [(height - 1) as f32 - f32::from(p.v), f32::from(p.u)];
        let share = share_found(&here, &there, quarter, to);
        assert!(share > 0.6, "{share}");
        let unturned = share_found(&here, &there, 0, to);
        assert!(unturned < 0.1, "{unturned}");
    }

    #[test]
    fn features_are_found_again_at_half_the_size() {
        let (width, height) = (CAMERA.width, CAMERA.height);
        let pixels = image();
        let half: Vec<u8> = (0..width / 2 * (height / 2))
            .map(|k| {
                let at = 2 * (k / (width / 2)) * width + 2 * (k % (width / 2));
                let four = [at, at + 1, at + width, at + width + 1];
                (four.iter().map(|&at| u32::from(pixels[at])).sum::<u32>() / 4) as u8
            })
            .collect();
        let small = described(&half, width / 2, height / 2);
        let here = described(&pixels, width, height);
        let share = share_found(&small, &here, 0, |p| [2.0 * f32::from(p.u), 2.0 * f32::from(p.v)]);
        assert!(share > 0.2, "{share}");
        let beside =
            share_found(&small, &here, 0, |p| [2.0 * f32::from(p.u) + 20.0, 2.0 * f32::from(p.v)]);
        assert!(beside < 0.05, "{beside}");
    }

    #[test]
    fn an_image_that_is_too_small_or_shows_nothing_has_no_description() {
        let mut describer = Describer::default();
        assert!(describer.describe(&[70; 320 * 240], 320, 240).is_none(), "a wall");
        assert!(describer.describe(&[70; 40 * 40], 40, 40).is_none());
        assert!(describer.describe(&[70; 100], 320, 240).is_none());
        assert!(describer.describe(&[], 0, 0).is_none());
        assert!(describer.describe(&[], usize::MAX, 2).is_none());
    }

    #[test]
    fn a_describer_gives_the_same_whatever_it_described_before() {
        let pixels = image();
        let mut used = Describer::default();
        let _other = used.describe(&[9; 640 * 480], 640, 480);
        let _small = used.describe(&pixels[..100 * 100], 100, 100);
        let again = used.describe(&pixels, CAMERA.width, CAMERA.height);
        assert_eq!(again, Describer::default().describe(&pixels, CAMERA.width, CAMERA.height));
    }

    #[test]
    fn no_feature_includes_pixels_that_a_mask_hides() {
        let (width, height) = (CAMERA.width, CAMERA.height);
        let mut pixels = image();
        let bare = described(&pixels, width, height);
        let is_hidden = |u: usize, v: usize| v > height / 2 && u > width / 3;
        for (i, grey) in
            pixels.iter_mut().enumerate().filter(|(i, _)| is_hidden(i % width, i / width))
        {
            *grey = if i % 2 == 0 { NO_DATA } else { *grey };
        }
        let is_clear = |feature: &Feature| {
            let (u, v) = (f32::from(feature.place.u), f32::from(feature.place.v));
            u < width as f32 / 3.0 - 10.0 || v < height as f32 / 2.0 - 10.0
        };
        assert!(!bare.features.iter().all(is_clear));
        let masked = described(&pixels, width, height);
        assert!(masked.features.len() > 50 && masked.features.iter().all(is_clear));
    }
}
