//! Consistency of a map: whether keyframes that see the same place agree about it.
//!
//! No ground truth is needed. Consecutive keyframes agree by construction, as the later depth is propagated from the
//! earlier; keyframes further apart got their poses and scales along different paths, and whatever drifted between them
//! shows as a misfit in pixels.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::slam::evaluation::depth_agreement::{DepthAgreement, depth_agreement, point_index};
use crate::slam::evaluation::patch_misfit::{PatchMisfit, ReducedImage, patch_misfit};
use crate::slam::evaluation::shared_view::{Pair, SharedView, pairs};
use crate::slam::evaluation::statistics::median;
use crate::slam::keyframe::Keyframe;

/// Agreement over the pairs of a map: medians. A wide pair has other keyframes in between.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct MapConsistency {
    /// Wide pairs that share at least 30 % of their view and have enough texture.
    pub wide_pairs: u64,
    /// Frames between the keyframes of the widest of these pairs: drift that takes longer is not seen.
    pub longest_span_frames: u64,
    /// Shift between where the map predicts a patch in the later image and where it is found, pixels; wide pairs.
    /// Shifts beyond 1.9 % of the width (12 px of 640) along an axis are not searched: a median of three quarters of
    /// that is no agreement at all.
    pub wide_misfit_px: Option<f64>,
    /// The same for neighbouring keyframes.
    pub near_misfit_px: Option<f64>,
    /// Share of the patches of wide pairs whose texture was found within that reach.
    pub wide_found: Option<f64>,
    /// Relative difference of depth, wide pairs.
    pub wide_depth_difference: Option<f64>,
    /// Share of depths that agree within three standard deviations, wide pairs.
    pub wide_depth_within_3_sigma: Option<f64>,
    /// Slope of the relative difference of depth by ray coordinate (1 is 45°), wide pairs.
    pub wide_depth_tilt: Option<f64>,
}

impl MapConsistency {
    /// Measures a map: 2 to 4 ms per pair at 640 columns, at most four pairs for each of sixty keyframes.
    pub fn measure(keyframes: &[Keyframe]) -> Self {
        let pairs = pairs(keyframes);
        let of_each: Vec<_> = pairs.chunk_by(|a, b| a.later == b.later).collect();
        let textured: Vec<Compared> = of_each
            .par_iter()
            .flat_map_iter(|of_later| compare(keyframes, of_later))
            .filter(|pair| pair.misfit.has_texture)
            .collect();
        let (wide, near): (Vec<_>, Vec<_>) = textured.into_iter().partition(|pair| pair.is_wide);
        let misfit =
            |of: &[Compared]| median(&of.iter().map(|of| of.misfit.median_px).collect::<Vec<_>>());
        let depths: Vec<_> = wide.iter().filter_map(|pair| pair.depth).collect();
        let depth =
            |part: fn(&DepthAgreement) -> f64| median(&depths.iter().map(part).collect::<Vec<_>>());
        Self {
            wide_pairs: wide.len() as u64,
            longest_span_frames: wide.iter().map(|pair| pair.span_frames).max().unwrap_or(0),
            wide_misfit_px: misfit(&wide),
            near_misfit_px: misfit(&near),
            wide_found: median(&wide.iter().map(|pair| pair.misfit.found).collect::<Vec<_>>()),
            wide_depth_difference: depth(|d| d.difference),
            wide_depth_within_3_sigma: depth(|d| d.within_3_sigma),
            wide_depth_tilt: depth(|d| d.tilt),
        }
    }
}

/// Result of comparing a pair.
struct Compared {
    is_wide: bool,
    span_frames: u64,
    misfit: PatchMisfit,
    /// For a wide pair where enough depths coincide.
    depth: Option<DepthAgreement>,
}

