//! The interval filter on simulated handheld sequences with exact poses: how often an interval contains the true
//! depth, and that it narrows as the baseline grows.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{SensorParams, SimulatorParams};
use semidense::capture::source::FrameSource;
use semidense::slam::depth::candidate::CandidateParams;
use semidense::slam::depth::epipolar::TwoView;
use semidense::slam::depth::gradient_image::GradientImage;
use semidense::slam::depth::immature::{ImmaturePoint, IntervalParams, TraceFrame, TraceStatus};
use semidense::slam::depth::interval::IntervalFilter;
use semidense::slam::image::buffer::Image;
use semidense::slam::image::quads::QuadImage;
use semidense::slam::pose::Brightness;

/// Frames through which one keyframe is traced: 0.8 s, 0.4 m of a slow walk.
const FRAMES: usize = 24;

struct Sequence {
    keyframe: GradientImage,
    depth: Image<f32>,
    frames: Vec<(QuadImage, TwoView)>,
}

fn sequence(seed: u64, noise_std_dev: f64) -> Sequence {
    let sensor = SensorParams { noise_std_dev, ..SensorParams::default() };
    let params = SimulatorParams { seed, frames: FRAMES + 1, sensor, ..SimulatorParams::default() };
    let mut simulator = Simulator::new(params).unwrap();
    simulator.prepare(&mut |_, _| true).unwrap();
    let intrinsics = simulator.intrinsics();
    let poses: Vec<_> = simulator.ground_truth().iter().map(|p| p.world_from_camera).collect();
    let mut pixels = vec![0; intrinsics.width * intrinsics.height];
    let mut keyframe = GradientImage::with_size(intrinsics.width, intrinsics.height);
    simulator.next_into(&mut pixels).unwrap().unwrap();
    keyframe.fill(&pixels);
    let mut frames = Vec::new();
    while simulator.next_into(&mut pixels).unwrap().is_some() {
        let mut image = QuadImage::with_size(intrinsics.width, intrinsics.height);
        image.fill(&pixels);
        let pose = &poses[frames.len() + 1];
        frames.push((image, TwoView::new(&intrinsics, &(pose.inverse() * poses[0]))));
    }
    let nanos = simulator.ground_truth()[0].nanos;
    let depth = simulator.depth_at(nanos).unwrap().unwrap();
    Sequence { keyframe, depth, frames }
}

/// Counts of `Good` traces, and of those whose interval contains the truth.
#[derive(Debug, Default)]
struct Coverage {
    good: usize,
    good_holds: usize,
    sure: usize,
    sure_holds: usize,
    points: usize,
    mature_errors: Vec<f32>,
    /// |error|/σ of mature points.
    whitened_errors: Vec<f32>,
}

impl Coverage {
    fn add(&mut self, point: &ImmaturePoint, truth: f32) {
        let Some(max) = point.max_inverse_depth else { return };
        let holds = usize::from((point.min_inverse_depth..=max).contains(&truth));
        let sure = usize::from(point.quality > 3.0);
        self.good += 1;
        self.good_holds += holds;
        self.sure += sure;
        self.sure_holds += sure * holds;
    }

    fn report(&mut self, noise_std_dev: f64) {
        let percent = |part: usize, all: usize| 100.0 * part as f64 / all.max(1) as f64;
        self.mature_errors.sort_by(f32::total_cmp);
        println!(
            "noise {noise_std_dev}: quality > 3: {:.1} % of {} hold, all good: {:.1} % of {}; mature {:.1} % of {}, median error {:.4}",
            percent(self.sure_holds, self.sure),
            self.sure,
            percent(self.good_holds, self.good),
            self.good,
            percent(self.mature_errors.len(), self.points),
            self.points,
            self.mature_errors.get(self.mature_errors.len() / 2).unwrap_or(&f32::NAN),
        );
        println!("mature within 1, 2, 3 σ: {:.3?}", [1.0, 2.0, 3.0].map(|s| self.within(s)));
    }

    /// Share of mature points whose error is within `sigmas` σ.
    fn within(&self, sigmas: f32) -> f64 {
        let inside = self.whitened_errors.iter().filter(|e| **e <= sigmas).count();
        inside as f64 / self.whitened_errors.len() as f64
    }
}

fn coverage(noise_std_dev: f64) -> Coverage {
    let params = IntervalParams::default();
    let mut coverage = Coverage::default();
    for seed in 1..=3 {
        let sequence = sequence(seed, noise_std_dev);
        let truth = |p: &ImmaturePoint| 1.0 / sequence.depth.at(usize::from(p.u), usize::from(p.v));
        let mut filter = IntervalFilter::default();
        filter.restart(&sequence.keyframe, &CandidateParams::default());
        for (image, view) in &sequence.frames {
            let ended: Vec<bool> = filter.points().iter().map(|p| p.is_ended()).collect();
            let brightness = Brightness::default();
            filter.trace(&TraceFrame { image, view: *view, brightness }, &params);
            let tried = filter.points().iter().zip(ended).filter(|(_, ended)| !ended);
            for (point, _) in tried.filter(|(p, _)| p.status == TraceStatus::Good) {
                coverage.add(point, truth(point));
            }
        }
        coverage.points += filter.points().len();
        let mature = filter.points().iter().filter(|p| p.is_mature(&params));
        let error = |p: &ImmaturePoint| Some((p.inverse_depth()? / truth(p) - 1.0).abs());
        coverage.mature_errors.extend(mature.clone().filter_map(error));
        let whitened =
            |p: &ImmaturePoint| Some((p.inverse_depth()? - truth(p)).abs() / p.std_dev()?);
        coverage.whitened_errors.extend(mature.filter_map(whitened));
    }
    coverage.report(noise_std_dev);
    coverage
}

#[test]
fn without_noise_certain_traces_contain_the_truth() {
    let coverage = coverage(0.0);
    assert!(coverage.sure > 10_000, "{}", coverage.sure);
    assert!(coverage.sure_holds * 100 >= coverage.sure * 95);
}

#[test]
fn with_camera_noise_most_certain_traces_contain_the_truth() {
    let coverage = coverage(3.0);
    assert!(coverage.sure > 10_000, "{}", coverage.sure);
    assert!(coverage.sure_holds * 100 >= coverage.sure * 85);
}
