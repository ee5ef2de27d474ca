//! Matching along a segment against rendered pairs of images: truth, brightness, misses.

use nalgebra::Vector6;

use super::*;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::noise::ImageNoise;
use crate::slam::image::quads::QuadImage;
use crate::slam::kernel::Portable;

const CAMERA: Intrinsics = Intrinsics::pinhole(200, 150, 200.0);
const PLANE_INVERSE_DEPTH: f64 = 0.8;

/// A smooth texture on a fronto-parallel plane, seen by a camera at `current_from_keyframe`.
fn render(current_from_keyframe: &SE3) -> Vec<u8> {
    let keyframe_from_current = current_from_keyframe.inverse();
    let mut pixels = Vec::new();
    for v in 0..CAMERA.height {
        for u in 0..CAMERA.width {
            let ray = CAMERA.ray(u as f64, v as f64);
            let (o, r) = (keyframe_from_current.translation, keyframe_from_current.rotation * ray);
            let s = (1.0 / PLANE_INVERSE_DEPTH - o.z) / r.z;
            let (x, y) = ((o + r * s).x, (o + r * s).y);
            let value = 128.0
                + 50.0 * (40.0 * x).sin() * (33.0 * y + 1.0).cos()
                + 30.0 * (17.0 * x + 23.0 * y).sin();
            pixels.push(value.round() as u8);
        }
    }
    pixels
}

fn quads(pixels: &[u8]) -> QuadImage {
    let mut image = QuadImage::with_size(CAMERA.width, CAMERA.height);
    image.fill(pixels);
    image
}

fn sampled(image: &QuadImage) -> Sampled<'_, Portable> {
    Sampled { image, sampler: Portable }
}

fn range(from: Projection, to: Projection) -> SearchRange {
    SearchRange { from, to, max_px: MatchingParams::default().max_search_px }
}

fn structure(patch: &Patch) -> [f32; 3] {
    let sum = |a: &[f32; 8], b: &[f32; 8]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
    let (gu, gv) = (&patch.gradient_u, &patch.gradient_v);
    [sum(gu, gu), sum(gu, gv), sum(gv, gv)]
}

fn image(pixels: &[u8]) -> GradientImage {
    let mut image = GradientImage::with_size(CAMERA.width, CAMERA.height);
    image.fill(pixels);
    image
}

#[test]
fn matches_agree_with_the_truth_within_their_variance() {
    let params = MatchingParams {
        noise: ImageNoise { pixel_std_dev: 0.5, ..ImageNoise::DEFAULT },
        line_noise_px: 0.02,
        ..MatchingParams::default()
    };
    let motion = SE3::exp(&Vector6::new(0.06, 0.02, 0.03, 0.02, -0.03, 0.05));
    let (keyframe, frame) = (image(&render(&SE3::identity())), quads(&render(&motion)));
    let view = TwoView::new(&CAMERA, &motion);
    let (mut found, mut within, mut errors) = (0, 0, Vec::new());
    for v in (20..130).step_by(7) {
        for u in (20..180).step_by(7) {
            let line = view.line(u as f32, v as f32);
            let patch = Patch::new(&keyframe, u, v, 1.0, 0.0);
            let (Some(from), Some(to)) = (line.project(0.5), line.project(1.2)) else {
                continue;
            };
            let at = line.project(0.85).unwrap();
            let Some(conditioning) = condition(&view, &line, &at, &structure(&patch), 1.0, &params)
            else {
                continue;
            };
            let Ok(found_match) =
                search(sampled(&frame), &line, &patch, &conditioning, &range(from, to), &params)
            else {
                continue;
            };
            let error = f64::from(found_match.inverse_depth) - PLANE_INVERSE_DEPTH;
            found += 1;
            within += usize::from(
                error.abs() <= 3.0 * f64::from(found_match.uncertainty.variance).sqrt(),
            );
            errors.push(error.abs());
        }
    }
    errors.sort_by(f64::total_cmp);
    assert!(found > 200, "{found}");
    assert!(within * 100 >= found * 95, "{within} of {found}");
    assert!(errors[errors.len() / 2] < 0.01, "{}", errors[errors.len() / 2]);
}

