//! A grey image with shared ownership of its pixels.

use std::sync::Arc;

use crate::slam::image::NO_DATA;

/// A row-major image of grey values, `width * height` bytes. Clones share the pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct SharedImage {
    width: usize,
    height: usize,
    pixels: Arc<[u8]>,
}

impl SharedImage {
    /// An image of these pixels; `None` unless there are `width * height` of them.
    pub fn try_from_pixels(width: usize, height: usize, pixels: Arc<[u8]>) -> Option<Self> {
        (width.checked_mul(height) == Some(pixels.len())).then_some(Self { width, height, pixels })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row.
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    /// Row `v`.
    #[inline]
    pub fn row(&self, v: usize) -> &[u8] {
        &self.pixels[v * self.width..(v + 1) * self.width]
    }

    /// 2×2 means, rounded: half a grey level is far below the noise. No data where any of the four has none.
    pub fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut pixels = vec![0; width * height];
        for (v, row) in pixels.chunks_exact_mut(width.max(1)).enumerate() {
            let (upper, lower) = (self.row(2 * v), self.row(2 * v + 1));
            let pairs = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
            for (mean, (&upper, &lower)) in row.iter_mut().zip(pairs) {
                let [[a, b], [c, d]] = [upper, lower].map(|pair| pair.map(u16::from));
                let rounded = ((a + b + c + d + 2) / 4) as u8;
                *mean = if a.min(b).min(c.min(d)) == 0 { NO_DATA } else { rounded };
            }
        }
        Self { width, height, pixels: pixels.into() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halving_rounds_the_means() {
        let image =
            SharedImage::try_from_pixels(5, 2, [1, 2, 255, 254, 9, 3, 4, 255, 255, 9].into());
        assert_eq!(image.unwrap().halved().pixels(), [3, 255]);
        assert!(SharedImage::try_from_pixels(5, 3, [0; 10].into()).is_none());
    }

    #[test]
    fn a_mean_that_includes_a_pixel_without_data_has_none() {
        let image = SharedImage::try_from_pixels(4, 2, [200, 200, 1, 1, 200, NO_DATA, 1, 1].into());
        assert_eq!(image.unwrap().halved().pixels(), [NO_DATA, 1]);
    }
}
