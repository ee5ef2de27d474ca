//! Grey values of colour pixels.

/// Weights of red, green and blue in a grey value, in 65536ths: the luma of ITU-R BT.601
/// (0.299, 0.587, 0.114), which is also the Y of every JPEG, so that a scene has the same grey
/// whether it comes as PNG or JPEG.
const LUMA_WEIGHTS: [u32; 3] = [19595, 38470, 7471];

/// The grey value of one colour pixel, rounded to nearest.
#[inline]
pub fn gray_from_rgb(rgb: [u8; 3]) -> u8 {
    const HALF: u32 = 1 << 15;
    let weighted: u32 = LUMA_WEIGHTS.iter().zip(rgb).map(|(&w, c)| w * u32::from(c)).sum();
    ((weighted + HALF) >> 16) as u8
}

/// Writes the grey values of interleaved pixels, `CHANNELS` bytes each beginning with red, green,
/// blue; surplus pixels on either side are left alone.
pub fn gray_from_interleaved<const CHANNELS: usize>(pixels: &[u8], gray: &mut [u8]) {
    const { assert!(CHANNELS >= 3, "a colour pixel has three channels") };
    for (gray, pixel) in gray.iter_mut().zip(pixels.chunks_exact(CHANNELS)) {
        *gray = gray_from_rgb([pixel[0], pixel[1], pixel[2]]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_sum_to_one_and_grey_stays_grey() {
        assert_eq!(LUMA_WEIGHTS.iter().sum::<u32>(), 1 << 16);
        for value in 0..=255 {
            assert_eq!(gray_from_rgb([value; 3]), value);
        }
    }

    #[test]
    fn channels_keep_their_order() {
        assert_eq!(gray_from_rgb([255, 0, 0]), 76);
        assert_eq!(gray_from_rgb([0, 255, 0]), 150);
        assert_eq!(gray_from_rgb([0, 0, 255]), 29);
        let mut gray = [9; 3];
        gray_from_interleaved::<4>(&[255, 0, 0, 77, 0, 0, 255, 77], &mut gray);
        assert_eq!(gray, [76, 29, 9]);
    }
}
