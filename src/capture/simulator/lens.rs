//! The rays of a raw image: where every pixel looks.

use crate::slam::geometry::intrinsics::Intrinsics;

/// The direction of a pixel as `(x, y, 1)`, and how it changes to the right and down.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    /// x and y at z = 1.
    pub at: [f32; 2],
    /// Change for one pixel to the right.
    pub du: [f32; 2],
    /// Change for one pixel down.
    pub dv: [f32; 2],
}

/// One ray a pixel, row by row.
#[derive(Debug, Clone)]
pub struct Lens {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// `width * height` rays.
    pub rays: Vec<Ray>,
}

impl Lens {
    /// The rays of a camera whose `unproject` gives x and y at z = 1 of a pixel.
    pub fn new(width: usize, height: usize, unproject: impl Fn(f64, f64) -> [f64; 2]) -> Self {
        /// Half a pixel to both sides: the derivative over the pixel itself.
        const STEP_PX: f64 = 0.5;
        let mut rays = Vec::with_capacity(width * height);
        for v in 0..height {
            for u in 0..width {
                let (u, v) = (u as f64, v as f64);
                let at = unproject(u, v);
                let slope = |a: [f64; 2], b: [f64; 2]| {
                    [
                        ((b[0] - a[0]) / (2.0 * STEP_PX)) as f32,
                        ((b[1] - a[1]) / (2.0 * STEP_PX)) as f32,
                    ]
                };
                rays.push(Ray {
                    at: [at[0] as f32, at[1] as f32],
                    du: slope(unproject(u - STEP_PX, v), unproject(u + STEP_PX, v)),
                    dv: slope(unproject(u, v - STEP_PX), unproject(u, v + STEP_PX)),
                });
            }
        }
        Self { width, height, rays }
    }

    /// The rays of an ideal pinhole.
    pub fn pinhole(k: &Intrinsics) -> Self {
        Self::new(k.width, k.height, |u, v| [(u - k.cx) / k.fx, (v - k.cy) / k.fy])
    }
}
