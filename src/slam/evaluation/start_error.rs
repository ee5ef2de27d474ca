//! Errors of a start from two frames: its motion and its depth against the truth.

use crate::slam::evaluation::depth_error::{DepthErrors, DepthScale, DepthStatistics};
use crate::slam::evaluation::depth_modes::DepthModes;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::slam::two_frame::InitialDepth;

/// Direction error above which a start is wrong, degrees: half of it may be noise of a short baseline, a wrong minimum
/// is further off.
pub const WRONG_DIRECTION_DEG: f64 = 30.0;
/// Median relative depth error above which a start is wrong.
pub const WRONG_DEPTH: f64 = 0.15;
/// Standard deviation of the relative depth error from tilt and relief together above which a start is wrong: poses
/// absorb it, and the frames that follow take it for the shape of the scene.
pub const WRONG_SHAPE: f64 = 0.15;

/// The errors of a start.
#[derive(Debug, Clone, PartialEq)]
pub struct StartErrors {
    /// Angle between the translation and the true one, degrees.
    pub direction_deg: f64,
    /// Angle between the rotation and the true one, degrees.
    pub rotation_deg: f64,
    /// Length of the true translation, metres.
    pub baseline_m: f64,
    /// The errors of its depths; `None` where the first frame's true depth is unknown.
    pub depth: Option<DepthStatistics>,
    /// Tilt and relief of its depths; `None` also where too few points distinguish them.
    pub modes: Option<DepthModes>,
    /// Relative error that they cause together, see [`DepthModes::spread`].
    pub shape: Option<f64>,
}

impl StartErrors {
    /// Errors of a start that found `first_from_current` where `truth` is right, and the `depths` of the first frame,
    /// whose `true_depth` is in metres and 0 where unknown.
    pub fn of(
        first_from_current: &SE3,
        depths: impl Iterator<Item = InitialDepth>,
        camera: &Intrinsics,
        truth: &SE3,
        true_depth: Option<&Image<f32>>,
    ) -> Self {
        let (found, right) = (first_from_current.translation, truth.translation);
        let cosine = found.dot(&right) / (found.norm() * right.norm()).max(f64::MIN_POSITIVE);
        let (mut errors, mut modes, mut shape) = (DepthErrors::default(), None, None);
        if let Some(true_depth) = true_depth {
            let points = depths.map(|InitialDepth { u, v, inverse_depth, variance }| DepthPoint {
                u,
                v,
                inverse_depth,
                variance,
                intensity: 0.0,
            });
            let first = Keyframe::at(Sim3::identity(), *camera, points.collect(), Vec::new());
            errors.add(&first, true_depth, DepthScale::MedianRatio);
            modes = DepthModes::of(&first, true_depth, 1.0);
            shape = modes.map(|modes| modes.spread(&first, true_depth));
        }
        Self {
            direction_deg: cosine.clamp(-1.0, 1.0).acos().to_degrees(),
            rotation_deg: first_from_current.rotation.angle_to(&truth.rotation).to_degrees(),
            baseline_m: right.norm(),
            depth: errors.statistics(),
            modes,
            shape,
        }
    }

    /// Whether the start is too wrong to build on.
    pub fn is_wrong(&self) -> bool {
        let depth = self.depth.is_some_and(|depth| depth.relative_error_median > WRONG_DEPTH);
        let shape = self.shape.is_some_and(|shape| shape > WRONG_SHAPE);
        !(self.direction_deg <= WRONG_DIRECTION_DEG) || depth || shape
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics::pinhole(64, 48, 60.0);

    /// The errors of a start that is right except for its direction and for depths whose logarithm is stretched.
    fn errors(direction_deg: f64, relief: f64, noise: f64) -> StartErrors {
        let (sine, cosine) = direction_deg.to_radians().sin_cos();
        let at = |x: f64, y: f64| SE3 { translation: [x, y, 0.0].into(), ..SE3::identity() };
        let mut truth = Image::filled(CAMERA.width, CAMERA.height, 0.0f32);
        let mut depths = Vec::new();
        for (k, z) in truth.pixels_mut().iter_mut().enumerate() {
            *z = 1.0 + (k * 7919 % 1000) as f32 / 500.0;
            let wrong = if k % 2 == 0 { 1.0 + noise } else { 1.0 - noise };
            let inverse_depth = z.powf(relief as f32 - 1.0) * wrong as f32;
            let (u, v) = ((k % CAMERA.width) as u16, (k / CAMERA.width) as u16);
            depths.push(InitialDepth { u, v, inverse_depth, variance: 0.01 });
        }
        let found = at(0.02 * cosine, 0.02 * sine);
        StartErrors::of(&found, depths.into_iter(), &CAMERA, &at(0.1, 0.0), Some(&truth))
    }

    #[test]
    fn each_error_alone_makes_a_start_wrong() {
        let right = errors(20.0, 0.1, 0.05);
        assert!((right.direction_deg - 20.0).abs() < 1e-6 && right.rotation_deg < 1e-6);
        assert!((right.baseline_m - 0.1).abs() < 1e-12);
        assert!((right.modes.unwrap().relief - 0.1).abs() < 0.01, "{right:?}");
        assert!(!right.is_wrong(), "{right:?}");
        assert!(errors(40.0, 0.0, 0.0).is_wrong());
        assert!(errors(0.0, 0.0, 0.3).is_wrong());
        // A median of 0.13 alone would pass.
        let flat = errors(0.0, 0.55, 0.0);
        assert!(flat.depth.unwrap().relative_error_median < WRONG_DEPTH, "{flat:?}");
        assert!(flat.shape.unwrap() > WRONG_SHAPE && flat.is_wrong(), "{flat:?}");
        assert!(!errors(0.0, 0.0, 0.0).is_wrong());
    }

    #[test]
    fn a_start_without_motion_or_truth_is_judged_by_the_errors_that_exist() {
        let none = std::iter::empty();
        let moved = SE3 { translation: [0.1, 0.0, 0.0].into(), ..SE3::identity() };
        let found = StartErrors::of(&moved, none.clone(), &CAMERA, &moved, None);
        assert!(!found.is_wrong() && found.depth.is_none() && found.modes.is_none());
        // It claims a motion where there was none.
        assert!(StartErrors::of(&moved, none, &CAMERA, &SE3::identity(), None).is_wrong());
    }
}
