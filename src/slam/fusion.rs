//! Fuses the depth of all keyframes into one surface, to be opened as a point cloud.
//!
//! Keyframes overlap, so their points together show the same surface ten times with ten errors. Each point is compared
//! with the depth that other keyframes have at its pixel (Merrell et al. 2007, *Real-time visibility-based fusion of
//! depth maps*): depths that agree are averaged by their variances; a point that several others see through is removed.
//! The rest is gathered in cells of space (the size of a cell follows the distance and the standard deviation), points
//! closer than a cell or without company are removed, and the remaining ones are ordered so that any prefix shows the
//! whole map.
//!
//! The same keyframes give the same bits for any number of threads. Memory beyond the keyframes: 58 kB per 640 × 480
//! keyframe, 64 bytes per cell, and the points of sixteen keyframes at a time.

mod grid;
mod neighbours;
mod normal;
mod order;
mod params;
mod pixel_index;
mod spacing;
mod view;
mod voxels;

pub use params::{FusionParams, MapResolution, MapResolutionError};

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::slam::fusion::neighbours::neighbours;
use crate::slam::fusion::normal::normal;
use crate::slam::fusion::order::progressive_order;
use crate::slam::fusion::spacing::spaced;
use crate::slam::fusion::view::{Projection, Verdict, View};
use crate::slam::fusion::voxels::{Cell, Gathered, gathered, merged};
use crate::slam::keyframe::{DepthPoint, Keyframe};

/// Keyframes whose points are in memory at a time.
const BATCH: usize = 16;

/// A point of the map's surface.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SurfacePoint {
    /// Position, map units.
    pub position: [f32; 3],
    /// Unit normal of the surface, towards the camera with the lowest variance; zero where unknown.
    pub normal: [f32; 3],
    /// Brightness, 0 to 255.
    pub grey: u8,
    /// Standard deviation of the position along the ray from that camera, map units.
    pub sigma: f32,
    /// Number of keyframes whose depth agrees, including that camera's.
    pub keyframes: u8,
}

/// Fuses keyframes that share one unit and coordinate frame (one epoch) into a surface, ordered so that any prefix
/// shows all of it: the first `n` points are the best `n` to show. `progress` is called with the number of keyframes
/// done and their total.
pub fn fuse(
    keyframes: &[&Keyframe],
    params: &FusionParams,
    progress: &mut dyn FnMut(usize, usize),
) -> Vec<SurfacePoint> {
    let views: Vec<View<'_>> =
        keyframes.par_iter().filter_map(|keyframe| View::of(keyframe)).collect();
    let neighbours = neighbours(&views, params.max_neighbours);
    let mut cells = Vec::new();
    let numbers: Vec<usize> = (0..views.len()).collect();
    for batch in numbers.chunks(BATCH) {
        let of_batch: Vec<Vec<Gathered>> = batch
            .par_iter()
            .map(|&i| gathered(seen_by(&views, i, &neighbours[i], params)))
            .collect();
        cells = of_batch.into_iter().fold(cells, merged);
        progress(batch[batch.len() - 1] + 1, views.len());
    }
    let points = spaced(&cells, params.min_company);
    drop(cells);
    let surface: Vec<SurfacePoint> =
        points.par_iter().map(|(position, of)| surface_point(&views, *position, of)).collect();
    progressive_order(&surface).into_iter().map(|i| surface[i]).collect()
}

