//! Monte Carlo: the error of a single observation of inverse depth compared with its own predicted standard deviation,
//! in a simulated room with exact poses and depth and known noise on both.

use nalgebra::Vector6;
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{SensorParams, SimulatorParams};
use semidense::capture::simulator::random::Stream;
use semidense::capture::source::FrameSource;
use semidense::slam::depth::epipolar::TwoView;
use semidense::slam::depth::gradient_image::BORDER_PX;
use semidense::slam::depth::map::DepthMap;
use semidense::slam::depth::matching::{MatchingParams, Patch, SearchRange, condition, search};
use semidense::slam::depth::pose_noise::pose_noise_px as predicted_px;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::buffer::Image;
use semidense::slam::image::noise::ImageNoise;
use semidense::slam::image::quads::QuadImage;
use semidense::slam::image::quads_kernel::Sampled;
use semidense::slam::kernel::Portable;

/// Frames of a sequence; every third observes the first one, over baselines up to 0.3 m.
const FRAMES: usize = 19;
const STRIDE: usize = 3;

/// A keyframe with its depth, and frames with exact motion.
struct Sequence {
    intrinsics: Intrinsics,
    map: DepthMap,
    depth: Image<f32>,
    frames: Vec<(QuadImage, SE3)>,
}

fn sequence(seed: u64, noise_std_dev: f64) -> Sequence {
    let sensor = SensorParams { noise_std_dev, ..SensorParams::default() };
    let params = SimulatorParams { seed, frames: FRAMES, sensor, ..SimulatorParams::default() };
    let mut simulator = Simulator::new(params).unwrap();
    let intrinsics = simulator.intrinsics();
    let (width, height) = (intrinsics.width, intrinsics.height);
    let truth = simulator.ground_truth().to_vec();
    let depth = simulator.depth_at(truth[0].nanos).unwrap().unwrap();
    let mut map = DepthMap::with_size(width, height);
    map.restart(&simulator.raw_frame(0).unwrap(), 5.0, 100_000);
    let frames = (STRIDE..FRAMES).step_by(STRIDE).map(|i| {
        let mut image = QuadImage::with_size(width, height);
        image.fill(&simulator.raw_frame(i).unwrap());
        (image, truth[i].world_from_camera.inverse() * truth[0].world_from_camera)
    });
    let frames = frames.collect();
    Sequence { intrinsics, map, depth, frames }
}

/// Errors of observations relative to their predicted standard deviation. The pose is rotated by noise that displaces
/// the image by `pose_noise_px` along each axis.
fn normalized_errors(noise_std_dev: f64, pose_noise_px: f64) -> Vec<f64> {
    /// Random draws of the pose of each frame: its error is common to all pixels.
    const DRAWS: usize = 6;
    /// Spacing of the observed rows and columns.
    const SPACING: usize = 6;
    // Rounding of a pixel: 1/√12 grey levels.
    let pixel_std_dev = (noise_std_dev.powi(2) + 1.0 / 12.0).sqrt() as f32;
    let noise = ImageNoise { pixel_std_dev, ..ImageNoise::DEFAULT };
    let mut params = MatchingParams { noise, line_noise_px: 0.0, ..MatchingParams::default() };
    let mut errors = Vec::new();
    for seed in 1..=2 {
        let Sequence { intrinsics, map, depth, frames } = sequence(seed, noise_std_dev);
        let mut stream = Stream::new(seed, 77);
        let turn = pose_noise_px / intrinsics.fx;
        // The increment's rotation about x and y.
        let mut covariance = [0.0; 21];
        (covariance[15], covariance[18]) = (turn * turn, turn * turn);
        params.line_noise_px = predicted_px(&intrinsics, &covariance) as f32;
        for (frame, exact) in &frames {
            for draw in 0..if pose_noise_px > 0.0 { DRAWS } else { 1 } {
                let mut normal = || normal(&mut stream);
                let noise = Vector6::new(0.0, 0.0, 0.0, turn * normal(), turn * normal(), 0.0);
                let view = TwoView::new(&intrinsics, &(SE3::exp(&noise) * *exact));
                for v in
                    (BORDER_PX + draw % SPACING..intrinsics.height - BORDER_PX).step_by(SPACING)
                {
                    for u in (BORDER_PX..intrinsics.width - BORDER_PX).step_by(SPACING) {
                        let d = 1.0 / depth.at(u, v);
                        errors.extend(observe(&map, frame, &view, (u, v), d, &params));
                    }
                }
            }
        }
    }
    errors
}

/// Error of one pixel relative to its predicted standard deviation; `None` if it is not observed.
fn observe(
    map: &DepthMap,
    frame: &QuadImage,
    view: &TwoView,
    (u, v): (usize, usize),
    truth: f32,
    params: &MatchingParams,
) -> Option<f64> {
    /// Range of the search relative to the true inverse depth: no distant false matches.
    const SEARCHED: (f32, f32) = (0.85, 1.15);
    if !map.candidates.at(u, v) {
        return None;
    }
    let line = view.line(u as f32, v as f32);
    let at = line.project(truth)?;
    let conditioning = condition(view, &line, &at, &map.structure.at(u, v), 1.0, params)?;
    let (from, to) = (line.project(SEARCHED.0 * truth)?, line.project(SEARCHED.1 * truth)?);
    // If the search spans no pixel, an error cannot show.
    if (to.u - from.u).hypot(to.v - from.v) < 3.0 {
        return None;
    }
    let patch = Patch::new(&map.image, u, v, 1.0, 0.0);
    let frame = Sampled { image: frame, sampler: Portable };
    let range = SearchRange { from, to, max_px: params.max_search_px };
    let found = search(frame, &line, &patch, &conditioning, &range, params).ok()?;
    Some(f64::from((found.inverse_depth - truth) / found.uncertainty.variance.sqrt()))
}

/// Standard normal.
fn normal(stream: &mut Stream) -> f64 {
    (0..12).map(|_| f64::from(stream.uniform(-0.5, 0.5))).sum()
}

/// Standard deviation about zero of a normal distribution with the same median magnitude.
fn robust_std_dev(errors: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = errors.iter().map(|e| e.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    1.4826 * sizes[sizes.len() / 2]
}

/// Accepted robust standard deviation of normalised errors: outside, observations would be over-weighted twofold or
/// under-weighted by half.
const HONEST: std::ops::RangeInclusive<f64> = 0.7..=1.4;

#[test]
fn observations_are_as_uncertain_as_predicted() {
    for noise_std_dev in [0.0, 2.0, 4.0] {
        for pose_noise_px in [0.0, 0.3] {
            let errors = normalized_errors(noise_std_dev, pose_noise_px);
            let within =
                |k: f64| errors.iter().filter(|e| e.abs() < k).count() as f64 / errors.len() as f64;
            let spread = robust_std_dev(&errors);
            let regime = format!("noise {noise_std_dev}, pose {pose_noise_px} px");
            println!(
                "{regime}: robust std {spread:.3}, within 1σ {:.3}, 2σ {:.3}, 3σ {:.3} of {}",
                within(1.0),
                within(2.0),
                within(3.0),
                errors.len()
            );
            assert!(errors.len() > 5000, "{regime}: {} observations", errors.len());
            assert!(HONEST.contains(&spread), "{regime}: {spread}");
        }
    }
}
