//! Keyframes and points of the window.

use crate::slam::depth::pattern::{PATTERN, sum_of_samples};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::shared::SharedImage;
use crate::slam::window::comparison::{PatternAppearance, SAMPLES};
use crate::slam::window::params::WindowParams;
use crate::slam::window::surface::Surface;

/// Pyramid levels that an adjustment may use.
pub const LEVELS: usize = 4;
/// Mean of a pattern below which it has no gain, grey levels.
const DARKEST: f32 = 1.0;

/// A keyframe whose pose is estimated jointly with others.
#[derive(Debug, Clone, PartialEq)]
pub struct WindowKeyframe {
    /// Its id in the map.
    pub keyframe_id: u64,
    /// Its epoch.
    pub epoch: u32,
    /// Grey values by level, the finest shared with the map; only that one while the keyframe takes no part.
    pub images: Vec<SharedImage>,
    /// Its pose, in the unit of the map.
    pub camera_from_map: SE3,
    /// Its unit, in that of the map.
    pub unit: f64,
    /// The points chosen in it; empty before the next keyframe arrives.
    pub points: Vec<WindowPoint>,
    /// Whether its points were chosen.
    pub is_host: bool,
    /// Points of others that it agreed with when it was last aligned or estimated, until its own are chosen.
    pub agreed: Vec<Agreed>,
    /// The farthest depth in each part of its image.
    pub surface: Surface,
}

/// A point that a keyframe agrees with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Agreed {
    /// Its host.
    pub keyframe_id: u64,
    /// Its index among its host's points.
    pub point: usize,
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
    /// 1/z along the host's optical axis, in 1 / unit of the map.
    pub inverse_depth: f64,
    /// Its appearance, by level.
    pub appearances: [PatternAppearance; LEVELS],
    /// Number of keyframes that agreed when it was last adjusted.
    pub confirmations: u32,
    /// False once no keyframe agrees with it.
    pub is_alive: bool,
}

impl WindowKeyframe {
    /// Creates a keyframe from its image, pose and unit, without points or surface.
    pub fn new(
        keyframe_id: u64,
        epoch: u32,
        image: SharedImage,
        camera_from_map: SE3,
        unit: f64,
    ) -> Self {
        Self {
            keyframe_id,
            epoch,
            images: vec![image],
            camera_from_map,
            unit,
            points: Vec::new(),
            is_host: false,
            agreed: Vec::new(),
            surface: Surface::default(),
        }
    }

    /// Creates its coarser images, unless it has them.
    pub fn build_pyramid(&mut self, camera: &Intrinsics) {
        while self.images.len() < num_levels(camera) {
            let Some(finer) = self.images.last() else { return };
            self.images.push(finer.halved());
        }
    }

    /// Frees its coarser images.
    pub fn drop_pyramid(&mut self) {
        self.images.truncate(1);
    }
}

/// Levels of images of this camera: a side shorter than 40 pixels holds too little.
pub fn num_levels(camera: &Intrinsics) -> usize {
    const SHORTEST_SIDE_PX: usize = 40;
    let is_large = |&level: &usize| camera.width.min(camera.height) >> level >= SHORTEST_SIDE_PX;
    (0..LEVELS).take_while(is_large).count().max(1)
}

impl WindowPoint {
    /// The point at a pixel of the keyframe with these images.
    pub fn new(
        (u, v): (u16, u16),
        inverse_depth: f64,
        images: &[SharedImage],
        camera: &Intrinsics,
        params: &WindowParams,
    ) -> Self {
        let mut appearances = [PatternAppearance::default(); LEVELS];
        for (level, (appearance, image)) in appearances.iter_mut().zip(images).enumerate() {
            let [u, v] = [u, v].map(|pixel| at_level(pixel, level));
            *appearance = sample_pattern(image, u, v, params.half_weight_gradient);
        }
        let ray = camera.ray(f64::from(u), f64::from(v));
        let ray = [ray.x as f32, ray.y as f32];
        Self { u, v, ray, inverse_depth, appearances, confirmations: 0, is_alive: true }
    }
}

/// Position of a column or row of pixels at a level.
#[inline(always)]
pub(super) fn at_level(pixel: u16, level: usize) -> f32 {
    (f32::from(pixel) + 0.5) * 0.5f32.powi(level as i32) - 0.5
}

/// Appearance of the pattern around a position of the image.
#[inline(always)]
pub(super) fn sample_pattern(
    image: &SharedImage,
    u: f32,
    v: f32,
    half_weight_gradient: f32,
) -> PatternAppearance {
    let reach = CENTRE as f32;
    let inside = |at: f32, side: usize| at >= reach && at < side as f32 - 1.0 - reach;
    if !(inside(u, image.width()) && inside(v, image.height())) {
        return PatternAppearance::default();
    }
    let around = around(image, u, v);
    let of_pattern = |from: &[f32; AROUND]| {
        let mut samples = [0.0; SAMPLES];
        for (sample, (du, dv)) in samples.iter_mut().zip(PATTERN) {
            *sample = from[STRIDE * at(CENTRE + dv) + at(CENTRE + du)];
        }
        samples
    };
    let here = of_pattern(&around);
    let mean = sum_of_samples(&here) / SAMPLES as f32;
    if !(mean >= DARKEST) {
        return PatternAppearance::default();
    }
    let squared = half_weight_gradient * half_weight_gradient;
    let mut weights = [0.0; AROUND];
    for k in STRIDE..AROUND - STRIDE {
        let du = 0.5 * (around[k + 1] - around[k - 1]);
        let dv = 0.5 * (around[k + STRIDE] - around[k - STRIDE]);
        weights[k] = squared / (squared + du * du + dv * dv);
    }
    PatternAppearance { shape: here.map(|grey| grey / mean), weight: of_pattern(&weights) }
}

/// Pixels that pattern and differences reach to each side.
const CENTRE: i32 = 3;
/// Both sides and the centre.
const SIDE: usize = 2 * CENTRE as usize + 1;
/// Pixels of a row that are read: one more, for interpolation; the last of [`around`] is unused.
const STRIDE: usize = SIDE + 1;
/// [`SIDE`] rows of [`STRIDE`].
const AROUND: usize = SIDE * STRIDE;

const fn at(place: i32) -> usize {
    place as usize
}

/// The bilinear samples around a position at least [`CENTRE`] pixels inside, a pixel apart: loops over whole squares,
/// which compilers vectorise.
#[inline(always)]
fn around(image: &SharedImage, u: f32, v: f32) -> [f32; AROUND] {
    /// One more for the right neighbour of the last, which is unused.
    const READ: usize = STRIDE * STRIDE + 1;
    let (column, row) = (u as usize, v as usize);
    let (du, dv) = (u - column as f32, v - row as f32);
    let (left, top) = (column - at(CENTRE), row - at(CENTRE));
    let mut grey = [0.0; READ];
    for (y, to) in grey.chunks_exact_mut(STRIDE).enumerate() {
        for (to, &of) in to.iter_mut().zip(&image.row(top + y)[left..left + STRIDE]) {
            *to = f32::from(of);
        }
    }
    let mut rows = [0.0; STRIDE * STRIDE];
    for k in 0..STRIDE * STRIDE {
        rows[k] = grey[k] + du * (grey[k + 1] - grey[k]);
    }
    std::array::from_fn(|k| rows[k] + dv * (rows[k + STRIDE] - rows[k]))
}
