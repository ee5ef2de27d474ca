//! A printed surface: a tileable bitmap with its mip levels, sampled over the footprint of a pixel.

use crate::capture::simulator::lens::LANES;
use crate::slam::kernel::lanes_kernel::Pixel;
use crate::slam::kernel::{Floats, Instructions};

/// Reflectance of a tileable square surface, 0 (black) to 1 (white), with all its mip levels.
///
/// One sheet holds all levels: the finest on the left, the others on its right below each other, level l from row `size
/// − 2 (size >> l)` on. Every row ends with its first texel, so that every texel has a neighbour on its right.
#[derive(Debug, Clone)]
pub struct Texture {
    /// In [`STEPS`], row by row.
    sheet: Vec<u16>,
    size: usize,
}

/// Footprints of pixels on a texture, in texels of the finest level.
#[derive(Debug, Clone, Copy)]
pub struct Footprint<F> {
    /// Centre of the pixel.
    pub centre: [F; 2],
    /// Step on the texture for one pixel to the right.
    pub du: [F; 2],
    /// Step on the texture for one pixel down.
    pub dv: [F; 2],
}

/// Steps of a stored reflectance: far finer than a grey level, half the memory traffic of f32.
const STEPS: f32 = 65535.0;
/// Longest chain of samples along a stretched footprint; beyond it the footprint is blurred.
const MAX_TAPS: f32 = 12.0;

impl Texture {
    /// Builds the mip levels by 2×2 means. `size` is a power of two and `texels` has `size²` entries.
    pub fn new(size: usize, texels: Vec<f32>) -> Self {
        assert!(size.is_power_of_two() && texels.len() == size * size, "texture size");
        let mut texture = Self { sheet: vec![0; size * Self::stride(size)], size };
        texture.paint_level(0, 0, size, &texels);
        let (mut fine, mut side) = (texels, size);
        while side > 1 {
            let half = side / 2;
            let coarse: Vec<f32> = (0..half * half)
                .map(|i| {
                    let at = (i / half) * 2 * side + (i % half) * 2;
                    0.25 * (fine[at] + fine[at + 1] + fine[at + side] + fine[at + side + 1])
                })
                .collect();
            texture.paint_level(size - side, size + 1, half, &coarse);
            (fine, side) = (coarse, half);
        }
        texture
    }

    /// Entries from one row of the sheet to the next: a row of each of the two finest levels.
    fn stride(size: usize) -> usize {
        size + 1 + size / 2 + 1
    }

    fn paint_level(&mut self, top: usize, left: usize, side: usize, texels: &[f32]) {
        let stride = Self::stride(self.size);
        for (row, texels) in texels.chunks_exact(side).enumerate() {
            let start = (top + row) * stride + left;
            let (out, texels) = (&mut self.sheet[start..], texels.iter().chain(&texels[..1]));
            for (out, &texel) in out.iter_mut().zip(texels) {
                *out = (texel.clamp(0.0, 1.0) * STEPS + 0.5) as u16;
            }
        }
    }

