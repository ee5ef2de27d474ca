//! Propagates the hypotheses of one keyframe to the next (Engel, Sturm, Cremers 2013 §2.5).
//!
//! `d' = 1/z' = d/(r_z + t_z d)` with r_z the third component of R (x, y, 1)ᵀ, and
//! `σ'² = r_z² (d'/d)⁴ σ² + σ_p²`.

use std::ops::Range;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::{MIN_DEPTH_RATIO, TwoView};
use crate::slam::depth::gradient_image::{BAND_ROWS, BORDER_PX};
use crate::slam::depth::map::{DepthMap, Hypothesis, Reprojected};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::kernel::{Body, Instructions, Kernel};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::Brightness;

/// Tuning of the propagation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PropagationParams {
    /// σ_p over the inverse depth: the error added by rounding to a pixel and by the relative pose. Half a pixel on a
    /// surface seen at 60° is 0.2 % of its depth at f = 500 px.
    pub process_noise_ratio: f32,
    /// Largest brightness difference between the two pixels, grey levels, where there is no gradient.
    pub max_residual: f32,
    /// Growth of that limit with each grey level per pixel of gradient at the target.
    pub residual_per_gradient: f32,
    /// Upper bound of the validity after propagation: a hypothesis long proven elsewhere must be confirmed here.
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

/// Fills `target` (its image and candidates already in place) from `source`. `brightness` is that of the target's image
/// relative to the source's.
pub fn propagate(
    source: &DepthMap,
    target: &mut DepthMap,
    intrinsics: &Intrinsics,
    target_from_source: &SE3,
    brightness: Brightness,
    params: &PropagationParams,
) {
    let height = source.image.height();
    let mut reprojected = std::mem::take(&mut target.reprojected);
    reprojected.resize_with(height.div_ceil(BAND_ROWS), Vec::new);
    let view = TwoView::new(intrinsics, target_from_source);
    let (gain, offset) = (brightness.a.exp() as f32, brightness.b as f32);
    let reprojection = Reprojection { source, target, view, gain, offset, params };
    let kernel = Kernel::fastest();
    reprojected.par_iter_mut().enumerate().for_each(|(band, reprojected)| {
        reprojected.clear();
        let (first, end) = (band * BAND_ROWS, (band + 1) * BAND_ROWS);
        let rows = first.max(BORDER_PX)..end.min(height - BORDER_PX);
        kernel.run(PropagatedRows { reprojection: &reprojection, rows, reprojected });
    });
    // In the order of the source's rows: the result depends on which hypothesis reaches a pixel first.
    let present = target.hypotheses.pixels_mut();
    for &(index, arriving) in reprojected.iter().flatten() {
        merge_or_occlude(&mut present[index as usize], arriving);
    }
    target.reprojected = reprojected;
}

/// Everything needed to propagate a hypothesis from one keyframe to the next.
struct Reprojection<'a> {
    source: &'a DepthMap,
    target: &'a DepthMap,
    view: TwoView,
    gain: f32,
    offset: f32,
    params: &'a PropagationParams,
}

/// Hypotheses that are projected at once.
const LANES: usize = 16;

/// Projections of [`LANES`] source pixels.
struct Projections {
    u: [f32; LANES],
    v: [f32; LANES],
    depth_ratio: [f32; LANES],
    /// r_z of the formula above.
    r_z: [f32; LANES],
    /// Whether they lie inside the target's border.
    inside: [bool; LANES],
}

/// Source rows whose hypotheses are propagated, and the results, in their order.
struct PropagatedRows<'a> {
    reprojection: &'a Reprojection<'a>,
    rows: Range<usize>,
    reprojected: &'a mut Vec<Reprojected>,
}

impl Body for PropagatedRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        self.reprojection.propagate_rows(self.rows, self.reprojected);
    }
}

