//! A grey image stored so that one load fetches the four pixels of a bilinear sample.

use crate::slam::image::NO_DATA;

/// Grey values with their right, lower and lower-right neighbours, one `u32` per pixel.
#[derive(Debug, Clone)]
pub struct QuadImage {
    width: usize,
    height: usize,
    quads: Vec<u32>,
    /// Whether there are pixels without data.
    has_hidden: bool,
}

impl QuadImage {
    /// A black image.
    pub fn with_size(width: usize, height: usize) -> Self {
        Self { width, height, quads: vec![0; width * height], has_hidden: false }
    }

    /// Fills the image from the grey values of a frame; does nothing unless there are `width * height` of them (callers
    /// check the size where the frame enters). A sample that includes a pixel without data is 0.
    pub fn fill(&mut self, pixels: &[u8]) {
        let width = self.width;
        if pixels.len() != self.quads.len() {
            return;
        }
        let rows = self.quads.chunks_exact_mut(width).zip(pixels.windows(2 * width).step_by(width));
        for (row, two) in rows {
            let (upper, lower) = two.split_at(width);
            for (quad, (u, l)) in row.iter_mut().zip(upper.windows(2).zip(lower.windows(2))) {
                *quad = u32::from_le_bytes([u[0], u[1], l[0], l[1]]);
            }
        }
        self.has_hidden = pixels.contains(&NO_DATA);
        if self.has_hidden {
            let is_whole = |quad: &u32| !quad.to_le_bytes().contains(&NO_DATA);
            self.quads.iter_mut().filter(|quad| !is_whole(quad)).for_each(|quad| *quad = 0);
        }
    }

    /// Whether there are pixels without data.
    pub fn has_hidden(&self) -> bool {
        self.has_hidden
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels with their neighbours, lowest byte first: the pixel, right, lower, lower right.
    pub fn quads(&self) -> &[u32] {
        &self.quads
    }

    /// Bilinear samples at eight positions, each at least a pixel from the border; elsewhere the values are arbitrary.
    #[inline(always)]
    pub fn sample(&self, u: &[f32; 8], v: &[f32; 8]) -> [f32; 8] {
        let mut index = [0i32; 8];
        let (mut fu, mut fv) = ([0.0f32; 8], [0.0f32; 8]);
        for k in 0..8 {
            let (column, row) = (u[k] as i32, v[k] as i32);
            fu[k] = u[k] - column as f32;
            fv[k] = v[k] - row as f32;
            index[k] = row.wrapping_mul(self.width as i32).wrapping_add(column);
        }
        let last = self.quads.len() - 1;
        let mut quads = [0u32; 8];
        for k in 0..8 {
            quads[k] = self.quads[(index[k] as u32 as usize).min(last)];
        }
        let mut samples = [0.0; 8];
        for k in 0..8 {
            let q = quads[k];
            let p00 = (q & 255) as i32 as f32;
            let p10 = (q >> 8 & 255) as i32 as f32;
            let p01 = (q >> 16 & 255) as i32 as f32;
            let p11 = (q >> 24) as i32 as f32;
            let upper = p00 + fu[k] * (p10 - p00);
            let lower = p01 + fu[k] * (p11 - p01);
            samples[k] = upper + fv[k] * (lower - upper);
        }
        samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_bilinear() {
        let (width, height) = (12, 9);
        let pixels: Vec<u8> = (0..width * height).map(|i| (i * i * 31 % 251) as u8).collect();
        let mut image = QuadImage::with_size(width, height);
        image.fill(&pixels);
        let u = [1.0, 2.25, 3.5, 4.75, 5.1, 6.9, 7.3, 9.99];
        let v = [1.0, 1.5, 2.25, 3.75, 4.6, 5.2, 6.9, 6.01];
        let at = |x: f32, y: f32| f32::from(pixels[y as usize * width + x as usize]);
        for (k, sample) in image.sample(&u, &v).into_iter().enumerate() {
            let (x, y) = (u[k].floor(), v[k].floor());
            let (a, b) = (u[k] - x, v[k] - y);
            let expected = (1.0 - a) * (1.0 - b) * at(x, y)
                + a * (1.0 - b) * at(x + 1.0, y)
                + (1.0 - a) * b * at(x, y + 1.0)
                + a * b * at(x + 1.0, y + 1.0);
            assert!((sample - expected).abs() < 1e-3, "{k}: {sample} {expected}");
        }
    }

    #[test]
    fn accepts_positions_outside_and_non_finite() {
        let image = QuadImage::with_size(12, 9);
        let wild = [f32::NAN, f32::INFINITY, -5.0, 1e9, -1e9, 0.0, 11.0, 200.0];
        assert!(image.sample(&wild, &[0.5; 8]).iter().all(|s| s.is_nan() || s.abs() < 1e12));
    }
}
