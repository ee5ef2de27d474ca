//! Monte-Carlo tests of the interval filter with exact poses.

use nalgebra::Vector6;

use super::*;
use crate::slam::depth::epipolar::TwoView;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::quads::QuadImage;
use crate::slam::pose::Brightness;
use crate::slam::test_scene::{CAMERA, Random, Rendering, Scene};

/// A camera path of one seed: mostly sideways, or forwards, with a slow turn.
fn path(seed: u64, frames: usize) -> Vec<SE3> {
    let mut random = Random::new(seed);
    let angle = std::f64::consts::TAU * random.uniform();
    let forward = 0.6 * (random.uniform() - 0.5);
    let turn = [0; 3].map(|_| 0.004 * random.normal());
    (0..frames)
        .map(|i| {
            let s = 0.008 * i as f64;
            let turn = turn.map(|w| w * i as f64);
            let (x, y, z) = (s * angle.cos(), 0.6 * s * angle.sin(), s * forward);
            SE3::exp(&Vector6::new(x, y, z, turn[0], turn[1], turn[2]))
        })
        .collect()
}

fn gradient_image(pixels: &[u8]) -> GradientImage {
    let mut image = GradientImage::with_size(CAMERA.width, CAMERA.height);
    image.fill(pixels);
    image
}

fn quad_image(pixels: &[u8]) -> QuadImage {
    let mut image = QuadImage::with_size(CAMERA.width, CAMERA.height);
    image.fill(pixels);
    image
}

struct Sequence {
    keyframe: GradientImage,
    truth: Rendering,
    pixels: Vec<Vec<u8>>,
    frames: Vec<(QuadImage, TwoView)>,
}

impl Sequence {
    fn new(seed: u64, num_frames: usize, noise: f64) -> Self {
        let scene = Scene::new(seed);
        let poses = path(seed, num_frames + 1);
        let truth = scene.render(&CAMERA, &poses[0]);
        let keyframe = gradient_image(&truth.noisy(noise, 1000 * seed));
        let noisy = |i| scene.render(&CAMERA, &poses[i]).noisy(noise, 1000 * seed + i as u64);
        let pixels: Vec<_> = (1..=num_frames).map(noisy).collect();
        let view = |i: usize| TwoView::new(&CAMERA, &(poses[i].inverse() * poses[0]));
        let frames = pixels.iter().zip(1..).map(|(pixels, i)| (quad_image(pixels), view(i)));
        let frames = frames.collect();
        Self { keyframe, truth, pixels, frames }
    }

    fn frame(&self, i: usize) -> TraceFrame<'_> {
        let (image, view) = &self.frames[i];
        TraceFrame { image, view: *view, brightness: Brightness::default() }
    }

    fn true_inverse_depth(&self, point: &ImmaturePoint) -> f32 {
        self.truth.inverse_depth.at(usize::from(point.u), usize::from(point.v))
    }

    fn holds_truth(&self, point: &ImmaturePoint) -> bool {
        let truth = self.true_inverse_depth(point);
        point.max_inverse_depth.is_some_and(|max| point.min_inverse_depth <= truth && truth <= max)
    }
}

#[derive(Debug, Default)]
struct Coverage {
    good: usize,
    good_holds: usize,
    sure: usize,
    sure_holds: usize,
    mature: usize,
    mature_errors: Vec<f32>,
    points: usize,
}