impl Reprojection<'_> {
    #[inline(always)]
    fn propagate_rows(&self, rows: Range<usize>, reprojected: &mut Vec<Reprojected>) {
        let mut memory = Vec::new();
        for v in rows {
            let hypotheses = self.source.hypotheses.row(v);
            let known = self.source.hypotheses.known_columns(v, &mut memory);
            for columns in known.chunks(LANES) {
                let places = self.project(hypotheses, columns, v);
                let inside = columns.iter().enumerate().filter(|(k, _)| places.inside[*k]);
                reprojected.extend(inside.filter_map(|(k, &u)| {
                    let u = usize::from(u);
                    self.reproject(
                        &hypotheses[u],
                        f32::from(self.source.image.intensity.at(u, v)),
                        &places,
                        k,
                    )
                }));
            }
        }
    }

    /// The projections of some hypotheses of row `v`, with the same operations as
    /// [`EpipolarLine::project`](crate::slam::depth::epipolar::EpipolarLine::project).
    #[inline(always)]
    fn project(&self, hypotheses: &[Hypothesis], columns: &[u16], v: usize) -> Projections {
        let (m, kt) = (&self.view.rotation, &self.view.translation);
        let (width, height) = (self.target.image.width(), self.target.image.height());
        let margin = BORDER_PX as f32;
        let right = (width - BORDER_PX) as f32 - 0.5;
        let bottom = (height - BORDER_PX) as f32 - 0.5;
        let (mut columns_u, mut d) = ([0.0; LANES], [0.0; LANES]);
        for (k, &u) in columns.iter().enumerate() {
            (columns_u[k], d[k]) = (f32::from(u), hypotheses[usize::from(u)].smoothed);
        }
        let v = v as f32;
        let zero = [0.0; LANES];
        let inside = [false; LANES];
        let mut places = Projections { u: zero, v: zero, depth_ratio: zero, r_z: zero, inside };
        for k in 0..LANES {
            let u = columns_u[k];
            let pr_u = m[0][0] * u + m[0][1] * v + m[0][2];
            let pr_v = m[1][0] * u + m[1][1] * v + m[1][2];
            let pr_z = m[2][0] * u + m[2][1] * v + m[2][2];
            let z = pr_z + kt[2] * d[k];
            let depth_ratio = 1.0 / z;
            let at_u = (pr_u + kt[0] * d[k]) * depth_ratio;
            let at_v = (pr_v + kt[1] * d[k]) * depth_ratio;
            (places.u[k], places.v[k]) = (at_u, at_v);
            (places.depth_ratio[k], places.r_z[k]) = (depth_ratio, pr_z);
            places.inside[k] = (z > MIN_DEPTH_RATIO)
                & (at_u >= margin)
                & (at_v >= margin)
                & (at_u < right)
                & (at_v < bottom);
        }
        places
    }

    /// The hypothesis `from`, of a pixel of this `intensity`, at its projection, if the brightness there matches.
    #[inline(always)]
    fn reproject(
        &self,
        from: &Hypothesis,
        intensity: f32,
        places: &Projections,
        k: usize,
    ) -> Option<Reprojected> {
        let (image, params) = (&self.target.image, self.params);
        let (u, v) = (places.u[k], places.v[k]);
        // Through i32: the value fits, and the conversion is a single instruction.
        let (column, row) = ((u + 0.5) as i32 as usize, (v + 0.5) as i32 as usize);
        let index = row * image.width() + column;
        if !self.target.candidates.pixels()[index] {
            return None;
        }
        let expected = self.gain * intensity + self.offset;
        let residual = (image.intensity.bilinear(u, v) - expected).abs();
        let (gradient_u, gradient_v) = image.gradient(index);
        let (gradient_u, gradient_v) = (f64::from(gradient_u), f64::from(gradient_v));
        let gradient = (gradient_u * gradient_u + gradient_v * gradient_v).sqrt() as f32;
        if !(residual <= params.max_residual + params.residual_per_gradient * gradient) {
            return None;
        }
        Some((
            index as u32,
            propagated_hypothesis(from, places.depth_ratio[k], places.r_z[k], params),
        ))
    }
}

