//! Agreement of the depths of two keyframes where both see the same surface.

use nalgebra::{Matrix3, Vector3};

use crate::slam::evaluation::shared_view::SharedView;
use crate::slam::evaluation::statistics::median;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::Keyframe;

/// Points compared per pair.
const POINTS: usize = 2000;
/// Fewest points that give a meaningful figure.
const MIN_POINTS: usize = 50;
/// Rounds of the robust fit of the tilt.
const ROUNDS: usize = 5;

/// Agreement of the depths of a pair of keyframes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthAgreement {
    /// Median of |ln(d/d′)|, d the later keyframe's inverse depth, d′ the one that the earlier predicts there.
    pub difference: f64,
    /// Share of the points that agree within three standard deviations of both.
    pub within_3_sigma: f64,
    /// Length of the slope (X, Y) of ln(d/d′) over the ray coordinates: the tilt of one against the other. The slope
    /// along depth is left out: noise alone makes one.
    pub tilt: f64,
}

/// One plus the index of each pixel's point in the keyframe's points; 0 where it has none.
pub fn point_index(keyframe: &Keyframe) -> Image<u32> {
    let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
    let mut index = Image::filled(width, height, 0);
    for (i, point) in keyframe.points.iter().enumerate() {
        let at = usize::from(point.v) * width + usize::from(point.u);
        if usize::from(point.u) < width && at < index.pixels().len() {
            index.pixels_mut()[at] = i as u32 + 1;
        }
    }
    index
}

/// Compares a pair; `later` is the point index of the later keyframe. `None` where too few points coincide.
pub fn depth_agreement(view: &SharedView<'_>, later: &Image<u32>) -> Option<DepthAgreement> {
    let camera = &view.into.intrinsics;
    let (mut differences, mut rays, mut within) = (Vec::new(), Vec::new(), 0usize);
    for (point, projection) in view.projections(POINTS) {
        let Some(at) = projection else { continue };
        let index = later.at(at.u.round() as usize, at.v.round() as usize);
        let Some(other) = view.into.points.get((index as usize).wrapping_sub(1)) else { continue };
        let d = f64::from(other.inverse_depth);
        let difference = (d / at.inverse_depth).ln();
        // Relative variances: that of a propagated depth changes little.
        let relative = |variance: f32, d: f64| f64::from(variance) / (d * d);
        let variance =
            relative(other.variance, d) + relative(point.variance, f64::from(point.inverse_depth));
        if !(difference.is_finite() && variance > 0.0) {
            continue;
        }
        within += usize::from(difference * difference <= 9.0 * variance);
        differences.push(difference);
        rays.push(camera.ray(at.u, at.v).xy().into());
    }
    if differences.len() < MIN_POINTS {
        return None;
    }
    let absolute: Vec<f64> = differences.iter().map(|difference| difference.abs()).collect();
    Some(DepthAgreement {
        difference: median(&absolute)?,
        within_3_sigma: within as f64 / differences.len() as f64,
        tilt: tilt(&differences, &rays)?,
    })
}

/// The slope of a plane through `differences`, by iteratively reweighted least squares (Huber at 1.5 of the
/// median residual's σ).
fn tilt(differences: &[f64], rays: &[[f64; 2]]) -> Option<f64> {
    let mut plane = Vector3::new(median(differences)?, 0.0, 0.0);
    for _ in 0..ROUNDS {
        let residual = |i: usize, plane: &Vector3<f64>| {
            differences[i] - plane.dot(&Vector3::new(1.0, rays[i][0], rays[i][1]))
        };
        let sizes: Vec<f64> = (0..rays.len()).map(|i| residual(i, &plane).abs()).collect();
        let bound = (1.5 * 1.4826 * median(&sizes)?).max(1e-6);
        let (mut information, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
        for (i, size) in sizes.iter().enumerate() {
            let weight = (bound / size).min(1.0);
            let row = Vector3::new(1.0, rays[i][0], rays[i][1]);
            information += weight * row * row.transpose();
            gradient += weight * row * differences[i];
        }
        plane = information.cholesky()?.solve(&gradient);
    }
    let tilt = plane.y.hypot(plane.z);
    tilt.is_finite().then_some(tilt)
}
