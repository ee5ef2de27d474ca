//! Bilinear samples of a [`QuadImage`] in vector registers.

use crate::slam::image::quads::QuadImage;
use crate::slam::kernel::Instructions;

/// A way of taking eight bilinear samples; all implementations give the same bits.
pub trait Sampler: Copy {
    /// Same as [`QuadImage::sample`].
    fn sample(self, image: &QuadImage, u: &[f32; 8], v: &[f32; 8]) -> [f32; 8];
}

/// An image and its sampler.
#[derive(Debug, Clone, Copy)]
pub struct Sampled<'a, S> {
    /// The image.
    pub image: &'a QuadImage,
    /// The way it is sampled.
    pub sampler: S,
}

impl<I: Instructions> Sampler for I {
    #[inline(always)]
    fn sample(self, image: &QuadImage, u: &[f32; 8], v: &[f32; 8]) -> [f32; 8] {
        #[cfg(target_arch = "x86_64")]
        if I::HAS_AVX2 {
            // SAFETY: whoever made the instructions vouched for them.
            return unsafe { sample_avx2(image, u, v) };
        }
        image.sample(u, v)
    }
}

/// # Safety
/// The processor has AVX2. Without `#[target_feature]`, because only then is it inlined into the caller's loop whatever
/// its size.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn sample_avx2(image: &QuadImage, u: &[f32; 8], v: &[f32; 8]) -> [f32; 8] {
    use std::arch::x86_64::*;

    let quads = image.quads();
    // SAFETY: AVX2 is this function's contract. The arrays loaded and stored have eight numbers,
    // and every index is at most that of the last pixel, unsigned: images have fewer than 2³¹ pixels.
    unsafe {
        let (u, v) = (_mm256_loadu_ps(u.as_ptr()), _mm256_loadu_ps(v.as_ptr()));
        let (column, row) = (_mm256_cvttps_epi32(u), _mm256_cvttps_epi32(v));
        let fu = _mm256_sub_ps(u, _mm256_cvtepi32_ps(column));
        let fv = _mm256_sub_ps(v, _mm256_cvtepi32_ps(row));
        let width = _mm256_set1_epi32(image.width() as i32);
        let index = _mm256_add_epi32(_mm256_mullo_epi32(row, width), column);
        let last = _mm256_set1_epi32((quads.len() - 1) as i32);
        let index = _mm256_min_epu32(index, last);
        let quad = _mm256_i32gather_epi32::<4>(quads.as_ptr().cast(), index);
        let byte = _mm256_set1_epi32(255);
        let p00 = _mm256_cvtepi32_ps(_mm256_and_si256(quad, byte));
        let p10 = _mm256_cvtepi32_ps(_mm256_and_si256(_mm256_srli_epi32::<8>(quad), byte));
        let p01 = _mm256_cvtepi32_ps(_mm256_and_si256(_mm256_srli_epi32::<16>(quad), byte));
        let p11 = _mm256_cvtepi32_ps(_mm256_srli_epi32::<24>(quad));
        let upper = _mm256_add_ps(p00, _mm256_mul_ps(fu, _mm256_sub_ps(p10, p00)));
        let lower = _mm256_add_ps(p01, _mm256_mul_ps(fu, _mm256_sub_ps(p11, p01)));
        let samples = _mm256_add_ps(upper, _mm256_mul_ps(fv, _mm256_sub_ps(lower, upper)));
        let mut out = [0.0; 8];
        _mm256_storeu_ps(out.as_mut_ptr(), samples);
        out
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;

    #[test]
    fn gathered_samples_match_the_scalar_reference() {
        if !std::arch::is_x86_feature_detected!("avx2") {
            return;
        }
        let (width, height) = (37, 23);
        let pixels: Vec<u8> = (0..width * height).map(|i| (i * i * 31 % 251) as u8).collect();
        let mut image = QuadImage::with_size(width, height);
        image.fill(&pixels);
        // SAFETY: the processor has AVX2, as just checked.
        let sample = |u: &[f32; 8], v: &[f32; 8]| unsafe { sample_avx2(&image, u, v) };
        let place = |i: usize, side: usize| 0.5 + (i as f32 * 0.377) % (side as f32 - 2.0);
        for i in 0..500 {
            let u: [f32; 8] = std::array::from_fn(|k| place(8 * i + k, width));
            let v: [f32; 8] = std::array::from_fn(|k| place(5 * i + 3 * k, height));
            let bits = |samples: [f32; 8]| samples.map(f32::to_bits);
            assert_eq!(bits(sample(&u, &v)), bits(image.sample(&u, &v)));
        }
        let wild = [f32::NAN, f32::INFINITY, -5.0, 1e9, -1e9, 0.0, 36.0, 200.0];
        let _harmless = sample(&wild, &[22.5; 8]);
    }
}
