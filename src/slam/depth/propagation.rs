//! Carries the hypotheses of one keyframe to the next (Engel, Sturm, Cremers 2013 §2.5).
//!
//! `d' = 1/z' = d/(r_z + t_z d)` with r_z the third component of R (x, y, 1)ᵀ, and
//! `σ'² = r_z² (d'/d)⁴ σ² + σ_p²`.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::map::{Arrival, BAND_ROWS, BORDER_PX, DepthMap, Hypothesis};
use crate::slam::depth::matching::bilinear;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::Brightness;

/// Tuning of the propagation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PropagationParams {
    /// σ_p over the inverse depth: what rounding to a pixel and the error of the relative pose add.
    /// Half a pixel on a surface seen at 60° is 0.2 % of its depth at f = 500 px.
    pub process_noise_ratio: f32,
    /// Largest brightness difference between the two pixels, grey levels, where there is no gradient.
    pub max_residual: f32,
    /// By how much that grows with each grey level a pixel of gradient at the target.
    pub residual_per_gradient: f32,
    /// Validity a hypothesis keeps at most: what was long proven elsewhere must be confirmed here.
    pub max_validity: u8,
}

impl Default for PropagationParams {
    fn default() -> Self {
        Self {
            process_noise_ratio: 0.004,
            max_residual: 12.0,
            residual_per_gradient: 1.0,
            max_validity: 8,
        }
    }
}

impl PropagationParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("process_noise_ratio", self.process_noise_ratio, 0.0..=0.5)?;
        check_range("max_residual", self.max_residual, 1.0..=255.0)?;
        check_range("residual_per_gradient", self.residual_per_gradient, 0.0..=10.0)?;
        check_range("max_validity", self.max_validity, 1..=255)
    }
}

/// Fills `target` (its image and candidates already in place) from `source`. `brightness` is that of
/// the target's image against the source's.
pub fn propagate(
    source: &DepthMap,
    target: &mut DepthMap,
    intrinsics: &Intrinsics,
    target_from_source: &SE3,
    brightness: Brightness,
    params: &PropagationParams,
) {
    let (width, height) = (source.image.width(), source.image.height());
    let mut arrivals = std::mem::take(&mut target.arrivals);
    arrivals.resize_with(height.div_ceil(BAND_ROWS), Vec::new);
    let way = Way {
        source,
        target,
        view: TwoView::new(intrinsics, target_from_source),
        gain: brightness.a.exp() as f32,
        offset: brightness.b as f32,
        params,
    };
    arrivals.par_iter_mut().enumerate().for_each(|(band, arrivals)| {
        arrivals.clear();
        let rows = band * BAND_ROWS..((band + 1) * BAND_ROWS).min(height);
        for v in rows.filter(|v| (BORDER_PX..height - BORDER_PX).contains(v)) {
            let columns = BORDER_PX..width - BORDER_PX;
            arrivals.extend(columns.filter_map(|u| way.carry_pixel(u, v)));
        }
    });
    // In the order of the source's rows: who comes first to a pixel matters there.
    let present = target.hypotheses.pixels_mut();
    for &(index, arriving) in arrivals.iter().flatten() {
        settle(&mut present[index as usize], arriving);
    }
    target.arrivals = arrivals;
}

/// What a hypothesis needs on its way from one keyframe to the next.
struct Way<'a> {
    source: &'a DepthMap,
    target: &'a DepthMap,
    view: TwoView,
    gain: f32,
    offset: f32,
    params: &'a PropagationParams,
}

impl Way<'_> {
    /// The hypothesis of a source pixel where it arrives, if there is one and it does.
    fn carry_pixel(&self, u: usize, v: usize) -> Option<Arrival> {
        let (source, target, params) = (self.source, self.target, self.params);
        let from = source.hypotheses.at(u, v);
        if !from.is_some() {
            return None;
        }
        let (width, height) = (target.image.width(), target.image.height());
        let line = self.view.line(u as f32, v as f32);
        let at = line.project(from.smoothed)?;
        let margin = BORDER_PX as f32;
        let inside = at.u >= margin
            && at.v >= margin
            && at.u < (width - BORDER_PX) as f32 - 0.5
            && at.v < (height - BORDER_PX) as f32 - 0.5;
        if !inside {
            return None;
        }
        let (tu, tv) = ((at.u + 0.5) as usize, (at.v + 0.5) as usize);
        if !target.candidates.at(tu, tv) {
            return None;
        }
        let expected = self.gain * source.image.intensity.at(u, v) + self.offset;
        let residual = (bilinear(&target.image.intensity, at.u, at.v) - expected).abs();
        let gradient_u = f64::from(target.image.gradient_u.at(tu, tv));
        let gradient_v = f64::from(target.image.gradient_v.at(tu, tv));
        let gradient = (gradient_u * gradient_u + gradient_v * gradient_v).sqrt() as f32;
        if residual > params.max_residual + params.residual_per_gradient * gradient {
            return None;
        }
        Some(((tv * width + tu) as u32, carry(&from, at.depth_ratio, line.pr[2], params)))
    }
}