/// Compares the pairs of one later keyframe.
fn compare(keyframes: &[Keyframe], of_later: &[Pair]) -> Vec<Compared> {
    let later = &keyframes[of_later[0].later];
    let (image, index) = (ReducedImage::of(later), point_index(later));
    let compare = |pair: &Pair| {
        let earlier = &keyframes[pair.earlier];
        let view = SharedView::new(earlier, later);
        Compared {
            is_wide: pair.is_wide,
            span_frames: later.sequence.saturating_sub(earlier.sequence),
            misfit: patch_misfit(&view, &ReducedImage::of(earlier), &image),
            depth: pair.is_wide.then(|| depth_agreement(&view, &index)).flatten(),
        }
    };
    of_later.iter().map(compare).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::{DepthPoint, MapState};

    const WIDTH: usize = 320;
    const HEIGHT: usize = 240;
    const FOCAL: f64 = 300.0;
    /// Step to the right from keyframe to keyframe, as a share of the depth: 9 pixels.
    const STEP: f64 = 0.03;

    /// Texture of a wall at depth 1.
    fn grey(x: f64, y: f64) -> u8 {
        let waves = [(41.0, 13.0), (-17.0, 53.0), (29.0, -37.0), (7.0, 61.0), (83.0, 19.0)];
        let sum: f64 = waves.iter().map(|(a, b)| (a * x + b * y + 0.3 * a).sin()).sum();
        (128.0 + 20.0 * sum) as u8
    }

    /// A keyframe in front of the wall that the map places at `x`, with this scale and depth.
    fn keyframe(index: u64, x: f64, scale: f64, depth: impl Fn(f64) -> f64) -> Keyframe {
        let truth = STEP * index as f64;
        let ray = |at: usize, side: usize| (at as f64 - 0.5 * (side as f64 - 1.0)) / FOCAL;
        let pixel = |i: usize| grey(ray(i % WIDTH, WIDTH) + truth, ray(i / WIDTH, HEIGHT));
        let points = (0..WIDTH * HEIGHT).step_by(3).map(|i| DepthPoint {
            u: (i % WIDTH) as u16,
            v: (i / WIDTH) as u16,
            inverse_depth: (1.0 / depth(ray(i % WIDTH, WIDTH))) as f32,
            variance: 1e-4,
            intensity: 0.0,
        });
        let rigid = SE3::exp(&Vector6::new(x, 0.0, 0.0, 0.0, 0.0, 0.0));
        Keyframe {
            keyframe_id: index,
            sequence: 10 * index,
            ..Keyframe::at(
                Sim3::new(rigid, scale),
                Intrinsics::pinhole(WIDTH, HEIGHT, FOCAL),
                points.collect(),
                (0..WIDTH * HEIGHT).map(pixel).collect(),
            )
        }
    }

    #[test]
    fn a_correct_map_agrees_with_itself() {
        let map: Vec<_> = (0..5).map(|i| keyframe(i, STEP * i as f64, 1.0, |_| 1.0)).collect();
        let figures = MapConsistency::measure(&map);
        assert_eq!((figures.wide_pairs, figures.longest_span_frames), (6, 40));
        assert!(figures.wide_misfit_px.unwrap() < 0.2, "{figures:?}");
        assert!(figures.near_misfit_px.unwrap() < 0.2, "{figures:?}");
        assert!(figures.wide_found.unwrap() > 0.95, "{figures:?}");
        assert!(figures.wide_depth_difference.unwrap() < 1e-3, "{figures:?}");
        assert!(figures.wide_depth_within_3_sigma.unwrap() > 0.99, "{figures:?}");
        assert!(figures.wide_depth_tilt.unwrap() < 1e-3, "{figures:?}");
    }

    #[test]
    fn a_drift_of_position_scale_or_tilt_shows_between_distant_keyframes() {
        // Each step is a tenth longer than the one before, as with a scale that grows while depth does not.
        let stretched = |i: u64| (0..i).map(|k| STEP * 1.1f64.powi(k as i32)).sum::<f64>();
        let map: Vec<_> = (0..5).map(|i| keyframe(i, stretched(i), 1.0, |_| 1.0)).collect();
        let figures = MapConsistency::measure(&map);
        // The pairs 0-2 to 0-4 and 1-3 to 2-4: 0.9 to 5.8 px, 3.1 in the middle.
        assert!((figures.wide_misfit_px.unwrap() - 3.1).abs() < 1.0, "{figures:?}");
        assert!(figures.near_misfit_px.unwrap() < figures.wide_misfit_px.unwrap());

        let grown = |i: u64| 1.05f64.powi(i as i32);
        let map: Vec<_> = (0..5).map(|i| keyframe(i, STEP * i as f64, grown(i), |_| 1.0)).collect();
        let figures = MapConsistency::measure(&map);
        assert!((figures.wide_depth_difference.unwrap() - 0.12).abs() < 0.05, "{figures:?}");

        let tilted = |i: u64| move |x: f64| 1.0 + 0.05 * i as f64 * x;
        let map: Vec<_> = (0..5).map(|i| keyframe(i, STEP * i as f64, 1.0, tilted(i))).collect();
        let figures = MapConsistency::measure(&map);
        assert!((figures.wide_depth_tilt.unwrap() - 0.1).abs() < 0.04, "{figures:?}");
    }

    #[test]
    fn keyframes_that_cannot_be_compared_are_left_out() {
        assert_eq!(MapConsistency::measure(&[]), MapConsistency::default());
        let mut map: Vec<_> = (0..5).map(|i| keyframe(i, STEP * i as f64, 1.0, |_| 1.0)).collect();
        // Depth dropped to save memory; another epoch; not established; a different view; non-finite values.
        map[0].forget_depth();
        map[1].epoch = 1;
        map[2].map_state = MapState::Rejected;
        map[3].map_from_keyframe =
            Sim3::new(SE3::exp(&Vector6::new(9.0, 0.0, 0.0, 0.0, 0.0, 0.0)), 1.0);
        map[4].map_from_keyframe.scale = f64::NAN;
        for point in &mut map[4].points[..50] {
            (point.inverse_depth, point.variance) = (f32::INFINITY, f32::NAN);
        }
        assert_eq!(MapConsistency::measure(&map), MapConsistency::default());
    }
}
