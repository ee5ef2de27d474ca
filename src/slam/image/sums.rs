//! The pyramid that alignment reads: each pixel of level l is the **sum** of the 4ˡ level-0 pixels that it covers.
//!
//! Sums of bytes are exact in 16 bits up to level 4: no level is rounded, two neighbours fit one 32-bit load, and the
//! memory traffic is half that of f32. A sum times [`grey_per_sum`] is the 2×2 mean of means of the notation. It is 0,
//! no data, where any of the pixels has none.

use crate::slam::image::buffer::Image;

/// Maximum number of levels: 255 · 4⁴ = 65 280 is the largest sum that 16 bits hold.
pub const MAX_LEVELS: usize = 5;

/// Contrast below which an image is blank, grey levels: covered lens, overexposure, a white wall.
pub const MIN_CONTRAST: f64 = 2.0;

/// Factor from a pixel of `level` to grey levels.
pub fn grey_per_sum(level: usize) -> f32 {
    1.0 / (1u32 << (2 * level)) as f32
}

/// Sums of one frame by level.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SumPyramid {
    width: usize,
    height: usize,
    finest_level: usize,
    levels: Vec<Image<u16>>,
}

impl SumPyramid {
    /// Allocates `num_levels` (at most [`MAX_LEVELS`]) levels over a `width * height` image. Levels below
    /// `finest_level` (at most 1) are never filled and take no memory.
    pub fn with_size(width: usize, height: usize, num_levels: usize, finest_level: usize) -> Self {
        let finest_level = finest_level.min(1);
        let levels = (0..num_levels.min(MAX_LEVELS))
            .map(|l| match l < finest_level {
                true => Image::filled(0, 0, 0),
                false => Image::filled(width >> l, height >> l, 0),
            })
            .collect();
        Self { width, height, finest_level, levels }
    }

    /// Whether this pyramid has the levels of an image of this size.
    pub fn has_size(&self, width: usize, height: usize, levels: usize, finest: usize) -> bool {
        (self.width, self.height) == (width, height)
            && self.levels.len() == levels.min(MAX_LEVELS)
            && self.finest_level == finest.min(1)
    }

    /// Fills every level from the grey values of level 0. Does nothing if their number differs (callers check it where
    /// the frame enters).
    pub fn fill(&mut self, pixels: &[u8]) {
        if pixels.len() != self.width * self.height {
            return;
        }
        if self.finest_level == 0
            && let Some(base) = self.levels.first_mut()
        {
            for (out, &grey) in base.pixels_mut().iter_mut().zip(pixels) {
                *out = u16::from(grey);
            }
        }
        if let Some(first) = self.levels.get_mut(1) {
            halve(pixels, self.width, first);
        }
        for level in 2..self.levels.len() {
            let (fine, coarse) = self.levels.split_at_mut(level);
            halve(fine[level - 1].pixels(), fine[level - 1].width(), &mut coarse[0]);
        }
    }

    /// The sums of one level; empty below the finest.
    pub fn level(&self, level: usize) -> &Image<u16> {
        &self.levels[level]
    }

    /// Standard deviation of the coarsest level's pixels with data, grey levels: noise averages out there.
    pub fn contrast(&self) -> f64 {
        let Some(coarsest) = self.levels.last() else { return 0.0 };
        let sums = coarsest.pixels().iter().filter(|&&sum| sum > 0).map(|&sum| f64::from(sum));
        let count = sums.clone().count().max(1) as f64;
        let mean = sums.clone().sum::<f64>() / count;
        let squared = sums.map(|sum| (sum - mean).powi(2)).sum::<f64>();
        (squared / count).sqrt() * f64::from(grey_per_sum(self.levels.len() - 1))
    }

    /// Number of levels, including those below the finest.
    pub fn num_levels(&self) -> usize {
        self.levels.len()
    }

    /// Finest level that is filled: 0 or 1.
    pub fn finest_level(&self) -> usize {
        self.finest_level
    }
}

/// Sums of 2×2 numbers in rows of `width`; 0 where any of them is.
fn halve<T: Copy + Into<u16>>(fine: &[T], width: usize, coarse: &mut Image<u16>) {
    let coarse_width = coarse.width();
    if coarse_width == 0 {
        return;
    }
    let rows = fine.chunks_exact(2 * width);
    for (out, rows) in coarse.pixels_mut().chunks_exact_mut(coarse_width).zip(rows) {
        let (upper, lower) = rows.split_at(width);
        let pairs = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
        for (out, (&up, &low)) in out.iter_mut().zip(pairs) {
            let [[a, b], [c, d]] = [up, low].map(|pair| pair.map(Into::into));
            // Cannot overflow (MAX_LEVELS); wrapping spares the check.
            let sum = a.wrapping_add(b).wrapping_add(c.wrapping_add(d));
            *out = if a.min(b).min(c.min(d)) == 0 { 0 } else { sum };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::image::NO_DATA;

    #[test]
    fn every_level_is_the_exact_sum_even_for_odd_sizes() {
        let (width, height) = (77, 53);
        let pixels: Vec<u8> = (0..width * height).map(|i| (1 + i * 7919 % 255) as u8).collect();
        for finest in 0..2 {
            let mut pyramid = SumPyramid::with_size(width, height, 4, finest);
            pyramid.fill(&pixels);
            for level in finest..4 {
                let image = pyramid.level(level);
                assert_eq!((image.width(), image.height()), (width >> level, height >> level));
                for v in 0..image.height() {
                    for u in 0..image.width() {
                        let side = 1 << level;
                        let sum: u32 = (0..side * side)
                            .map(|i| (u * side + i % side, v * side + i / side))
                            .map(|(x, y)| u32::from(pixels[y * width + x]))
                            .sum();
                        assert_eq!(u32::from(image.at(u, v)), sum, "level {level} at {u}, {v}");
                    }
                }
            }
        }
    }

    #[test]
    fn white_does_not_overflow_at_the_coarsest_level() {
        let mut pyramid = SumPyramid::with_size(64, 64, 9, 1);
        pyramid.fill(&[255; 64 * 64]);
        assert_eq!(pyramid.num_levels(), MAX_LEVELS);
        let top = f32::from(pyramid.level(MAX_LEVELS - 1).at(3, 3));
        assert_eq!(top * grey_per_sum(MAX_LEVELS - 1), 255.0);
    }

    #[test]
    fn pixels_of_another_size_are_ignored() {
        let mut pyramid = SumPyramid::with_size(32, 32, 3, 0);
        pyramid.fill(&[9; 31 * 32]);
        assert_eq!(pyramid.level(2).at(1, 1), 0);
    }

    #[test]
    fn a_sum_that_includes_a_pixel_without_data_has_none_and_is_left_out_of_the_contrast() {
        let mut pixels = vec![100; 32 * 32];
        pixels[5 * 32 + 9] = NO_DATA;
        let mut pyramid = SumPyramid::with_size(32, 32, 4, 0);
        pyramid.fill(&pixels);
        for level in 0..4 {
            let image = pyramid.level(level);
            let missing = image.pixels().iter().filter(|&&sum| sum == 0).count();
            assert_eq!((missing, image.at(9 >> level, 5 >> level)), (1, 0), "level {level}");
        }
        assert_eq!(pyramid.contrast(), 0.0);
    }
}