    /// Means over the footprints of pixels, of which only the first `wanted` matter: trilinear samples as wide as the
    /// short axis, in a row along the long axis (Heckbert 1989, without Gaussian weights), so that a surface keeps its
    /// brightness at every distance and angle.
    #[inline(always)]
    pub fn sample<I: Instructions>(
        &self,
        lanes: I,
        wanted: usize,
        footprint: &Footprint<Floats<I>>,
    ) -> Floats<I> {
        let number = |x: f32| lanes.splat(x);
        let ([ux, uy], [vx, vy]) = (footprint.du, footprint.dv);
        // Principal axes of the ellipse onto which the unit circle of pixels is mapped.
        let (xx, xy, yy) = (ux * ux + vx * vx, ux * uy + vx * vy, uy * uy + vy * vy);
        let mean = number(0.5) * (xx + yy);
        let spread = (number(0.25) * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        let major = (mean + spread).sqrt();
        let shortest = major / number(MAX_TAPS);
        let minor = (mean - spread).max(number(0.0)).sqrt().max(shortest);
        let ratio = major / minor.max(number(1e-12));
        let taps = ratio.min(number(MAX_TAPS - 1.0)).floor() + number(1.0);
        let is_long = |yes, no| taps.greater(number(2.0)).select(yes, no);
        let width = is_long(minor, (major * minor).sqrt());
        let counts = is_long(taps, number(1.0)).to_array::<LANES>();
        let most = counts[..wanted].iter().fold(1.0, |a: f32, &b| a.max(b));
        if most == 1.0 {
            return self.trilinear(lanes, footprint.centre, width);
        }
        let along_x = yy.greater(xx).select(xy, mean + spread - yy);
        let along_y = yy.greater(xx).select(mean + spread - xx, xy);
        let length = (along_x * along_x + along_y * along_y).sqrt();
        let step = major / (length.max(number(1e-12)) * taps);
        let mut sum = number(0.0);
        let mut place = number(-0.5) * (taps - number(1.0));
        for tap in 0..most as usize {
            let [x, y] = footprint.centre;
            let x = is_long(x + place * step * along_x, x);
            let y = is_long(y + place * step * along_y, y);
            let tapped = self.trilinear(lanes, [x, y], width);
            let sampled = taps.greater(number(tap as f32)).select(sum + tapped, sum);
            sum = if tap == 0 { sampled } else { is_long(sampled, sum) };
            place = place + number(1.0);
        }
        sum / is_long(taps, number(1.0))
    }

    /// Means over discs of `width` texels around `centre`.
    #[inline(always)]
    pub fn trilinear<I: Instructions>(
        &self,
        lanes: I,
        centre: [Floats<I>; 2],
        width: Floats<I>,
    ) -> Floats<I> {
        // The power of two below the width is the level, the rest the fraction to the next: a piecewise linear log2,
        // exact at whole levels and without a call.
        let size = lanes.splat(self.size as f32);
        let width = width.max(lanes.splat(1.0)).min(size);
        let whole = width.power_of_two_below();
        let scale = lanes.splat(1.0) / whole;
        let between = width * scale - lanes.splat(1.0);
        let first = self.bilinear(lanes, whole, scale, centre);
        let (twice, half) = (lanes.splat(2.0) * whole, lanes.splat(0.5) * scale);
        let second = self.bilinear(lanes, twice, half, centre);
        lanes.splat(1e-3).greater(between).select(first, first + between * (second - first))
    }

    /// Samples the levels whose texels are `width` = 1 / `scale` of the finest. Meaningless for a level that does not
    /// exist.
    #[inline(always)]
    fn bilinear<I: Instructions>(
        &self,
        lanes: I,
        width: Floats<I>,
        scale: Floats<I>,
        centre: [Floats<I>; 2],
    ) -> Floats<I> {
        let number = |x: f32| lanes.splat(x);
        let (size, stride) = (number(self.size as f32), number(Self::stride(self.size) as f32));
        let side = size * scale;
        // Texel centres are at half-integer coordinates of the finest level.
        let (x, y) = (centre[0] * scale - number(0.5), centre[1] * scale - number(0.5));
        let (column, row) = (x.floor(), y.floor());
        let (a, b) = (x - column, y - row);
        let per_side = number(1.0 / self.size as f32) * width;
        let wrapped = |x: Floats<I>| x - side * (x * per_side).floor();
        let (left, top) = (wrapped(column), wrapped(row));
        let below = top + number(1.0);
        let bottom = side.greater(below).select(below, number(0.0));
        // Whole numbers below 2²⁴, like all positions on a sheet.
        let coarse = (size - side - side) * stride + (size + number(1.0));
        let corner = size.greater(side).select(coarse, number(0.0)) + left;
        let [p00, p10] = u16::pairs(&self.sheet, (corner + top * stride).truncate());
        let [p01, p11] = u16::pairs(&self.sheet, (corner + bottom * stride).truncate());
        let above = p00 + a * (p10 - p00);
        let below = p01 + a * (p11 - p01);
        (above + b * (below - above)) * number(1.0 / STEPS)
    }
}
