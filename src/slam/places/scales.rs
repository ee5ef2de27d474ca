//! An image at several scales, and the same blurred.

use crate::slam::image::NO_DATA;

/// Ratio of successive scales.
pub(super) const SCALE_STEP: f32 = 1.25;

/// One scale.
#[derive(Debug, Clone, Default)]
pub(super) struct Scale {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) pixels: Vec<u8>,
    /// Blurred by two pixels, against noise and small shifts.
    pub(super) blurred: Vec<u8>,
    /// Pixels of the image per pixel of this scale.
    pub(super) factor: f32,
}

/// Fills `scales` from an image, the largest scale first.
pub(super) fn fill(
    scales: &mut Vec<Scale>,
    pixels: &[u8],
    width: usize,
    height: usize,
    scratch: &mut Vec<u16>,
) {
    let long = width.max(height);
    let first = (long as f32 / LARGEST_PX as f32).max(1.0);
    let of = |k: usize| first * SCALE_STEP.powi(k as i32);
    let sized = |side: usize, k: usize| (side as f32 / of(k)).round() as usize;
    let count = (0..MAX_SCALES).take_while(|&k| sized(width.min(height), k) >= SMALLEST_PX).count();
    scales.resize_with(count, Scale::default);
    for k in 0..count {
        let (before, rest) = scales.split_at_mut(k);
        let scale = &mut rest[0];
        (scale.width, scale.height) = (sized(width, k), sized(height, k));
        scale.factor = of(k);
        let to = [scale.width, scale.height];
        match before.last() {
            None if to == [width, height] => {
                scale.pixels.clear();
                scale.pixels.extend_from_slice(pixels);
            }
            None => resample(pixels, [width, height], &mut scale.pixels, to),
            Some(larger) => {
                resample(&larger.pixels, [larger.width, larger.height], &mut scale.pixels, to)
            }
        }
        blur(&scale.pixels, scale.width, scratch, &mut scale.blurred);
    }
}
/// Longer side of the largest scale: finer detail is noise and compression.
const LARGEST_PX: usize = 512;
/// Maximum number of scales of an image.
pub(super) const MAX_SCALES: usize = 7;
/// Shorter side of the smallest: two descriptors side by side.
const SMALLEST_PX: usize = 72;

/// Resamples bilinearly; no data where any of the four pixels has none.
fn resample(
    from: &[u8],
    [width, height]: [usize; 2],
    to: &mut Vec<u8>,
    [columns, rows]: [usize; 2],
) {
    /// One in the fixed-point weights.
    const ONE: u32 = 256;
    let taps = |side: usize, count: usize| -> Vec<[u32; 3]> {
        let ratio = side as f32 / count as f32;
        (0..count)
            .map(|k| {
                let at = ((k as f32 + 0.5) * ratio - 0.5).clamp(0.0, (side - 1) as f32);
                let index = (at as usize).min(side.saturating_sub(2));
                let weight = ((at - index as f32) * ONE as f32).round() as u32;
                [index as u32, ONE - weight, weight]
            })
            .collect()
    };
    let (across, down) = (taps(width, columns), taps(height, rows));
    to.clear();
    to.reserve(columns * rows);
    let mut mixed = vec![0u16; width];
    for [row, upper, lower] in down {
        let begin = row as usize * width;
        let (above, below) = (&from[begin..begin + width], &from[begin + width..begin + 2 * width]);
        let (upper, lower) = (upper as u16, lower as u16);
        for ((mixed, above), below) in mixed.iter_mut().zip(above).zip(below) {
            let has_data = *above.min(below) != NO_DATA;
            // At most 255 × 256.
            let sum = upper * u16::from(*above) + lower * u16::from(*below);
            *mixed = if has_data { sum } else { 0 };
        }
        to.extend(across.iter().map(|&[column, left, right]| {
            let at = column as usize;
            let has_data = mixed[at].min(mixed[at + 1]) > 0;
            let sum = left * u32::from(mixed[at]) + right * u32::from(mixed[at + 1]);
            if has_data { ((sum + ONE * ONE / 2) / (ONE * ONE)) as u8 } else { NO_DATA }
        }));
    }
}

/// Gaussian blur of two pixels; edges are repeated.
fn blur(from: &[u8], width: usize, scratch: &mut Vec<u16>, to: &mut Vec<u8>) {
    let height = from.len() / width.max(1);
    scratch.clear();
    scratch.resize(from.len(), 0);
    let mut padded = vec![0u8; width + 6];
    for (row, out) in from.chunks_exact(width).zip(scratch.chunks_exact_mut(width)) {
        padded[..3].fill(row[0]);
        padded[3..width + 3].copy_from_slice(row);
        padded[width + 3..].fill(row[width - 1]);
        let shifted: [&[u8]; 7] = std::array::from_fn(|k| &padded[k..k + width]);
        for k in 0..width {
            let greys = shifted.map(|row| u16::from(row[k]));
            out[k] = weighted(greys) >> 8;
        }
    }
    to.clear();
    to.resize(from.len(), 0);
    for (v, out) in to.chunks_exact_mut(width).enumerate() {
        let row = |k: usize| &scratch[(v + k).saturating_sub(3).min(height - 1) * width..][..width];
        let rows: [&[u16]; 7] = std::array::from_fn(row);
        for k in 0..width {
            out[k] = (weighted(rows.map(|row| row[k])) >> 8) as u8;
        }
    }
}

/// Weights of a Gaussian of two pixels; their sum is 256.
#[inline(always)]
fn weighted([a, b, c, d, e, f, g]: [u16; 7]) -> u16 {
    18 * (a + g) + 33 * (b + f) + 49 * (c + e) + 56 * d
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resampled_pixel_that_includes_one_without_data_has_none() {
        for grey in [1, 200] {
            let mut pixels = vec![grey; 100 * 80];
            pixels[40 * 100 + 50] = NO_DATA;
            let mut smaller = Vec::new();
            resample(&pixels, [100, 80], &mut smaller, [80, 64]);
            let missing = smaller.iter().filter(|&&found| found == NO_DATA).count();
            assert!((1..=4).contains(&missing), "{missing}");
            assert!(smaller.iter().all(|found| [NO_DATA, grey].contains(found)), "{grey}");
        }
    }
}
