//! Samples of a frame with their gradients, for the vector units of the processor.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

use crate::slam::image::buffer::Image;
use crate::slam::kernel::Instructions;
use crate::slam::two_frame::lanes::{LANES, Lanes, lanes};

/// Samples with their gradients: bilinear between the pixels, of the grey values and of their central differences,
/// which needs the 4×4 pixels around a position. Valid at least a pixel inside the border; elsewhere the values are
/// those of some other pixels.
pub(super) trait WindowSampler: Copy {
    /// Brightness, ∂I/∂u, ∂I/∂v.
    fn sample(self, image: &Image<f32>, u: &Lanes, v: &Lanes) -> [Lanes; 3];
}

impl<I: Instructions> WindowSampler for I {
    #[inline(always)]
    fn sample(self, image: &Image<f32>, u: &Lanes, v: &Lanes) -> [Lanes; 3] {
        #[cfg(target_arch = "x86_64")]
        if I::HAS_AVX2 {
            // SAFETY: whoever made the instructions vouched for them.
            return unsafe { sample_avx2(image, u, v) };
        }
        sample_portable(image, u, v)
    }
}

/// The portable version, which explains the other.
#[inline(always)]
fn sample_portable(image: &Image<f32>, u: &Lanes, v: &Lanes) -> [Lanes; 3] {
    let (pixels, width) = (image.pixels(), image.width());
    let last = last_window(image);
    let (mut fu, mut columns) = ([0.0; LANES], [[0.0; LANES]; 6]);
    for l in 0..LANES {
        let (column, row) = (u[l] as i32, v[l] as i32);
        fu[l] = u[l] - column as f32;
        let fv = v[l] - row as f32;
        let index =
            row.wrapping_sub(1).wrapping_mul(width as i32).wrapping_add(column.wrapping_sub(1));
        let first = (index as u32).min(last) as usize;
        let window = &pixels[first..first + 3 * width + 4];
        let at = |row: usize, column: usize| window[row * width + column];
        for (c, out) in columns[..4].iter_mut().enumerate() {
            out[l] = at(1, c) + fv * (at(2, c) - at(1, c));
        }
        for (c, out) in columns[4..].iter_mut().enumerate() {
            let (upper, lower) = (at(2, c + 1) - at(0, c + 1), at(3, c + 1) - at(1, c + 1));
            out[l] = upper + fv * (lower - upper);
        }
    }
    across(&fu, &columns)
}

/// Index of the last pixel that is followed by 3 rows and 4 columns.
#[inline(always)]
fn last_window(image: &Image<f32>) -> u32 {
    let behind = 3 * image.width() + 4;
    // Images have less than 2³¹ pixels; the smallest level is far larger than a window.
    image.pixels().len().checked_sub(behind).expect("a level holds a window") as u32
}

/// Interpolates between the four columns of brightness and the inner two of the doubled vertical slope.
#[inline(always)]
fn across(fu: &Lanes, [a0, a1, a2, a3, b1, b2]: &[Lanes; 6]) -> [Lanes; 3] {
    [
        lanes(|l| a1[l] + fu[l] * (a2[l] - a1[l])),
        lanes(|l| {
            let (left, right) = (a2[l] - a0[l], a3[l] - a1[l]);
            0.5 * (left + fu[l] * (right - left))
        }),
        lanes(|l| 0.5 * (b1[l] + fu[l] * (b2[l] - b1[l]))),
    ]
}

