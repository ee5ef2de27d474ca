//! The weight of each point of a keyframe for a given motion: reproduces LSD14 fig. 4.

use crate::slam::alignment::align::AlignmentParams;
use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::residual::{Evaluation, point_terms};
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::SumPyramid;
use crate::slam::pose::Brightness;

/// A point of a keyframe with its weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointWeight {
    /// Column of the point in the keyframe, pixels of the level.
    pub column: usize,
    /// Row of the point.
    pub row: usize,
    /// Inverse depth of the point, 1/keyframe units.
    pub inverse_depth: f32,
    /// 1/σ_r² relative to its value with exact depth: 1 where depth variance does not affect the residual, towards 0
    /// where it dominates.
    pub weight: f32,
}

/// Weights of the points of `reference` on `level` that stay in view when the camera moves by `current_from_keyframe`
/// (translation in keyframe units), at equal brightness. `frame` is the pyramid of any image of that camera: the
/// gradients in σ_r² come from the keyframe.
pub fn point_weights(
    reference: &Reference,
    frame: &SumPyramid,
    level: usize,
    current_from_keyframe: &SE3,
    params: &AlignmentParams,
) -> Vec<PointWeight> {
    let intrinsics = reference.intrinsics().at_level(level);
    let at = Evaluation::new(
        &intrinsics,
        level,
        current_from_keyframe,
        Brightness::default(),
        params,
        &current_from_keyframe.translation,
    );
    let pixel = |ray: f32, focal: f64, centre: f64| (f64::from(ray) * focal + centre).round();
    let points = reference.level(level).iter();
    let weights = points.filter_map(|point| {
        let terms = point_terms(frame.level(level), &at, &point)?;
        Some(PointWeight {
            column: pixel(point.ray_x, intrinsics.fx, intrinsics.cx) as usize,
            row: pixel(point.ray_y, intrinsics.fy, intrinsics.cy) as usize,
            inverse_depth: point.inverse_depth,
            weight: at.intensity_variance / terms.variance,
        })
    });
    weights.collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::alignment::points::Point;
    use crate::slam::alignment::scene::{small_camera, small_plane};

    const LEVEL: usize = 1;

    #[test]
    fn weights_fall_with_depth_variance_and_gradient() {
        let camera = small_camera();
        let keyframe = small_plane().keyframe(&camera, 1, 0.1);
        let reference = Reference::prepare(&keyframe);
        let mut pyramid = SumPyramid::with_size(camera.width, camera.height, 4, LEVEL);
        pyramid.fill(&keyframe.image);
        let params = AlignmentParams::default();
        let weights = |twist: Vector6<f64>| {
            point_weights(&reference, &pyramid, LEVEL, &SE3::exp(&twist), &params)
        };
        let still = weights(Vector6::zeros());
        let inner: Vec<Point> = reference.level(LEVEL).iter().collect();
        assert!(still.len() > 1000 && still.len() <= inner.len());
        assert!(still.iter().all(|point| point.weight == 1.0));
        // The intensity of a point is that of its pixel.
        let image = pyramid.level(LEVEL);
        for point in &still {
            let intensity = f32::from(image.at(point.column, point.row)) * 0.25;
            let is_it =
                |p: &Point| (p.inverse_depth, p.intensity) == (point.inverse_depth, intensity);
            assert!(inner.iter().any(is_it), "{point:?} {intensity}");
        }
        assert!(
            weights(Vector6::new(0.0, 0.0, 0.0, 0.01, 0.05, 0.0)).iter().all(|p| p.weight == 1.0)
        );
        let along_x = weights(Vector6::new(0.1, 0.0, 0.0, 0.0, 0.0, 0.0));
        let doubled = weights(Vector6::new(0.2, 0.0, 0.0, 0.0, 0.0, 0.0));
        // 1/weight - 1 = (∂r/∂d)² V / 2σ_I², and ∂r/∂d is proportional to the translation.
        let mut compared = 0;
        for once in along_x.iter().filter(|point| point.weight < 0.5) {
            let same = |p: &&PointWeight| (p.column, p.row) == (once.column, once.row);
            let Some(twice) = doubled.iter().find(same) else { continue };
            let ratio = (1.0 / twice.weight - 1.0) / (1.0 / once.weight - 1.0);
            assert!((ratio - 4.0).abs() < 0.01, "{ratio}");
            compared += 1;
        }
        assert!(compared > 100, "{compared}");
    }
}