/// The points of a view that others do not contradict, averaged with theirs.
fn seen_by(
    views: &[View<'_>],
    number: usize,
    neighbours: &[usize],
    params: &FusionParams,
) -> Vec<Gathered> {
    let view = &views[number];
    let sights: Vec<Projection<'_>> =
        neighbours.iter().map(|&other| Projection::new(view, &views[other])).collect();
    let points = view.keyframe.points.iter().enumerate();
    let gathered = points.filter_map(|(i, point)| {
        let fused = fused(view, &sights, point, params)?;
        let best = (number as u32, i as u32);
        fused.gather(view, point, best, &params.resolution)
    });
    gathered.collect()
}

/// A point after fusion with all other keyframes.
struct Fused {
    inverse_depth: f64,
    variance: f64,
    keyframes: u8,
}

fn fused(
    view: &View<'_>,
    sights: &[Projection<'_>],
    point: &DepthPoint,
    params: &FusionParams,
) -> Option<Fused> {
    let (d, variance) = (f64::from(point.inverse_depth), f64::from(point.variance));
    let most = params.max_relative_std_dev * d;
    if !(d > 0.0 && d.is_finite() && variance > 0.0 && variance <= most * most) {
        return None;
    }
    if !is_supported(view, point, params) {
        return None;
    }
    let ray = view.ray(f64::from(point.u), f64::from(point.v));
    let (mut weight, mut sum, mut least) = (1.0 / variance, d / variance, variance);
    let (mut agreeing, mut seeing_through, mut hiding) = (1u8, 0u8, 0u8);
    for sight in sights {
        match sight.verdict(&ray, [d, variance], params) {
            Some(Verdict::Agrees(other, of_other)) if of_other > 0.0 => {
                weight += 1.0 / of_other;
                sum += other / of_other;
                least = least.min(of_other);
                agreeing = agreeing.saturating_add(1);
            }
            Some(Verdict::SeesThrough) => seeing_through = seeing_through.saturating_add(1),
            Some(Verdict::Hides) => hiding = hiding.saturating_add(1),
            _ => {}
        }
    }
    let is_seen_through = seeing_through >= params.min_contradictions
        && f64::from(seeing_through) >= params.contradiction_ratio * f64::from(agreeing);
    let is_alone =
        agreeing == 1 && seeing_through.saturating_add(hiding) >= params.min_contradictions;
    if is_seen_through || is_alone {
        return None;
    }
    // Depth is propagated from keyframe to keyframe: depths that agree are not independent.
    Some(Fused { inverse_depth: sum / weight, variance: least, keyframes: agreeing })
}

/// Whether enough of the depth around a point lies on the same surface: next to a step in depth, and where a pixel was
/// mismatched, it does not.
fn is_supported(view: &View<'_>, point: &DepthPoint, params: &FusionParams) -> bool {
    /// Pixels considered to each side.
    const RADIUS: usize = 3;
    /// Standard deviations of both by which depths of one surface may differ, and a share of the depth in addition: for
    /// surfaces seen at a shallow angle.
    const TOLERANCE: f64 = 1.5;
    const FLOOR: f64 = 0.01;
    let (d, variance) = (f64::from(point.inverse_depth), f64::from(point.variance));
    // The point itself is not counted.
    let (mut all, mut same) = (-1.0, -1.0);
    for other in view.around(point, RADIUS) {
        let difference = f64::from(other.inverse_depth) - d;
        let bound =
            TOLERANCE * TOLERANCE * (f64::from(other.variance) + variance) + (FLOOR * d).powi(2);
        all += 1.0;
        same += f64::from(u8::from(difference * difference <= bound));
    }
    same >= f64::from(params.min_support) && same >= params.support_ratio * all
}

impl Fused {
    fn gather(
        &self,
        view: &View<'_>,
        point: &DepthPoint,
        best: (u32, u32),
        resolution: &MapResolution,
    ) -> Option<Gathered> {
        let ray = view.ray(f64::from(point.u), f64::from(point.v));
        let place = &view.keyframe.map_from_keyframe;
        let position = *place * (ray / self.inverse_depth);
        let distance = ray.norm() / self.inverse_depth * place.scale;
        let sigma = distance * self.variance.sqrt() / self.inverse_depth;
        let pixel = distance / view.keyframe.intrinsics.fx;
        let size = resolution.cell_size(distance, pixel, sigma);
        let position = [position.x, position.y, position.z];
        let cell = Cell::of(position, size)?;
        Some(Gathered::new(cell, position, point.intensity, sigma, self.keyframes, best))
    }
}

fn surface_point(views: &[View<'_>], position: [f32; 3], of: &Gathered) -> SurfacePoint {
    let (view, point) = (&views[of.best.0 as usize], of.best.1 as usize);
    let in_keyframe = normal(view, &view.keyframe.points[point]);
    let in_map = |normal: Vector3<f64>| view.keyframe.map_from_keyframe.rigid.rotation * normal;
    SurfacePoint {
        position,
        normal: in_keyframe.map_or([0.0; 3], |normal| in_map(normal).map(|c| c as f32).into()),
        grey: of.grey(),
        sigma: of.sigma,
        keyframes: of.keyframes,
    }
}

#[cfg(test)]
mod tests;