/// One hypothesis in the target's coordinates: `depth_ratio = d'/d`, `r_z` as in the formula above.
fn carry(from: &Hypothesis, depth_ratio: f32, r_z: f32, params: &PropagationParams) -> Hypothesis {
    let stretch = r_z * depth_ratio * depth_ratio;
    let inverse_depth = from.smoothed * depth_ratio;
    let process = params.process_noise_ratio * inverse_depth;
    Hypothesis {
        inverse_depth,
        variance: stretch * stretch * from.variance + process * process,
        smoothed: inverse_depth,
        validity: from.validity.min(params.max_validity),
        propagated: true,
        failures: 0,
    }
}

/// Two hypotheses on one pixel: fused if consistent, else the nearer one hides the other.
fn settle(present: &mut Hypothesis, arriving: Hypothesis) {
    if !present.is_some() {
        *present = arriving;
        return;
    }
    match joined(*present, &arriving) {
        Some(joined) => *present = joined,
        None if arriving.inverse_depth > present.inverse_depth => *present = arriving,
        None => {}
    }
}

/// Two hypotheses of one pixel as one; `None` where they are of different surfaces.
pub fn joined(one: Hypothesis, other: &Hypothesis) -> Option<Hypothesis> {
    /// Joint standard deviations within which two hypotheses are one surface.
    const SAME_SURFACE_SIGMAS: f32 = 2.0;
    let difference = other.inverse_depth - one.inverse_depth;
    let joint = one.variance + other.variance;
    if !(difference * difference <= SAME_SURFACE_SIGMAS * SAME_SURFACE_SIGMAS * joint) {
        return None;
    }
    let inverse_depth = one.inverse_depth + one.variance / joint * difference;
    Some(Hypothesis {
        inverse_depth,
        smoothed: inverse_depth,
        // They share observations: the mean of two is no more certain than the better one.
        variance: one.variance.min(other.variance),
        validity: one.validity.max(other.validity),
        ..one
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;

    const CAMERA: Intrinsics =
        Intrinsics { fx: 120.0, fy: 120.0, cx: 79.5, cy: 59.5, width: 160, height: 120 };

    fn textured() -> Vec<u8> {
        (0..CAMERA.width * CAMERA.height)
            .map(|i| {
                (128.0
                    + 60.0 * ((i % 160) as f32 * 0.9).sin()
                    + 50.0 * ((i / 160) as f32 * 0.8).cos()) as u8
            })
            .collect()
    }

    fn map_with(d: f32, variance: f32) -> DepthMap {
        let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
        map.restart(&textured(), 1.0, usize::MAX);
        let candidates = map.candidates.clone();
        for (h, c) in map.hypotheses.pixels_mut().iter_mut().zip(candidates.pixels()) {
            if *c {
                *h = Hypothesis {
                    inverse_depth: d,
                    variance,
                    smoothed: d,
                    validity: 5,
                    propagated: false,
                    failures: 0,
                };
            }
        }
        map
    }

    #[test]
    fn depth_and_variance_follow_the_motion_along_the_axis() {
        let (source, mut target) = (map_with(1.0, 1e-4), map_with(1.0, 1e-4));
        target.hypotheses.pixels_mut().fill(Hypothesis::NONE);
        // A lenient colour check: the texture does not move with the surface here.
        let params = PropagationParams {
            max_residual: 255.0,
            process_noise_ratio: 0.0,
            ..PropagationParams::default()
        };
        let forward = SE3::exp(&Vector6::new(0.0, 0.0, -0.2, 0.0, 0.0, 0.0));
        propagate(&source, &mut target, &CAMERA, &forward, Brightness::default(), &params);
        let found: Vec<_> = target.hypotheses.pixels().iter().filter(|h| h.is_some()).collect();
        assert!(found.len() > 1000);
        for h in found {
            assert!((h.inverse_depth - 1.25).abs() < 1e-4);
            assert!((h.variance - 1.25f32.powi(4) * 1e-4).abs() < 1e-7);
        }
    }

    #[test]
    fn the_nearer_of_two_surfaces_wins_and_equal_ones_fuse() {
        let at = |d: f32, variance: f32| Hypothesis {
            inverse_depth: d,
            variance,
            smoothed: d,
            validity: 5,
            propagated: true,
            failures: 0,
        };
        let mut pixel = at(1.0, 1e-4);
        settle(&mut pixel, at(2.0, 1e-4));
        assert_eq!(pixel.inverse_depth, 2.0);
        settle(&mut pixel, at(1.0, 1e-4));
        assert_eq!(pixel.inverse_depth, 2.0);
        settle(&mut pixel, at(2.01, 1e-4));
        assert!((pixel.inverse_depth - 2.005).abs() < 1e-5);
        assert_eq!(pixel.variance, 1e-4);
    }
}
