//! An owned image without row padding.

/// A row-major image, `width * height` pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Image<T> {
    width: usize,
    height: usize,
    pixels: Vec<T>,
}

impl<T: Copy> Image<T> {
    /// An image of one value.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self { width, height, pixels: vec![value; width * height] }
    }

    /// An image from its pixels; `None` unless there are `width * height` of them.
    pub fn try_from_pixels(width: usize, height: usize, pixels: Vec<T>) -> Option<Self> {
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
    pub fn pixels(&self) -> &[T] {
        &self.pixels
    }

    /// All pixels, row by row.
    pub fn pixels_mut(&mut self) -> &mut [T] {
        &mut self.pixels
    }

    /// The pixel at column `u`, row `v`.
    #[inline]
    pub fn at(&self, u: usize, v: usize) -> T {
        self.pixels[v * self.width + u]
    }

    /// Row `v`.
    #[inline]
    pub fn row(&self, v: usize) -> &[T] {
        &self.pixels[v * self.width..(v + 1) * self.width]
    }
}