/// Rows of four pixels at a time.
///
/// # Safety
/// The processor has AVX2. There is no target-feature attribute, because only without it is this inlined into the
/// caller's loop whatever its size.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn sample_avx2(image: &Image<f32>, u: &Lanes, v: &Lanes) -> [Lanes; 3] {
    let (pixels, width) = (image.pixels(), image.width());
    let last = last_window(image);
    // SAFETY: AVX2 is this function's contract. Loads and stores are of arrays of eight, or of four pixels in rows 0 to
    // 3 from an index that is followed by 3 rows and 4 pixels.
    unsafe {
        let (u, v) = (_mm256_loadu_ps(u.as_ptr()), _mm256_loadu_ps(v.as_ptr()));
        let (column, row) = (_mm256_cvttps_epi32(u), _mm256_cvttps_epi32(v));
        let fu = _mm256_sub_ps(u, _mm256_cvtepi32_ps(column));
        let fv = _mm256_sub_ps(v, _mm256_cvtepi32_ps(row));
        let one = _mm256_set1_epi32(1);
        let above = _mm256_mullo_epi32(_mm256_sub_epi32(row, one), _mm256_set1_epi32(width as i32));
        let index = _mm256_add_epi32(above, _mm256_sub_epi32(column, one));
        let index = _mm256_min_epu32(index, _mm256_set1_epi32(last as i32));
        let (mut first, mut along) = ([0u32; LANES], [0.0f32; LANES]);
        _mm256_storeu_si256(first.as_mut_ptr().cast(), index);
        _mm256_storeu_ps(along.as_mut_ptr(), fv);
        let mut rows = [_mm256_setzero_ps(); LANES];
        for l in 0..LANES {
            let at = pixels.as_ptr().add(first[l] as usize);
            let r0 = _mm_loadu_ps(at);
            let r1 = _mm_loadu_ps(at.add(width));
            let r2 = _mm_loadu_ps(at.add(2 * width));
            let r3 = _mm_loadu_ps(at.add(3 * width));
            let fv = _mm_set1_ps(along[l]);
            let a = _mm_add_ps(r1, _mm_mul_ps(fv, _mm_sub_ps(r2, r1)));
            let (upper, lower) = (_mm_sub_ps(r2, r0), _mm_sub_ps(r3, r1));
            let b = _mm_add_ps(upper, _mm_mul_ps(fv, _mm_sub_ps(lower, upper)));
            rows[l] = _mm256_set_m128(b, a);
        }
        let (mut fractions, mut out) = ([0.0; LANES], [[0.0; LANES]; 6]);
        _mm256_storeu_ps(fractions.as_mut_ptr(), fu);
        for (out, column) in out.iter_mut().zip(transposed(&rows)) {
            _mm256_storeu_ps(out.as_mut_ptr(), column);
        }
        across(&fractions, &out)
    }
}

/// The first six columns of eight rows.
///
/// # Safety
/// As [`sample_avx2`].
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn transposed(rows: &[__m256; LANES]) -> [__m256; 6] {
    // SAFETY: AVX2 is this function's contract.
    unsafe {
        // In each half of the registers first pairs, then fours.
        let (p0, p1) = (_mm256_unpacklo_ps(rows[0], rows[1]), _mm256_unpackhi_ps(rows[0], rows[1]));
        let (p2, p3) = (_mm256_unpacklo_ps(rows[2], rows[3]), _mm256_unpackhi_ps(rows[2], rows[3]));
        let (p4, p5) = (_mm256_unpacklo_ps(rows[4], rows[5]), _mm256_unpackhi_ps(rows[4], rows[5]));
        let (p6, p7) = (_mm256_unpacklo_ps(rows[6], rows[7]), _mm256_unpackhi_ps(rows[6], rows[7]));
        let f0 = _mm256_shuffle_ps::<0x44>(p0, p2);
        let f1 = _mm256_shuffle_ps::<0xEE>(p0, p2);
        let f2 = _mm256_shuffle_ps::<0x44>(p1, p3);
        let f3 = _mm256_shuffle_ps::<0xEE>(p1, p3);
        let f4 = _mm256_shuffle_ps::<0x44>(p4, p6);
        let f5 = _mm256_shuffle_ps::<0xEE>(p4, p6);
        let f6 = _mm256_shuffle_ps::<0x44>(p5, p7);
        let f7 = _mm256_shuffle_ps::<0xEE>(p5, p7);
        [
            _mm256_permute2f128_ps::<0x20>(f0, f4),
            _mm256_permute2f128_ps::<0x20>(f1, f5),
            _mm256_permute2f128_ps::<0x20>(f2, f6),
            _mm256_permute2f128_ps::<0x20>(f3, f7),
            _mm256_permute2f128_ps::<0x31>(f1, f5),
            _mm256_permute2f128_ps::<0x31>(f2, f6),
        ]
    }
}
