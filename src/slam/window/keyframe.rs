//! Keyframes and points of the window.

use crate::slam::depth::matching::PATTERN;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::quads::QuadImage;
use crate::slam::window::comparison_kernel::{Look, SAMPLES, sum};
use crate::slam::window::params::WindowParams;

/// Pyramid levels that an adjustment may use.
pub const LEVELS: usize = 4;
/// Mean of a pattern below which it has no gain, grey levels.
const DARKEST: f32 = 1.0;

/// A keyframe whose place is estimated jointly with others.
#[derive(Debug, Clone)]
pub struct WindowKeyframe {
    /// Its id in the map.
    pub keyframe_id: u64,
    /// Its epoch.
    pub epoch: u32,
    /// Grey values, level 0.
    pub pixels: Vec<u8>,
    /// The same to be sampled, by level; empty while it takes no part.
    pub images: Vec<QuadImage>,
    /// Where it is, in the unit of the map.
    pub camera_from_map: SE3,
    /// Length of its unit in that of the map.
    pub unit: f64,
    /// The points that were chosen in it; none before the next keyframe comes.
    pub points: Vec<WindowPoint>,
    /// Whether its points were chosen.
    pub is_host: bool,
}

/// A point that is estimated jointly with others.
#[derive(Debug, Clone, PartialEq)]
pub struct WindowPoint {
    /// Column of its pixel in its host, level 0.
    pub u: u16,
    /// Row.
    pub v: u16,
    /// Its ray at depth 1.
    pub ray: [f32; 2],
    /// 1/z along the host's optical axis, one over the unit of the map.
    pub inverse_depth: f64,
    /// What it looks like, by level.
    pub looks: [Look; LEVELS],
    /// Keyframes that agreed when it was last adjusted.
    pub confirmations: u32,
    /// False once nothing agrees with it.
    pub is_alive: bool,
}

impl WindowKeyframe {
    /// Makes its images, unless it has them.
    pub fn take_part(&mut self, camera: &Intrinsics) {
        if !self.images.is_empty() || self.pixels.len() != camera.width * camera.height {
            return;
        }
        let mut pixels = self.pixels.clone();
        let (mut width, mut height) = (camera.width, camera.height);
        for level in 0..num_levels(camera) {
            if level > 0 {
                pixels = halve(&pixels, width, height);
                (width, height) = (width / 2, height / 2);
            }
            let mut image = QuadImage::with_size(width, height);
            image.fill(&pixels);
            self.images.push(image);
        }
    }
}

/// Levels of images of this camera: a side shorter than 40 pixels holds too little.
pub fn num_levels(camera: &Intrinsics) -> usize {
    const SHORTEST_SIDE_PX: usize = 40;
    let is_large = |&level: &usize| camera.width.min(camera.height) >> level >= SHORTEST_SIDE_PX;
    (0..LEVELS).take_while(is_large).count().max(1)
}

/// 2×2 means, rounded: half a grey level is far below the noise.
fn halve(fine: &[u8], width: usize, height: usize) -> Vec<u8> {
    let (columns, rows) = (width / 2, height / 2);
    let mut coarse = Vec::with_capacity(columns * rows);
    for v in 0..rows {
        let upper = &fine[2 * v * width..][..2 * columns];
        let lower = &fine[(2 * v + 1) * width..][..2 * columns];
        coarse.extend(upper.chunks_exact(2).zip(lower.chunks_exact(2)).map(|(up, low)| {
            let sum = [up[0], up[1], low[0], low[1]].map(u16::from).iter().sum::<u16>();
            ((sum + 2) / 4) as u8
        }));
    }
    coarse
}

impl WindowPoint {
    /// The point at a pixel of the keyframe with these images.
    pub fn new(
        (u, v): (u16, u16),
        inverse_depth: f64,
        images: &[QuadImage],
        camera: &Intrinsics,
        params: &WindowParams,
    ) -> Self {
        let mut looks = [Look::default(); LEVELS];
        for (level, (look, image)) in looks.iter_mut().zip(images).enumerate() {
            let at = |pixel: u16| (f32::from(pixel) + 0.5) * 0.5f32.powi(level as i32) - 0.5;
            *look = look_at(image, at(u), at(v), params.half_weight_gradient);
        }
        let (x, y) =
            ((f64::from(u) - camera.cx) / camera.fx, (f64::from(v) - camera.cy) / camera.fy);
        let ray = [x as f32, y as f32];
        Self { u, v, ray, inverse_depth, looks, confirmations: 0, is_alive: true }
    }
}

/// What the pattern around a pixel looks like.
fn look_at(image: &QuadImage, u: f32, v: f32, half_weight_gradient: f32) -> Look {
    let reach = 3.0;
    let inside = |at: f32, side: usize| at >= reach && at < side as f32 - 1.0 - reach;
    if !(inside(u, image.width()) && inside(v, image.height())) {
        return Look::default();
    }
    let moved = |by: (f32, f32)| {
        let u = PATTERN.map(|(du, _)| u + du as f32 + by.0);
        let v = PATTERN.map(|(_, dv)| v + dv as f32 + by.1);
        image.sample(&u, &v)
    };
    let here = moved((0.0, 0.0));
    let mean = sum(&here) / SAMPLES as f32;
    if !(mean >= DARKEST) {
        return Look::default();
    }
    let (left, right, up, down) =
        (moved((-1.0, 0.0)), moved((1.0, 0.0)), moved((0.0, -1.0)), moved((0.0, 1.0)));
    let squared = half_weight_gradient * half_weight_gradient;
    let weight = std::array::from_fn(|k| {
        let (du, dv) = (0.5 * (right[k] - left[k]), 0.5 * (down[k] - up[k]));
        squared / (squared + du * du + dv * dv)
    });
    Look { shape: here.map(|grey| grey / mean), weight }
}