fn coverage(noise: f64, seeds: u64) -> Coverage {
    let params = IntervalParams::default();
    let mut coverage = Coverage::default();
    for seed in 1..=seeds {
        let sequence = Sequence::new(seed, 12, noise);
        let mut filter = IntervalFilter::default();
        let wanted = CandidateParams { wanted: 1000 };
        filter.restart(&sequence.keyframe, &wanted);
        for i in 0..sequence.frames.len() {
            let ended: Vec<bool> = filter.points().iter().map(|p| p.is_ended()).collect();
            filter.trace(&sequence.frame(i), &params);
            for (point, _) in filter.points().iter().zip(ended).filter(|(_, ended)| !ended) {
                if point.status != TraceStatus::Good {
                    continue;
                }
                let holds = usize::from(sequence.holds_truth(point));
                let sure = usize::from(point.quality > 3.0);
                coverage.good += 1;
                coverage.good_holds += holds;
                coverage.sure += sure;
                coverage.sure_holds += sure * holds;
            }
        }
        coverage.points += filter.points().len();
        for point in filter.points().iter().filter(|p| p.is_mature(&params)) {
            coverage.mature += 1;
            let truth = sequence.true_inverse_depth(point);
            coverage.mature_errors.push((point.inverse_depth().unwrap() / truth - 1.0).abs());
        }
    }
    coverage.mature_errors.sort_by(f32::total_cmp);
    coverage
}

#[test]
fn without_noise_unambiguous_traces_contain_the_truth() {
    let coverage = coverage(0.0, 3);
    assert!(coverage.sure > 2000);
    assert!(coverage.sure_holds * 100 >= coverage.sure * 95);
}

#[test]
fn with_camera_noise_most_unambiguous_traces_contain_the_truth() {
    let coverage = coverage(3.0, 3);
    assert!(coverage.sure > 1000);
    assert!(coverage.sure_holds * 100 >= coverage.sure * 85);
}

/// Statuses and intervals on a path with growing baseline.
#[test]
fn the_interval_shrinks_as_the_baseline_grows() {
    let sequence = Sequence::new(4, 16, 1.0);
    let mut filter = IntervalFilter::default();
    let params = IntervalParams::default();
    filter.restart(&sequence.keyframe, &CandidateParams { wanted: 500 });
    let starts: Vec<(u16, u16)> = filter.points().iter().map(|p| (p.u, p.v)).collect();
    let mut histories = Vec::new();
    for start in starts {
        let frames = (0..16).map(|i| sequence.frame(i));
        histories.push(interval_history(&sequence.keyframe, start, frames, &params));
    }
    let width = |s: &ImmaturePoint| Some(s.max_inverse_depth? - s.min_inverse_depth);
    let median_after = |frame: usize| {
        let mut widths: Vec<f32> = histories
            .iter()
            .filter(|h| h[15].status == TraceStatus::Good || h[15].status == TraceStatus::Skipped)
            .filter_map(|h| width(&h[frame]))
            .collect();
        widths.sort_by(f32::total_cmp);
        assert!(widths.len() > 100, "{}", widths.len());
        widths[widths.len() / 2]
    };
    let medians = [0, 3, 7, 15].map(median_after);
    // From one to the next the baseline doubles, the first time twice: the interval halves.
    assert!(medians.windows(2).all(|w| w[1] < 0.7 * w[0]), "{medians:?}");
    assert!(medians[3] < 0.12 * medians[0], "{medians:?}");
    let (near, all) = histories.iter().fold((0, 0), |(n, a), h| match h[15].status {
        TraceStatus::Good => (n + usize::from(h[15].last_segment_px < 8.0), a + 1),
        _ => (n, a),
    });
    assert!(near * 2 > all);
}

#[test]
fn a_scaled_world_gives_the_same_statuses() {
    let sequence = Sequence::new(2, 6, 2.0);
    let params = IntervalParams::default();
    let wanted = CandidateParams { wanted: 300 };
    let poses = path(2, 7);
    // Scaling by a power of two keeps the mantissas, so that even ties break the same way.
    let factor = 8.0;
    let (mut filter, mut scaled) = (IntervalFilter::default(), IntervalFilter::default());
    filter.restart(&sequence.keyframe, &wanted);
    scaled.restart(&sequence.keyframe, &wanted);
    for i in 0..6 {
        let mut current_from_keyframe = poses[i + 1].inverse() * poses[0];
        current_from_keyframe.translation *= factor;
        let view = TwoView::new(&CAMERA, &current_from_keyframe);
        let counts = filter.trace(&sequence.frame(i), &params);
        assert_eq!(scaled.trace(&TraceFrame { view, ..sequence.frame(i) }, &params), counts);
    }
    scaled.rescale(factor as f32);
    for (a, b) in filter.points().iter().zip(scaled.points()) {
        assert_eq!((a.status, a.quality), (b.status, b.quality));
        assert_eq!(
            (a.min_inverse_depth, a.max_inverse_depth),
            (b.min_inverse_depth, b.max_inverse_depth)
        );
    }
}

