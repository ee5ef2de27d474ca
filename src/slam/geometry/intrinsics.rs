//! The pinhole intrinsics of a rectified image and of its pyramid levels.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// Pinhole intrinsics in pixels; the integer coordinate is the **centre** of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Focal length along u, pixels.
    pub fx: f64,
    /// Focal length along v, pixels.
    pub fy: f64,
    /// Principal point, u.
    pub cx: f64,
    /// Principal point, v.
    pub cy: f64,
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
}

impl Intrinsics {
    /// The intrinsics of a camera with square pixels whose optical axis passes through the centre of its image.
    pub const fn pinhole(width: usize, height: usize, focal_px: f64) -> Self {
        let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
        Self { fx: focal_px, fy: focal_px, cx, cy, width, height }
    }

    /// The intrinsics of pyramid level `level`: sizes halve, rounding down; `c_l = (c_0 + ½)/2^l − ½`.
    pub fn at_level(&self, level: usize) -> Self {
        let factor = f64::powi(0.5, level as i32);
        Self {
            fx: self.fx * factor,
            fy: self.fy * factor,
            cx: (self.cx + 0.5) * factor - 0.5,
            cy: (self.cy + 0.5) * factor - 0.5,
            width: self.width >> level,
            height: self.height >> level,
        }
    }

    /// The ray of a pixel in camera coordinates, with z = 1.
    #[inline]
    pub fn ray(&self, u: f64, v: f64) -> Vector3<f64> {
        Vector3::new((u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0)
    }

    /// Whether the numbers can belong to a camera: finite, positive focal lengths, a size within [16, 8192] pixels per
    /// side (larger ones mean a broken header, not a camera).
    pub fn is_valid(&self) -> bool {
        const SIDE: std::ops::RangeInclusive<usize> = 16..=8192;
        let finite = [self.fx, self.fy, self.cx, self.cy].iter().all(|x| x.is_finite());
        finite
            && self.fx > 0.0
            && self.fy > 0.0
            && SIDE.contains(&self.width)
            && SIDE.contains(&self.height)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_keep_the_ray_of_a_pixel_corner() {
        let level0 =
            Intrinsics { fx: 525.0, fy: 520.0, cx: 319.5, cy: 239.5, width: 641, height: 481 };
        for level in 1..5 {
            let coarse = level0.at_level(level);
            assert_eq!((coarse.width, coarse.height), (641 >> level, 481 >> level));
            // The outer corner of the first pixel is (-½, -½) at every level.
            let ray0 = (-0.5 - level0.cx) / level0.fx;
            let ray = (-0.5 - coarse.cx) / coarse.fx;
            assert!((ray0 - ray).abs() < 1e-12);
        }
    }

    #[test]
    fn invalid_numbers_are_rejected() {
        let good =
            Intrinsics { fx: 525.0, fy: 520.0, cx: 319.5, cy: 239.5, width: 640, height: 480 };
        assert!(good.is_valid());
        assert!(!Intrinsics { fx: f64::NAN, ..good }.is_valid());
        assert!(!Intrinsics { fy: 0.0, ..good }.is_valid());
        assert!(!Intrinsics { width: 0, ..good }.is_valid());
        assert!(!Intrinsics { height: usize::MAX, ..good }.is_valid());
    }
}
