//! An owned image without row padding.

/// A row-major image, `width * height` pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Image<T> {
    width: usize,
    height: usize,
    pixels: Vec<T>,
}

impl<T: Copy> Image<T> {
    /// An image filled with one value.
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

impl<T: Copy + Into<f32>> Image<T> {
    /// Bilinear sample; positions outside are clamped to the image.
    #[inline]
    pub fn bilinear(&self, u: f32, v: f32) -> f32 {
        let u = u.max(0.0).min((self.width - 2) as f32);
        let v = v.max(0.0).min((self.height - 2) as f32);
        let (column, row) = (u as usize, v as usize);
        let (fu, fv) = (u - column as f32, v - row as f32);
        let i = row * self.width + column;
        let between = |i: usize| {
            let [left, right] = [self.pixels[i], self.pixels[i + 1]].map(Into::into);
            left + fu * (right - left)
        };
        let (upper, lower) = (between(i), between(i + self.width));
        upper + fv * (lower - upper)
    }
}

#[cfg(test)]
mod tests {
    use super::Image;

    #[test]
    fn samples_are_bilinear_and_stay_inside() {
        // 0, 10, 20, below them 100, 110, 120 and 200, 210, 220.
        let greys = (0..9).map(|i| (100 * (i / 3) + 10 * (i % 3)) as u8).collect();
        let image = Image::try_from_pixels(3, 3, greys).unwrap();
        for (u, v, expected) in [
            (0.25, 0.5, 52.5f32),
            (1.0, 0.0, 10.0),
            (-7.0, -1.0, 0.0),
            (9.0, 0.0, 10.0),
            (f32::NAN, 0.0, 0.0),
        ] {
            assert_eq!(image.bilinear(u, v), expected, "{u} {v}");
        }
    }
}
