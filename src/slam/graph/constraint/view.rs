//! A keyframe prepared for alignment to others, and of others to it.

use crate::slam::alignment::fusion::LevelPoint;
use crate::slam::alignment::reference::num_levels;
use crate::slam::alignment::reference::{Reference, ReferenceParams, ReferenceScratch};
use crate::slam::image::sums::SumPyramid;
use crate::slam::keyframe::Keyframe;

/// Depth at one pixel of a level, as a plane of the inverse depth around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Surface {
    /// Column and row, pixels of the level.
    pub(super) pixel: [f32; 2],
    /// Inverse depth there, 1/keyframe units.
    pub(super) inverse_depth: f32,
    /// Its variance.
    pub(super) variance: f32,
    /// Its change per pixel along u and v; 0 where the neighbours do not determine it.
    pub(super) gradient: [f32; 2],
}

/// Depth of one level, for lookup by pixel.
#[derive(Debug, Clone, Default)]
pub(super) struct DepthGrid {
    width: usize,
    surfaces: Vec<Surface>,
    /// By pixel: one more than the index of the surface at it or next to it, 0 where there is none.
    nearest: Vec<u32>,
}

impl DepthGrid {
    /// From the pixels with depth of a level.
    pub(super) fn new(candidates: &[LevelPoint], width: usize, height: usize) -> Self {
        /// Neighbours of a pixel, those that share a side first.
        const BESIDE: [[isize; 2]; 8] =
            [[-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [1, -1], [-1, 1], [1, 1]];
        let mut nearest = vec![0u32; width * height];
        let mut surfaces = Vec::with_capacity(candidates.len());
        for candidate in candidates {
            let (u, v) = (usize::from(candidate.u), usize::from(candidate.v));
            if u >= width || v >= height {
                continue;
            }
            surfaces.push(Surface {
                pixel: [u as f32, v as f32],
                inverse_depth: candidate.inverse_depth,
                variance: candidate.variance,
                gradient: [0.0; 2],
            });
            nearest[v * width + u] = surfaces.len() as u32;
        }
        let own = nearest.clone();
        let shift = |surface: &Surface, [du, dv]: [isize; 2]| {
            let u = (surface.pixel[0] as usize).checked_add_signed(du).filter(|&u| u < width)?;
            let v = (surface.pixel[1] as usize).checked_add_signed(dv).filter(|&v| v < height)?;
            Some(v * width + u)
        };
        for by in BESIDE {
            for (index, surface) in surfaces.iter().enumerate() {
                if let Some(at) = shift(surface, by).filter(|&at| nearest[at] == 0) {
                    nearest[at] = index as u32 + 1;
                }
            }
        }
        let gradients: Vec<[f32; 2]> = surfaces
            .iter()
            .map(|surface| {
                let around = (-2..=2).flat_map(|dv| (-2..=2).map(move |du| [du, dv]));
                let others = around.filter_map(|by| own[shift(surface, by)?].checked_sub(1));
                gradient(surface, others.map(|other| &surfaces[other as usize]))
            })
            .collect();
        for (surface, gradient) in surfaces.iter_mut().zip(gradients) {
            surface.gradient = gradient;
        }
        Self { width, surfaces, nearest }
    }

    /// The surface at a pixel inside the image, or next to that pixel.
    #[inline]
    pub(super) fn at(&self, u: f32, v: f32) -> Option<&Surface> {
        let at = (v + 0.5) as usize * self.width + (u + 0.5) as usize;
        self.surfaces.get((*self.nearest.get(at)?).checked_sub(1)? as usize)
    }
}

/// Least-squares gradient of the inverse depth over the neighbours that can lie on the same surface.
fn gradient<'a>(centre: &Surface, others: impl Iterator<Item = &'a Surface>) -> [f32; 2] {
    /// Larger relative changes of inverse depth to a neighbour mean another surface.
    const SAME_SURFACE: f32 = 0.1;
    /// Least determinant of the sums of squares: six pixels around a corner.
    const MIN_DETERMINANT: f32 = 20.0;
    let [mut uu, mut uv, mut vv, mut ud, mut vd] = [0.0f32; 5];
    for other in others {
        let d = other.inverse_depth - centre.inverse_depth;
        if d.abs() > SAME_SURFACE * centre.inverse_depth {
            continue;
        }
        let [u, v] = [other.pixel[0] - centre.pixel[0], other.pixel[1] - centre.pixel[1]];
        uu += u * u;
        uv += u * v;
        vv += v * v;
        ud += u * d;
        vd += v * d;
    }
    let determinant = uu * vv - uv * uv;
    if determinant < MIN_DETERMINANT {
        return [0.0; 2];
    }
    [(vv * ud - uv * vd) / determinant, (uu * vd - uv * ud) / determinant]
}

/// A keyframe prepared for alignment with others of the same camera.
#[derive(Debug, Clone)]
pub struct KeyframeView {
    pub(super) reference: Reference,
    pub(super) pyramid: SumPyramid,
    pub(super) depths: Vec<DepthGrid>,
}

impl KeyframeView {
    /// Prepares a keyframe. Without image or depth, or with an image whose size differs from its intrinsics, the view
    /// has no points, and every measurement with it is refused.
    pub fn new(keyframe: &Keyframe, params: &ReferenceParams) -> Self {
        let mut reference = Reference::new(params.clone());
        let mut scratch = ReferenceScratch::default();
        reference.prepare_into(keyframe, &mut scratch);
        let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
        let is_usable = !reference.level(reference.finest_level()).is_empty();
        let levels = if is_usable { num_levels(width, height) } else { 0 };
        let finest = reference.finest_level();
        let mut pyramid = SumPyramid::default();
        if is_usable {
            pyramid = SumPyramid::with_size(width, height, levels, finest);
            pyramid.fill(&keyframe.image);
        }
        let depth_of = |level: usize| match level < finest {
            true => DepthGrid::default(),
            false => DepthGrid::new(scratch.candidates(level), width >> level, height >> level),
        };
        let depths = (0..levels).map(depth_of).collect();
        Self { reference, pyramid, depths }
    }

    /// Levels that are aligned, finest first; none where the keyframe cannot be used.
    pub(super) fn levels(&self) -> std::ops::Range<usize> {
        self.reference.finest_level().min(self.depths.len())..self.depths.len()
    }
}
