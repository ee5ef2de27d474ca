//! The rays of a raw image: the direction of every pixel.

use nalgebra::Vector2;
use rayon::prelude::*;

use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;

/// Number of rays cast together.
pub const LANES: usize = 8;
/// A bit for each of these rays.
pub const ALL_LANES: u32 = (1 << LANES) - 1;
/// Nearest depth that is visible, metres.
pub const NEAREST_M: f32 = 0.05;

/// A direction `(x, y, 1)` and its change from pixel to pixel; of one pixel or, as arrays, of many.
#[derive(Debug, Clone, Copy)]
pub struct Ray<T = f32> {
    /// x and y at z = 1.
    pub at: [T; 2],
    /// Change for one pixel to the right.
    pub du: [T; 2],
    /// Change for one pixel down.
    pub dv: [T; 2],
}

impl Ray {
    /// No direction.
    const NOWHERE: Self = Self { at: [f32::NAN; 2], du: [f32::NAN; 2], dv: [f32::NAN; 2] };

    /// x and y at z = 1, `a` pixels to the right and `b` down.
    #[inline]
    pub fn shifted(&self, a: f32, b: f32) -> [f32; 2] {
        let Self { at, du, dv } = self;
        [at[0] + a * du[0] + b * dv[0], at[1] + a * du[1] + b * dv[1]]
    }
}

impl<T> Ray<T> {
    /// Applies a function to every number.
    #[inline(always)]
    pub fn map<'a, U>(&'a self, of: impl Fn(&'a T) -> U) -> Ray<U> {
        let two = |pair: &'a [T; 2]| [of(&pair[0]), of(&pair[1])];
        Ray { at: two(&self.at), du: two(&self.du), dv: two(&self.dv) }
    }
}

/// One ray per pixel, row by row.
#[derive(Debug, Clone)]
pub struct Lens {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// `width * height` rays, followed by [`LANES`] without a direction.
    rays: Ray<Vec<f32>>,
}

impl Lens {
    /// Computes the rays of a camera whose `unproject` returns x and y at z = 1 for a pixel, or `None` outside its
    /// valid region: such a pixel sees nothing.
    pub fn new(
        width: usize,
        height: usize,
        unproject: impl Fn(f64, f64) -> Option<[f64; 2]> + Sync,
    ) -> Self {
        // One pixel more on every side, so that every pixel has neighbours on both sides.
        let wide = width + 2;
        let grid: Vec<[f64; 2]> = (0..wide * (height + 2))
            .into_par_iter()
            .map(|i| {
                let (u, v) = ((i % wide) as f64 - 1.0, (i / wide) as f64 - 1.0);
                unproject(u, v).unwrap_or([f64::NAN; 2])
            })
            .collect();
        let ray = |i: usize| {
            let at = (i / width + 1) * wide + i % width + 1;
            let slope = |step: usize| {
                let (before, after) = (grid[at - step], grid[at + step]);
                std::array::from_fn(|k| {
                    let central = 0.5 * (after[k] - before[k]);
                    // At the border of the valid region one side is missing.
                    let sided = [central, after[k] - grid[at][k], grid[at][k] - before[k]];
                    sided.into_iter().find(|s| s.is_finite()).unwrap_or(0.0) as f32
                })
            };
            Ray { at: grid[at].map(|x| x as f32), du: slope(1), dv: slope(wide) }
        };
        let size = width * height + LANES;
        let no_rays = Ray { at: [(); 2], du: [(); 2], dv: [(); 2] };
        let mut rays = no_rays.map(|_| Vec::with_capacity(size));
        for ray in (0..width * height).map(ray).chain([Ray::NOWHERE; LANES]) {
            for k in 0..2 {
                rays.at[k].push(ray.at[k]);
                rays.du[k].push(ray.du[k]);
                rays.dv[k].push(ray.dv[k]);
            }
        }
        Self { width, height, rays }
    }

    /// The ray of a pixel by its index in the image, row by row.
    #[inline(always)]
    pub fn ray(&self, pixel: usize) -> Ray {
        self.rays.map(|plane| plane[pixel])
    }

    /// The rays from a pixel on, enough to fill lanes.
    #[inline(always)]
    pub fn rays_from(&self, pixel: usize) -> Ray<&[f32]> {
        self.rays.map(|plane| &plane[pixel..])
    }

    /// The rays of an ideal pinhole.
    pub fn pinhole(k: &Intrinsics) -> Self {
        Self::new(k.width, k.height, |u, v| Some([(u - k.cx) / k.fx, (v - k.cy) / k.fy]))
    }

    /// The rays of a camera's raw image.
    pub fn of_camera(camera: &CameraModel) -> Self {
        let k = camera.intrinsics();
        if camera.distortion().is_pinhole() {
            return Self::pinhole(k);
        }
        Self::new(k.width, k.height, |u, v| {
            let ray = camera.unproject(&Vector2::new(u, v))?;
            (ray.z > 0.0).then(|| [ray.x / ray.z, ray.y / ray.z])
        })
    }
}