#[test]
fn gain_and_offset_are_compensated() {
    let params = MatchingParams::default();
    let motion = SE3::exp(&Vector6::new(0.05, 0.0, 0.0, 0.0, 0.0, 0.0));
    let bright: Vec<u8> =
        render(&motion).iter().map(|&g| (f32::from(g) * 0.8 + 20.0) as u8).collect();
    let (keyframe, frame) = (image(&render(&SE3::identity())), quads(&bright));
    let view = TwoView::new(&CAMERA, &motion);
    let line = view.line(100.0, 75.0);
    let (from, to, at) =
        (line.project(0.4).unwrap(), line.project(1.2).unwrap(), line.project(0.8).unwrap());
    let attempt = |gain, offset| {
        let patch = Patch::new(&keyframe, 100, 75, gain, offset);
        let conditioning = condition(&view, &line, &at, &structure(&patch), 1.0, &params).unwrap();
        search(sampled(&frame), &line, &patch, &conditioning, &range(from, to), &params)
    };
    assert!((attempt(0.8, 20.0).unwrap().inverse_depth - 0.8).abs() < 0.03);
    assert!(attempt(1.0, 0.0).map_or(true, |m| m.mean_squared_residual > 10.0));
}

#[test]
fn what_is_behind_a_mask_is_out_of_view() {
    let params = MatchingParams::default();
    let motion = SE3::exp(&Vector6::new(0.05, 0.0, 0.0, 0.0, 0.0, 0.0));
    let keyframe = image(&render(&SE3::identity()));
    let view = TwoView::new(&CAMERA, &motion);
    let line = view.line(100.0, 75.0);
    let (from, to, at) =
        (line.project(0.4).unwrap(), line.project(1.2).unwrap(), line.project(0.8).unwrap());
    let patch = Patch::new(&keyframe, 100, 75, 1.0, 0.0);
    let conditioning = condition(&view, &line, &at, &structure(&patch), 1.0, &params).unwrap();
    let attempt = |hidden: std::ops::Range<usize>| {
        let mut pixels = render(&motion);
        pixels.chunks_exact_mut(CAMERA.width).for_each(|row| row[hidden.clone()].fill(0));
        let frame = quads(&pixels);
        search(sampled(&frame), &line, &patch, &conditioning, &range(from, to), &params)
    };
    let truth = at.u as usize;
    assert!((attempt(0..1).unwrap().inverse_depth - 0.8).abs() < 0.03);
    // The match, part of its pattern, and all of the frame.
    for hidden in [truth - 3..truth + 4, truth + 1..truth + 3, 0..CAMERA.width] {
        assert!(matches!(attempt(hidden.clone()), Err(Miss::OutOfView)), "{hidden:?}");
    }
}

#[test]
fn a_segment_outside_the_image_or_too_long_is_a_miss() {
    let params = MatchingParams::default();
    let motion = SE3::exp(&Vector6::new(0.5, 0.0, 0.0, 0.0, 0.0, 0.0));
    let (keyframe, frame) = (image(&render(&SE3::identity())), quads(&render(&motion)));
    let view = TwoView::new(&CAMERA, &motion);
    let attempt = |u: usize, d: (f32, f32)| {
        let line = view.line(u as f32, 75.0);
        let patch = Patch::new(&keyframe, u, 75, 1.0, 0.0);
        let at = line.project(0.8).unwrap();
        let conditioning = condition(&view, &line, &at, &structure(&patch), 1.0, &params).unwrap();
        let range = range(line.project(d.0).unwrap(), line.project(d.1).unwrap());
        search(sampled(&frame), &line, &patch, &conditioning, &range, &params)
    };
    assert_eq!(attempt(150, (0.75, 0.85)), Err(Miss::OutOfView));
    assert_eq!(attempt(60, (0.1, 1.5)), Err(Miss::TooLong));
}