/// One hypothesis in the target's coordinates: `depth_ratio = d'/d`, `r_z` as in the formula above.
#[inline(always)]
fn propagated_hypothesis(
    from: &Hypothesis,
    depth_ratio: f32,
    r_z: f32,
    params: &PropagationParams,
) -> Hypothesis {
    let stretch = r_z * depth_ratio * depth_ratio;
    let inverse_depth = from.smoothed * depth_ratio;
    let process = params.process_noise_ratio * inverse_depth;
    Hypothesis {
        inverse_depth,
        variance: stretch * stretch * from.variance + process * process,
        independent: stretch * stretch * from.independent + process * process,
        smoothed: inverse_depth,
        validity: from.validity.min(params.max_validity),
        propagated: true,
        failures: 0,
    }
}

/// Merges two hypotheses on one pixel: fused if consistent, else the nearer one hides the other.
#[inline]
fn merge_or_occlude(present: &mut Hypothesis, arriving: Hypothesis) {
    if !present.is_some() {
        *present = arriving;
        return;
    }
    match merged_hypothesis(*present, &arriving) {
        Some(joined) => *present = joined,
        None if arriving.inverse_depth > present.inverse_depth => *present = arriving,
        None => {}
    }
}

/// Two hypotheses of one pixel as one; `None` if they are on different surfaces.
#[inline]
pub fn merged_hypothesis(one: Hypothesis, other: &Hypothesis) -> Option<Hypothesis> {
    /// Joint standard deviations within which two hypotheses are one surface.
    const SAME_SURFACE_SIGMAS: f32 = 2.0;
    let difference = other.inverse_depth - one.inverse_depth;
    let joint = one.variance + other.variance;
    if !(joint > 0.0
        && difference * difference <= SAME_SURFACE_SIGMAS * SAME_SURFACE_SIGMAS * joint)
    {
        return None;
    }
    let inverse_depth = one.inverse_depth + one.variance / joint * difference;
    Some(Hypothesis {
        inverse_depth,
        smoothed: inverse_depth,
        // They share observations: the mean of two is no more certain than the better one.
        variance: one.variance.min(other.variance),
        independent: if other.variance < one.variance {
            other.independent
        } else {
            one.independent
        },
        validity: one.validity.max(other.validity),
        ..one
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::test_scene::{CAMERA as SCENE_CAMERA, Scene};

    const CAMERA: Intrinsics = Intrinsics::pinhole(160, 120, 120.0);

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
                    independent: variance,
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
        // A lenient brightness check: the texture does not move with the surface here.
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
    fn brightness_is_that_of_the_target_relative_to_the_source() {
        // Darker and less contrast: nothing is clipped.
        let brightness = Brightness { a: -0.3, b: 20.0 };
        let gain = brightness.a.exp();
        let shown = |grey: u8| (gain * f64::from(grey) + brightness.b).round() as u8;
        let shown: Vec<u8> = textured().into_iter().map(shown).collect();
        let params = PropagationParams {
            max_residual: 2.0,
            residual_per_gradient: 0.0,
            ..PropagationParams::default()
        };
        let kept = |brightness: Brightness| {
            let (source, mut target) = (map_with(1.0, 1e-4), map_with(1.0, 1e-4));
            target.restart(&shown, 1.0, usize::MAX);
            propagate(&source, &mut target, &CAMERA, &SE3::identity(), brightness, &params);
            target.num_hypotheses() as f64 / source.num_hypotheses() as f64
        };
        let opposite = Brightness { a: -brightness.a, b: -brightness.b / gain };
        let (right, wrong) = (kept(brightness), kept(opposite));
        assert!(right > 0.9 && wrong < 0.2, "{right} {wrong}");
        // Each of the two parameters matters.
        let half = kept(Brightness { b: -brightness.b, ..brightness });
        assert!(half < 0.2, "{half}");
    }

    #[test]
    fn the_nearer_of_two_surfaces_wins_and_consistent_ones_fuse() {
        let at = |d: f32, variance: f32| Hypothesis {
            inverse_depth: d,
            variance,
            independent: variance,
            smoothed: d,
            validity: 5,
            propagated: true,
            failures: 0,
        };
        let mut pixel = at(1.0, 1e-4);
        merge_or_occlude(&mut pixel, at(2.0, 1e-4));
        assert_eq!(pixel.inverse_depth, 2.0);
        merge_or_occlude(&mut pixel, at(1.0, 1e-4));
        assert_eq!(pixel.inverse_depth, 2.0);
        merge_or_occlude(&mut pixel, at(2.01, 1e-4));
        assert!((pixel.inverse_depth - 2.005).abs() < 1e-5);
        assert_eq!(pixel.variance, 1e-4);
        // Without variances there is no weighting.
        assert!(merged_hypothesis(at(1.0, 0.0), &at(1.0, 0.0)).is_none());
    }

    #[test]
    fn every_kernel_gives_the_bits_of_the_single_pixel_projection() {
        let scene = Scene::new(6);
        let new_from_old = SE3::exp(&Vector6::new(0.1, -0.02, 0.05, 0.01, 0.02, -0.03));
        let mut maps = [SE3::identity(), new_from_old.inverse()].map(|world_from_camera| {
            let mut map = DepthMap::with_size(SCENE_CAMERA.width, SCENE_CAMERA.height);
            map.restart(
                &scene.render(&SCENE_CAMERA, &world_from_camera).noisy(2.0, 1),
                5.0,
                100_000,
            );
            map
        });
        let depth = scene.render(&SCENE_CAMERA, &SE3::identity()).inverse_depth;
        for (i, h) in maps[0].hypotheses.pixels_mut().iter_mut().enumerate() {
            let smoothed = depth.pixels()[i];
            let known = Hypothesis { smoothed, variance: 1e-4, validity: 9, ..Hypothesis::NONE };
            *h = if i % 5 < 3 { known } else { Hypothesis::NONE };
        }
        let params = PropagationParams::default();
        let view = TwoView::new(&SCENE_CAMERA, &new_from_old);
        let [source, target] = &maps;
        let (gain, offset) = (1.02, -1.0);
        let carrier = Reprojection { source, target, view, gain, offset, params: &params };
        let rows = BORDER_PX..SCENE_CAMERA.height - BORDER_PX;
        let (mut portable, mut fast) = (Vec::new(), Vec::new());
        let carry = |kernel: Kernel, reprojected| {
            kernel.run(PropagatedRows { reprojection: &carrier, rows: rows.clone(), reprojected });
        };
        carry(Kernel::Portable, &mut portable);
        carry(Kernel::fastest(), &mut fast);
        assert_eq!(portable, fast);
        // The expected index and depth of each, by the geometry of a single pixel.
        let mut expected = Vec::new();
        for (u, v) in rows.flat_map(|v| (0..SCENE_CAMERA.width).map(move |u| (u, v))) {
            let from = maps[0].hypotheses.at(u, v);
            let Some(at) = view.line(u as f32, v as f32).project(from.smoothed) else { continue };
            if from.is_some() {
                let index = (at.v + 0.5) as usize * SCENE_CAMERA.width + (at.u + 0.5) as usize;
                expected.push((index as u32, (from.smoothed * at.depth_ratio).to_bits()));
            }
        }
        let mut expected = expected.into_iter();
        let arrived = portable.iter().map(|(index, h)| (*index, h.inverse_depth.to_bits()));
        assert!(portable.len() > 3000, "{}", portable.len());
        assert!(arrived.into_iter().all(|arrival| expected.any(|other| other == arrival)));
    }
}
