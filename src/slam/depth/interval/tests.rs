//! Monte-Carlo tests of the interval filter with exact poses.

use nalgebra::Vector6;

use super::*;
use crate::slam::depth::epipolar::TwoView;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
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

struct Sequence {
    keyframe: GradientImage,
    truth: Rendering,
    frames: Vec<(Image<f32>, TwoView)>,
}

impl Sequence {
    fn new(seed: u64, num_frames: usize, noise: f64) -> Self {
        let scene = Scene::new(seed);
        let poses = path(seed, num_frames + 1);
        let truth = scene.render(&CAMERA, &poses[0]);
        let keyframe = gradient_image(&truth.noisy(noise, 1000 * seed));
        let frames = (1..=num_frames).map(|i| {
            let pixels = scene.render(&CAMERA, &poses[i]).noisy(noise, 1000 * seed + i as u64);
            let view = TwoView::new(&CAMERA, &(poses[i].inverse() * poses[0]));
            (gradient_image(&pixels).intensity, view)
        });
        let frames = frames.collect();
        Self { keyframe, truth, frames }
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
        let wanted = CandidateParams { wanted: 1000, ..CandidateParams::default() };
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
fn without_noise_sure_traces_hold_the_truth() {
    let coverage = coverage(0.0, 3);
    assert!(coverage.sure > 2000);
    assert!(coverage.sure_holds * 100 >= coverage.sure * 95);
}

#[test]
fn with_the_noise_of_a_camera_most_sure_traces_hold_the_truth() {
    let coverage = coverage(3.0, 3);
    assert!(coverage.sure > 1000);
    assert!(coverage.sure_holds * 100 >= coverage.sure * 85);
}
