//! Which new pixels are searched, and which depth they get.

use nalgebra::Vector6;

use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::test_scene::{CAMERA, Rendering, Scene};

/// Parallax of a point at the mean inverse depth: a segment up to four times as near is 64 px long.
const PARALLAX_PX: f64 = 16.0;
/// The same segment is 120 px long.
const WIDE_PARALLAX_PX: f64 = 30.0;

/// A keyframe without depth, its exact depth, and a distant frame.
struct Fast {
    map: DepthMap,
    /// In units of the mean.
    inverse_depth: Image<f32>,
    frame: QuadImage,
    view: TwoView,
}

impl Fast {
    fn new(parallax_px: f64) -> Self {
        let scene = Scene::new(7);
        let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
        let Rendering { intensity, mut inverse_depth } = scene.render(&CAMERA, &SE3::identity());
        let pixels: Vec<u8> = intensity.pixels().iter().map(|&grey| grey.round() as u8).collect();
        map.restart(&pixels, 5.0, 100_000);
        let candidates = map.candidates.pixels().iter().zip(inverse_depth.pixels());
        let depths: Vec<f32> = candidates.filter(|(is, _)| **is).map(|(_, &depth)| depth).collect();
        let mean = depths.iter().sum::<f32>() / depths.len() as f32;
        inverse_depth.pixels_mut().iter_mut().for_each(|depth| *depth /= mean);
        let step = parallax_px / (CAMERA.fx * f64::from(mean));
        let moved = SE3::exp(&Vector6::new(step, 0.0, 0.0, 0.0, 0.0, 0.0));
        let mut frame = QuadImage::with_size(CAMERA.width, CAMERA.height);
        frame.fill(&scene.render(&CAMERA, &moved).noisy(2.0, 1));
        let mut from_keyframe = moved.inverse();
        from_keyframe.translation *= f64::from(mean);
        Self { map, inverse_depth, frame, view: TwoView::new(&CAMERA, &from_keyframe) }
    }

    /// Observes with one in `known_step` candidates already at its true depth: the number of new hypotheses, and the
    /// map.
    fn created(&self, known_step: usize, params: &GaussianParams) -> (usize, DepthMap) {
        let mut map = self.map.clone();
        let places = self.map.candidates.pixels().iter().enumerate().filter(|(_, is)| **is);
        for (place, _) in places.step_by(known_step) {
            let inverse_depth = self.inverse_depth.pixels()[place];
            let (variance, smoothed) = (1e-6, inverse_depth);
            let known = Hypothesis { inverse_depth, variance, smoothed, ..Hypothesis::NONE };
            map.hypotheses.pixels_mut()[place] = Hypothesis { validity: 8, ..known };
        }
        let (brightness, pixels) = (Brightness::default(), ObservedPixels::All);
        let observer = Observer { image: &self.frame, view: self.view, brightness, pixels };
        let matching = MatchingParams::default();
        let counts = observe(&mut map, &observer, &matching, params).counts;
        // Lists and pixels give the same counts.
        let listed = map.hypotheses.count_known_and_unknown(&map.candidates);
        map.hypotheses.pixels_mut();
        assert_eq!(map.hypotheses.count_known_and_unknown(&map.candidates), listed);
        (counts.created, map)
    }
}

/// The share of a keyframe's candidates that got depth from a distant frame, and their largest inverse depth; checks
/// that their variances are consistent with their errors.
fn found(fast: &Fast, params: &GaussianParams) -> (f64, f32) {
    let (created, map) = fast.created(usize::MAX, params);
    let candidates = fast.map.candidates.pixels().iter().filter(|is| **is).count();
    let pixels = map.hypotheses.pixels().iter().zip(fast.inverse_depth.pixels());
    let with_depth = || pixels.clone().filter(|(hypothesis, _)| hypothesis.is_some());
    let mut errors: Vec<f32> = with_depth()
        .map(|(h, truth)| (h.inverse_depth - truth).abs() / h.variance.sqrt())
        .collect();
    errors.sort_by(f32::total_cmp);
    assert!(errors[errors.len() / 2] < 1.0, "{}", errors[errors.len() / 2]);
    assert!(errors[errors.len() * 9 / 10] < 3.0, "{}", errors[errors.len() * 9 / 10]);
    let nearest = with_depth().map(|(h, _)| h.inverse_depth).fold(0.0, f32::max);
    (created as f64 / candidates as f64, nearest)
}

#[test]
fn a_keyframe_short_of_depth_gets_it_from_a_distant_frame() {
    let (share, _) = found(&Fast::new(PARALLAX_PX), &GaussianParams::default());
    assert!(share > 0.25, "{share}");
}

#[test]
fn the_far_part_of_longer_segments_is_searched() {
    for (parallax_px, max_px) in [(PARALLAX_PX, 40.0), (WIDE_PARALLAX_PX, 90.0)] {
        let params = GaussianParams { max_first_search_px: max_px, ..GaussianParams::default() };
        let (share, nearest) = found(&Fast::new(parallax_px), &params);
        assert!(share > 0.25, "{parallax_px} px: {share}");
        // The refinement may overshoot a little.
        let end = (max_px + 2.0) / parallax_px as f32;
        assert!(nearest < end, "{parallax_px} px: {nearest}, {end}");
    }
}

#[test]
fn a_keyframe_with_depth_waits_for_a_nearer_frame() {
    let fast = Fast::new(PARALLAX_PX);
    let params = GaussianParams::default();
    assert_eq!(fast.created(2, &params).0, 0);
    assert!(fast.created(4, &params).0 > 0);
}
