//! The image pyramid: level l+1 is the 2×2 mean of level l; sizes halve, rounding down. Pixels without data are NaN, and
//! with them every mean and every sample that includes one.

use crate::slam::image::NO_DATA;
use crate::slam::image::buffer::Image;

/// Grey levels of one frame as f32, finest first.
#[derive(Debug, Clone)]
pub struct Pyramid {
    levels: Vec<Image<f32>>,
}

impl Pyramid {
    /// Allocates a pyramid of `levels` levels over a `width * height` image.
    pub fn with_size(width: usize, height: usize, levels: usize) -> Self {
        let levels = (0..levels).map(|l| Image::filled(width >> l, height >> l, 0.0)).collect();
        Self { levels }
    }

    /// Fills every level from the grey values of level 0. Does nothing when the size differs
    /// (callers check it where the frame enters).
    pub fn fill(&mut self, pixels: &[u8]) {
        let Some(base) = self.levels.first_mut() else { return };
        if base.pixels().len() != pixels.len() {
            return;
        }
        for (out, &grey) in base.pixels_mut().iter_mut().zip(pixels) {
            *out = value(grey);
        }
        for level in 1..self.levels.len() {
            let (fine, coarse) = self.levels.split_at_mut(level);
            halve(&fine[level - 1], &mut coarse[0]);
        }
    }

    /// All levels, finest first.
    pub fn levels(&self) -> &[Image<f32>] {
        &self.levels
    }
}

/// The value of a pixel of level 0.
pub(crate) fn value(grey: u8) -> f32 {
    if grey == NO_DATA { f32::NAN } else { f32::from(grey) }
}

/// 2×2 mean; NaN where one of them is.
pub(crate) fn halve(fine: &Image<f32>, coarse: &mut Image<f32>) {
    let width = coarse.width();
    for (v, row) in coarse.pixels_mut().chunks_exact_mut(width).enumerate() {
        let (upper, lower) = (fine.row(2 * v), fine.row(2 * v + 1));
        for (u, out) in row.iter_mut().enumerate() {
            *out = 0.25 * (upper[2 * u] + upper[2 * u + 1] + lower[2 * u] + lower[2 * u + 1]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_without_data_and_their_means_are_nan() {
        let mut pixels = vec![8; 8 * 8];
        pixels[3 * 8 + 2] = NO_DATA;
        let mut pyramid = Pyramid::with_size(8, 8, 3);
        pyramid.fill(&pixels);
        for (level, image) in pyramid.levels().iter().enumerate() {
            let missing = image.pixels().iter().filter(|value| value.is_nan()).count();
            assert_eq!((missing, image.at(2 >> level, 3 >> level).is_nan()), (1, true), "{level}");
        }
    }
}
