//! A printed surface: a tileable bitmap with its mip levels, sampled over the footprint of a pixel.

/// Reflectance of a tileable square surface, 0 (black) to 1 (white), with every halving of it.
#[derive(Debug, Clone)]
pub struct Texture {
    /// Finest first, in [`STEPS`]; level l is `size >> l` a side.
    levels: Vec<Vec<u16>>,
    size: usize,
}

/// Where a pixel falls on a texture, in texels of the finest level.
#[derive(Debug, Clone, Copy)]
pub struct Footprint {
    /// Centre of the pixel.
    pub centre: [f32; 2],
    /// Step on the texture for one pixel to the right.
    pub du: [f32; 2],
    /// Step on the texture for one pixel down.
    pub dv: [f32; 2],
}

/// Steps of a stored reflectance: far finer than a grey level, half the memory traffic of f32.
const STEPS: f32 = 65535.0;
/// Longest chain of samples along a stretched footprint; beyond it the footprint is blurred.
const MAX_TAPS: f32 = 12.0;
/// Samples for each texel of the footprint's length, measured in its width.
const TAPS_PER_RATIO: f32 = 1.0;

impl Texture {
    /// Builds the mip levels by 2×2 means. `size` is a power of two and `texels` has `size²` entries.
    pub fn new(size: usize, texels: Vec<f32>) -> Self {
        assert!(size.is_power_of_two() && texels.len() == size * size, "texture size");
        let quantize = |texels: &[f32]| -> Vec<u16> {
            texels.iter().map(|&t| (t.clamp(0.0, 1.0) * STEPS + 0.5) as u16).collect()
        };
        let mut fine = texels;
        let mut levels = vec![quantize(&fine)];
        let mut side = size;
        while side > 1 {
            let half = side / 2;
            let coarse: Vec<f32> = (0..half * half)
                .map(|i| {
                    let at = (i / half) * 2 * side + (i % half) * 2;
                    0.25 * (fine[at] + fine[at + 1] + fine[at + side] + fine[at + side + 1])
                })
                .collect();
            levels.push(quantize(&coarse));
            fine = coarse;
            side = half;
        }
        Self { levels, size }
    }

    /// Mean over the footprint: trilinear samples as wide as its short axis, in a row along its
    /// long axis (Heckbert 1989, with Gaussian weights left out), so that a surface keeps its
    /// brightness from every distance and angle.
    #[inline]
    pub fn sample(&self, footprint: &Footprint) -> f32 {
        let ([ux, uy], [vx, vy]) = (footprint.du, footprint.dv);
        // Principal axes of the ellipse that the unit circle of pixels becomes.
        let (xx, xy, yy) = (ux * ux + vx * vx, ux * uy + vx * vy, uy * uy + vy * vy);
        let mean = 0.5 * (xx + yy);
        let spread = (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        let major = (mean + spread).sqrt();
        let minor = (mean - spread).max(0.0).sqrt().max(major / MAX_TAPS);
        let taps =
            ((TAPS_PER_RATIO * major / minor.max(1e-12)).min(MAX_TAPS - 1.0) as i32 + 1) as f32;
        if taps <= 2.0 {
            return self.trilinear(footprint.centre, (major * minor).sqrt());
        }
        let axis = if xx >= yy { [mean + spread - yy, xy] } else { [xy, mean + spread - xx] };
        let step = major / ((axis[0] * axis[0] + axis[1] * axis[1]).sqrt().max(1e-12) * taps);
        let mut sum = 0.0;
        let mut place = -0.5 * (taps - 1.0);
        for _ in 0..taps as usize {
            let at = |k: usize| footprint.centre[k] + place * step * axis[k];
            sum += self.trilinear([at(0), at(1)], minor);
            place += 1.0;
        }
        sum / taps
    }

    /// Mean over a disc of `width` texels around `centre`.
    #[inline]
    pub fn trilinear(&self, centre: [f32; 2], width: f32) -> f32 {
        // The exponent of the width is the level, its mantissa the way to the next: log2 made of
        // straight pieces, exact at whole levels and without a call.
        let bits = width.clamp(1.0, self.size as f32).to_bits();
        let fine = (bits >> 23) as usize - 127;
        let between = (bits & 0x7F_FFFF) as f32 / 8_388_608.0;
        let first = self.bilinear(fine, centre);
        if between < 1e-3 {
            return first;
        }
        first + between * (self.bilinear(fine + 1, centre) - first)
    }

    #[inline]
    fn bilinear(&self, level: usize, centre: [f32; 2]) -> f32 {
        let side = self.size >> level;
        let mask = side as i32 - 1;
        let scale = 1.0 / (1u32 << level) as f32;
        // Texel centres are at half-integer coordinates of the finest level.
        let (x, y) = (centre[0] * scale - 0.5, centre[1] * scale - 0.5);
        let (column, row) = (floor(x), floor(y));
        let (a, b) = (x - column as f32, y - row as f32);
        let (left, right) = ((column & mask) as usize, ((column + 1) & mask) as usize);
        let (top, bottom) = ((row & mask) as usize, ((row + 1) & mask) as usize);
        let texels = &self.levels[level];
        let (upper, lower) = (&texels[top * side..][..side], &texels[bottom * side..][..side]);
        let at = |row: &[u16], column: usize| f32::from(row[column]);
        let above = at(upper, left) + a * (at(upper, right) - at(upper, left));
        let below = at(lower, left) + a * (at(lower, right) - at(lower, left));
        (above + b * (below - above)) * (1.0 / STEPS)
    }
}

/// The whole number below, without the call that the baseline instruction set needs for it.
#[inline]
fn floor(x: f32) -> i32 {
    let towards_zero = x as i32;
    towards_zero - i32::from((towards_zero as f32) > x)
}