#[test]
fn the_brightness_of_a_frame_is_compensated() {
    let sequence = Sequence::new(3, 4, 1.0);
    let params = IntervalParams::default();
    let mut outliers = [0, 0];
    for (known, outliers) in [true, false].into_iter().zip(&mut outliers) {
        let mut filter = IntervalFilter::default();
        filter.restart(&sequence.keyframe, &CandidateParams { wanted: 500 });
        for i in 0..4 {
            let brightness = Brightness { a: 0.7f64.ln(), b: 50.0 };
            let shown = |grey: &u8| (0.7 * f32::from(*grey) + 50.0).round() as u8;
            let image = quad_image(&sequence.pixels[i].iter().map(shown).collect::<Vec<_>>());
            let brightness = if known { brightness } else { Brightness::default() };
            let frame = TraceFrame { image: &image, brightness, ..sequence.frame(i) };
            *outliers += filter.trace(&frame, &params).outlier;
        }
    }
    assert!(outliers[0] * 4 < outliers[1], "{outliers:?}");
}

#[test]
fn every_status_is_reached_and_ended_points_stay_ended() {
    let sequence = Sequence::new(1, 2, 0.0);
    let params = IntervalParams::default();
    let point = |u, v| ImmaturePoint::new(&sequence.keyframe, u, v).unwrap();
    assert!(ImmaturePoint::new(&sequence.keyframe, 1, 100).is_none());
    assert!(ImmaturePoint::new(&sequence.keyframe, u16::MAX, 100).is_none());
    let frame_at = |x: f64, z: f64| TraceFrame {
        view: TwoView::new(&CAMERA, &SE3::exp(&Vector6::new(x, 0.0, z, 0.0, 0.0, 0.0))),
        ..sequence.frame(0)
    };
    // No motion: nothing to gain.
    assert_eq!(point(160, 120).trace(&frame_at(0.0, 0.0), &params), TraceStatus::BadCondition);
    // At the border, the search would leave the image; afterwards the point is not tried again.
    let mut leaving = point(315, 120);
    assert_eq!(leaving.trace(&frame_at(0.1, 0.0), &params), TraceStatus::OutOfBounds);
    assert_eq!(leaving.trace(&sequence.frame(0), &params), TraceStatus::OutOfBounds);
    assert!(leaving.is_ended());
    // A black frame matches nothing; a second one ends the point.
    let black = QuadImage::with_size(CAMERA.width, CAMERA.height);
    let dark = TraceFrame { image: &black, ..frame_at(-0.05, 0.0) };
    let mut outlier = point(160, 120);
    assert_eq!(outlier.trace(&dark, &params), TraceStatus::Outlier);
    assert!(!outlier.is_ended());
    assert_eq!(outlier.trace(&dark, &params), TraceStatus::Outlier);
    assert!(outlier.is_ended());
    // A narrow interval is skipped; a wide one across the gradient is not worth a search.
    let mut certain = point(160, 120);
    (certain.min_inverse_depth, certain.max_inverse_depth) = (0.30, Some(0.301));
    assert_eq!(certain.trace(&frame_at(-0.05, 0.0), &params), TraceStatus::Skipped);
    let ramp: Vec<u8> =
        (0..CAMERA.width * CAMERA.height).map(|i| (i / CAMERA.width) as u8).collect();
    let across = gradient_image(&ramp);
    let mut blind = ImmaturePoint::new(&across, 160, 120).unwrap();
    (blind.min_inverse_depth, blind.max_inverse_depth) = (0.1, Some(0.5));
    let ramp = quad_image(&ramp);
    let sideways = TraceFrame { image: &ramp, ..frame_at(-0.05, 0.0) };
    assert_eq!(blind.trace(&sideways, &params), TraceStatus::BadCondition);
}
