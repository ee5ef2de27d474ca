//! Maps the pixels of a keyframe with depth to their points: two bits per pixel instead of an image.

use crate::slam::keyframe::{DepthPoint, Keyframe};

/// Pixels per word.
const WORD: usize = u64::BITS as usize;

/// A bit for each pixel with depth, and the number of points before each word.
#[derive(Debug, Clone)]
pub(super) struct PixelIndex {
    width: usize,
    height: usize,
    /// At least one bit more than there are pixels.
    words: Vec<u64>,
    before: Vec<u32>,
}

impl PixelIndex {
    /// Indexes a keyframe; `None` where its points lie outside its image or are not in row-major order.
    pub fn of(keyframe: &Keyframe) -> Option<Self> {
        let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
        let mut words = vec![0u64; width * height / WORD + 1];
        let mut next = 0;
        for point in &keyframe.points {
            let (u, v) = (usize::from(point.u), usize::from(point.v));
            let at = v * width + u;
            if u >= width || v >= height || at < next {
                return None;
            }
            words[at / WORD] |= 1 << (at % WORD);
            next = at + 1;
        }
        let mut sum = 0;
        let before = words
            .iter()
            .map(|word| {
                let before = sum;
                sum += word.count_ones();
                before
            })
            .collect();
        Some(Self { width, height, words, before })
    }

    /// The point of a pixel, out of the keyframe's list; `None` outside the image and where there is none.
    pub fn get<'a>(&self, points: &'a [DepthPoint], u: i32, v: i32) -> Option<&'a DepthPoint> {
        let (u, v) = (usize::try_from(u).ok()?, usize::try_from(v).ok()?);
        if u >= self.width || v >= self.height {
            return None;
        }
        let at = v * self.width + u;
        let is_set = self.words[at / WORD] >> (at % WORD) & 1 == 1;
        if is_set { points.get(self.num_before(at)) } else { None }
    }

    /// The points of the square that extends `radius` pixels from (u, v) to each side, row by row.
    pub fn around<'a>(
        &self,
        points: &'a [DepthPoint],
        [u, v]: [u16; 2],
        radius: usize,
    ) -> impl Iterator<Item = &'a DepthPoint> {
        let (u, v) = (usize::from(u), usize::from(v));
        let (left, right) = (u.saturating_sub(radius), (u + radius + 1).min(self.width));
        let rows = v.saturating_sub(radius)..(v + radius + 1).min(self.height);
        rows.flat_map(move |row| {
            let [begin, end] = [left, right].map(|u| self.num_before(row * self.width + u));
            points.get(begin..end).unwrap_or_default()
        })
    }

    /// Number of points before a pixel.
    fn num_before(&self, at: usize) -> usize {
        let below = self.words[at / WORD] & ((1 << (at % WORD)) - 1);
        (self.before[at / WORD] + below.count_ones()) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::sim3::Sim3;

    fn keyframe(pixels: &[(u16, u16)]) -> Keyframe {
        let point = |&(u, v)| DepthPoint { u, v, intensity: f32::from(u), ..DepthPoint::default() };
        let points = pixels.iter().map(point).collect();
        Keyframe::at(Sim3::identity(), Intrinsics::pinhole(100, 3, 50.0), points, Vec::new())
    }

    #[test]
    fn every_pixel_with_depth_is_found_and_no_other() {
        let pixels = [(0, 0), (63, 0), (64, 0), (99, 0), (0, 1), (28, 1), (27, 2), (99, 2)];
        let keyframe = keyframe(&pixels);
        let index = PixelIndex::of(&keyframe).unwrap();
        for v in -1..4 {
            for u in -1..101 {
                let found = index.get(&keyframe.points, u, v).map(|point| (point.u, point.v));
                let is_known = pixels.iter().any(|&(a, b)| (i32::from(a), i32::from(b)) == (u, v));
                assert_eq!(found.is_some(), is_known, "{u} {v}");
                assert!(found.is_none_or(|(a, b)| (i32::from(a), i32::from(b)) == (u, v)));
            }
        }
        let around = |u, v, radius| -> Vec<(u16, u16)> {
            let found = index.around(&keyframe.points, [u, v], radius);
            found.map(|point| (point.u, point.v)).collect()
        };
        assert_eq!(around(63, 0, 1), [(63, 0), (64, 0)]);
        assert_eq!(around(28, 2, 1), [(28, 1), (27, 2)]);
        assert_eq!(around(99, 2, 2), [(99, 0), (99, 2)]);
        assert_eq!(around(50, 1, 200), pixels);
    }

    #[test]
    fn points_out_of_order_or_outside_the_image_are_refused() {
        for pixels in [
            [(5, 0), (4, 0)],
            [(5, 0), (5, 0)],
            [(0, 1), (99, 0)],
            [(0, 0), (100, 0)],
            [(0, 0), (0, 3)],
        ] {
            assert!(PixelIndex::of(&keyframe(&pixels)).is_none(), "{pixels:?}");
        }
    }
}
