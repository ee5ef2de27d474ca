//! A keyframe's image with its gradients.

use rayon::prelude::*;

use crate::slam::image::buffer::Image;
use crate::slam::image::{BLACK, NO_DATA};

/// Pixels nearer to the border than this carry no depth: the matching pattern reaches 2 pixels, its
/// gradients 1, and a bilinear sample 1 more.
pub const BORDER_PX: usize = 4;

/// Least number of rows per thread where a row is cheap: waking another thread costs as much as thousands of pixels.
pub(super) const BAND_ROWS: usize = 60;

/// Pixels nearer than this, in columns and rows, to one without data have no gradient: the matching pattern and its
/// gradients would include it.
const NO_DATA_REACH_PX: usize = 3;

/// Grey level of a pixel that may be overexposed.
const WHITE: u8 = 255;

/// An image with its gradients, level 0, stored compactly: the depth maps of two keyframes are in memory.
#[derive(Debug, Clone)]
pub struct GradientImage {
    /// Brightness, 0 to 255.
    pub intensity: Image<u8>,
    /// Difference of the right and left neighbours, and of those below and above; 0 on the border.
    differences: [Image<i16>; 2],
}

impl GradientImage {
    /// A black image.
    pub fn with_size(width: usize, height: usize) -> Self {
        let flat = Image::filled(width, height, 0);
        Self { intensity: Image::filled(width, height, 0), differences: [flat.clone(), flat] }
    }

    /// Copies the grey values of a frame of the same size and differentiates them. Next to pixels without data all
    /// differences are 0.
    pub fn fill(&mut self, pixels: &[u8]) {
        let (width, height) = (self.width(), self.height());
        let row = |v: usize| &pixels[v * width..(v + 1) * width];
        self.intensity.pixels_mut().copy_from_slice(pixels);
        let [along_u, along_v] =
            self.differences.each_mut().map(|of| of.pixels_mut().par_chunks_exact_mut(width));
        let rows = along_u.zip(along_v).enumerate().with_min_len(BAND_ROWS);
        rows.filter(|(v, _)| (1..height - 1).contains(v)).for_each(|(v, (along_u, along_v))| {
            let here = row(v);
            for (out, (&left, &right)) in along_u[1..].iter_mut().zip(here.iter().zip(&here[2..])) {
                *out = i16::from(right) - i16::from(left);
            }
            let ends = row(v - 1).iter().zip(row(v + 1)).skip(1).take(width - 2);
            for (out, (&above, &below)) in along_v[1..].iter_mut().zip(ends) {
                *out = i16::from(below) - i16::from(above);
            }
        });
        if pixels.contains(&NO_DATA) {
            self.level_beside_missing();
        }
    }

    /// Sets the differences of the pixels that are next to one without data to 0.
    fn level_beside_missing(&mut self) {
        const REACH: usize = NO_DATA_REACH_PX;
        let (width, height) = (self.width(), self.height());
        let mut least = vec![0; width];
        for v in 0..height {
            least.fill(u8::MAX);
            for row in v.saturating_sub(REACH)..(v + REACH + 1).min(height) {
                let row = self.intensity.row(row).iter();
                least.iter_mut().zip(row).for_each(|(least, grey)| *least = *grey.min(least));
            }
            for u in 0..width {
                let around = &least[u.saturating_sub(REACH)..(u + REACH + 1).min(width)];
                if around.contains(&NO_DATA) {
                    self.differences.iter_mut().for_each(|of| of.pixels_mut()[v * width + u] = 0);
                }
            }
        }
    }

    /// (∂I/∂u, ∂I/∂v) at this index of the image by central difference, grey levels per pixel; 0 on the border.
    #[inline(always)]
    pub fn gradient(&self, index: usize) -> (f32, f32) {
        let [u, v] = &self.differences;
        (half(u.pixels()[index]), half(v.pixels()[index]))
    }

    /// The gradients at a range of indices.
    #[inline(always)]
    pub fn gradients(&self, indices: std::ops::Range<usize>) -> impl Iterator<Item = (f32, f32)> {
        let [u, v] = &self.differences;
        let both = u.pixels()[indices.clone()].iter().zip(&v.pixels()[indices]);
        both.map(|(&u, &v)| (half(u), half(v)))
    }

    /// ‖g‖ of the pixels of row `v` that are not on the border, grey levels per pixel.
    #[inline(always)]
    pub(super) fn strengths(&self, v: usize) -> impl Iterator<Item = f32> {
        let row = v * self.width();
        let gradients = self.gradients(row + BORDER_PX..row + self.width() - BORDER_PX);
        gradients.map(|(gu, gv)| (gu * gu + gv * gv).sqrt())
    }

    /// Whether the pixels of row `v` that are not on the border, and the four neighbours of each, are neither black nor
    /// white: at the limits of the sensor, brightness is clipped and gradients are misplaced.
    #[inline(always)]
    pub(super) fn unsaturated(&self, v: usize) -> impl Iterator<Item = bool> {
        let (first, end) = (BORDER_PX, self.width() - BORDER_PX);
        let row = |v: usize, from: usize, to: usize| &self.intensity.row(v)[from..to];
        let beside = row(v, first - 1, end - 1).iter().zip(row(v, first + 1, end + 1));
        let above_below = row(v - 1, first, end).iter().zip(row(v + 1, first, end));
        row(v, first, end).iter().zip(beside).zip(above_below).map(|((at, (l, r)), (a, b))| {
            let darkest = at.min(l).min(r).min(a).min(b);
            let brightest = at.max(l).max(r).max(a).max(b);
            (*darkest > BLACK) & (*brightest < WHITE)
        })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.intensity.width()
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.intensity.height()
    }
}

/// Half a difference across two pixels.
#[inline(always)]
fn half(difference: i16) -> f32 {
    0.5 * f32::from(difference)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_central_differences() {
        let (width, height) = (20, 16);
        let pixels: Vec<u8> =
            (0..width * height).map(|i| ((i % width) * 5 + (i / width) * 3) as u8).collect();
        let mut image = GradientImage::with_size(width, height);
        image.fill(&pixels);
        assert_eq!(image.gradient(8 * width + 7), (5.0, 3.0));
        assert_eq!(image.gradient(8 * width), (0.0, 0.0));
        let step: Vec<u8> =
            (0..width * height).map(|i| if i % width < 8 { 255 } else { BLACK }).collect();
        image.fill(&step);
        assert_eq!(image.gradient(8 * width + 7), (-127.0, 0.0));
    }

    #[test]
    fn next_to_pixels_without_data_there_is_no_gradient() {
        let (width, height) = (40, 30);
        let mut pixels: Vec<u8> = (0..width * height).map(|i| (i % width * 5 + 1) as u8).collect();
        pixels[15 * width + 20] = NO_DATA;
        let mut image = GradientImage::with_size(width, height);
        image.fill(&pixels);
        for v in 1..height - 1 {
            for u in 1..width - 1 {
                let is_near =
                    u.abs_diff(20) <= NO_DATA_REACH_PX && v.abs_diff(15) <= NO_DATA_REACH_PX;
                let expected = if is_near { (0.0, 0.0) } else { (5.0, 0.0) };
                assert_eq!(image.gradient(v * width + u), expected, "{u}, {v}");
            }
        }
        pixels[15 * width + 20] = 101;
        image.fill(&pixels);
        assert_eq!(image.gradient(15 * width + 21), (5.0, 0.0), "nothing remains in used memory");
    }
}
