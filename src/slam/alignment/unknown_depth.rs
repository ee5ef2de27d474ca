//! A view without known depth as a reference: its pixels with gradient, all at the mean depth of the scene, with the
//! uncertainty of depths in a scene.
//!
//! The residual is normalised by its variance, σ_r² = 2σ_I² + (∂r/∂d)² V, and ∂r/∂d is proportional to the translation:
//! such a pixel has full weight while the camera only rotates, and less the further it moves. It constrains the
//! rotation and, as long as it is small, the translation.

use crate::slam::alignment::reference::{Reference, ReferenceScratch};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::sums::{SumPyramid, grey_per_sum};
use crate::slam::keyframe::{DepthPoint, MAX_KEYFRAME_POINTS};
use crate::slam::modes::ModeCovariance;

/// Standard deviation of a point's inverse depth, in units of the mean inverse depth: that of rooms, where the nearest
/// objects are at half the mean distance and the farthest at twice that.
const DEPTH_SPREAD: f32 = 0.5;

/// Standard deviation of tilt along columns and rows, relative inverse depth per unit of the ray's coordinates: that of
/// a wall seen at 45°, whose inverse depth changes by as much as the ray does.
const TILT: f64 = 1.0;

/// Smallest gradient of a point, grey levels per pixel of the finest level: the noise of small cameras there. Dark
/// views may have nothing stronger; otherwise the strongest are chosen.
const MIN_GRADIENT: f32 = 1.0;

/// Prepares references to views without depth in reusable memory.
#[derive(Debug, Clone, Default)]
pub struct UnknownDepth {
    points: Vec<DepthPoint>,
    /// Working memory of the preparation, usable for other references as well.
    pub scratch: ReferenceScratch,
}

impl UnknownDepth {
    /// Makes `reference` a reference to the view in `pyramid`, of a camera with these intrinsics, in units of the mean
    /// depth. Takes over `pyramid` and leaves the previous one of `reference` in its place.
    pub fn prepare(
        &mut self,
        reference: &mut Reference,
        intrinsics: &Intrinsics,
        pyramid: &mut SumPyramid,
    ) {
        self.choose(pyramid);
        let modes = ModeCovariance::of_std_devs([TILT, TILT, 0.0]);
        reference.prepare_view(intrinsics, pyramid, &self.points, modes, &mut self.scratch);
    }

    /// Chooses the pixels of the finest level with gradient, as points of level 0.
    fn choose(&mut self, pyramid: &SumPyramid) {
        self.points.clear();
        let finest = pyramid.finest_level();
        let image = pyramid.level(finest);
        let (width, height) = (image.width(), image.height());
        let grey = grey_per_sum(finest);
        // A regular subset, so that the points of a large image cover all of it.
        let step = (1..).find(|step| width * height <= step * step * MAX_KEYFRAME_POINTS);
        let step = step.unwrap_or(1);
        for v in (1..height.saturating_sub(1)).step_by(step) {
            for u in (1..width.saturating_sub(1)).step_by(step) {
                let at = |u: usize, v: usize| f32::from(image.at(u, v));
                let along_u = 0.5 * grey * (at(u + 1, v) - at(u - 1, v));
                let along_v = 0.5 * grey * (at(u, v + 1) - at(u, v - 1));
                if along_u * along_u + along_v * along_v < MIN_GRADIENT * MIN_GRADIENT {
                    continue;
                }
                self.points.push(DepthPoint {
                    u: (u << finest) as u16,
                    v: (v << finest) as u16,
                    inverse_depth: 1.0,
                    variance: DEPTH_SPREAD * DEPTH_SPREAD,
                    intensity: grey * at(u, v),
                });
            }
        }
    }
}
