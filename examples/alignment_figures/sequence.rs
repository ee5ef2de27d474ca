//! Tracks a source on keyframes with known depth and compares every pose with ground truth.

use std::collections::HashMap;
use std::error::Error;
use std::time::Instant;

use nalgebra::Vector6;
use semidense::capture::source::{FrameSource, FrameStamp};
use semidense::capture::source_error::SourceError;
use semidense::slam::alignment::reference::{Reference, ReferenceScratch};
use semidense::slam::evaluation::normalized_error::normalized;
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::image::buffer::Image;
use semidense::slam::keyframe::{DepthPoint, Keyframe, MAX_KEYFRAME_POINTS};
use semidense::slam::pose::PoseEstimate;
use semidense::slam::tracker::{Tracker, TrackerParams};
use semidense::slam::trajectory::StampedPose;

/// How keyframes are created from depth.
#[derive(Debug, Clone)]
pub struct KeyframeChoice {
    /// Standard deviation of the noise added to the inverse depth, as a share of it.
    pub depth_noise: f64,
    /// Each point's noise is multiplied by this to a uniform power of -1 to 1; 1 for uniform noise.
    pub noise_spread: f64,
    /// Minimum gradient of a point, grey levels per pixel.
    pub min_gradient: f64,
    /// Number of frames between keyframes; 0 to start one when the tracker proposes it.
    pub every: usize,
}

/// A tracked frame compared with ground truth.
#[derive(Debug, Clone)]
pub struct TrackedFrame {
    pub estimate: PoseEstimate,
    /// log(T_est T_true⁻¹) of current_from_keyframe, keyframe units; zero on the keyframe itself.
    pub error: Vector6<f64>,
    /// Length of a keyframe unit, metres.
    pub unit_m: f64,
    pub truth: SE3,
    pub track_ms: f64,
    /// Number of points of the keyframe, and the time to prepare it.
    pub points: usize,
    pub prepare_ms: f64,
}

impl TrackedFrame {
    /// Normalised squared errors of (all six, translation, rotation).
    pub fn normalized(&self) -> Option<[f64; 3]> {
        normalized(&self.error, &self.estimate.alignment_covariance)
    }
}

/// A small pseudo-random generator (SplitMix64) of normal numbers.
pub struct Noise(pub u64);

impl Noise {
    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let sum: f64 = (0..12).map(|_| self.uniform()).sum();
        sum - 6.0
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// A source held in memory, so that it can be tracked many times.
pub struct Recorded {
    source: Box<dyn FrameSource>,
    frames: Vec<(FrameStamp, Vec<u8>)>,
    truth: Vec<StampedPose>,
    depths: HashMap<i64, Option<Image<f32>>>,
}

impl Recorded {
    /// Reads all frames.
    pub fn new(
        mut source: Box<dyn FrameSource>,
        max_frames: usize,
    ) -> Result<Self, Box<dyn Error>> {
        source.prepare(&mut |_, _| true)?;
        let intrinsics = source.intrinsics();
        let mut pixels = vec![0; intrinsics.width * intrinsics.height];
        let mut frames = Vec::new();
        while frames.len() < max_frames
            && let Some(stamp) = source.next_into(&mut pixels)?
        {
            frames.push((stamp, pixels.clone()));
        }
        let truth = source.ground_truth().to_vec();
        Ok(Self { source, frames, truth, depths: HashMap::new() })
    }

    /// The keyframe of frame `index`, at its true pose, with depth according to `choice`; `None` without true depth or
    /// pose.
    pub fn keyframe(
        &mut self,
        index: usize,
        choice: &KeyframeChoice,
        noise: &mut Noise,
    ) -> Result<Option<Keyframe>, Box<dyn Error>> {
        let Some((stamp, pixels)) = self.frames.get(index).cloned() else { return Ok(None) };
        let (depth, pose) = (self.depth_at(stamp.capture_nanos)?, self.true_pose(&stamp));
        let (Some(depth), Some(pose)) = (depth, pose) else { return Ok(None) };
        let intrinsics = self.source.intrinsics();
        Ok(Some(make_keyframe(0, &stamp, &intrinsics, &pixels, &depth, pose, choice, noise)))
    }

    /// Pixels and true pose of a frame.
    pub fn frame(&self, index: usize) -> Option<(&[u8], SE3)> {
        let (stamp, pixels) = self.frames.get(index)?;
        Some((pixels, self.true_pose(stamp)?))
    }

    fn true_pose(&self, stamp: &FrameStamp) -> Option<SE3> {
        let nearest = self.truth.iter().min_by_key(|pose| (pose.nanos - stamp.capture_nanos).abs());
        nearest.map(|pose| pose.world_from_camera)
    }

    fn depth_at(&mut self, nanos: i64) -> Result<Option<Image<f32>>, SourceError> {
        if !self.depths.contains_key(&nanos) {
            let depth = self.source.depth_at(nanos)?;
            self.depths.insert(nanos, depth);
        }
        Ok(self.depths[&nanos].clone())
    }
}

/// Tracks the frames of `source`.
pub fn track(
    source: &mut Recorded,
    params: &TrackerParams,
    choice: &KeyframeChoice,
) -> Result<Vec<TrackedFrame>, Box<dyn Error>> {
    let intrinsics = source.source.intrinsics();
    let truth = source.truth.clone();
    let recorded = std::mem::take(&mut source.frames);
    let mut tracker = Tracker::new(intrinsics, params.clone())?;
    let mut memory = Some(Box::new(Reference::new(params.reference.clone())));
    let mut scratch = ReferenceScratch::default();
    let mut noise = Noise(1);
    let (mut frames, mut keyframe) = (Vec::new(), None::<(Keyframe, SE3, f64)>);
    let (mut due, mut age) = (true, 0);
    for (stamp, pixels) in &recorded {
        let nearest = truth.iter().min_by_key(|pose| (pose.nanos - stamp.capture_nanos).abs());
        let Some(true_pose) = nearest else { return Err("the source has no ground truth".into()) };
        let true_pose = true_pose.world_from_camera;
        let frame = view(stamp, &intrinsics, pixels);
        age += 1;
        if let Some((keyframe, true_keyframe, prepare_ms)) = &keyframe {
            let begin = Instant::now();
            let estimate = tracker.track(&frame, &mut |_| true);
            let track_ms = begin.elapsed().as_secs_f64() * 1e3;
            let unit_m = keyframe.map_from_keyframe.scale;
            let place = Sim3::new(*true_keyframe, unit_m);
            let current_from_keyframe = estimate.keyframe_from_camera.inverse();
            let error = (current_from_keyframe * place.inverse_transform_pose(&true_pose)).log();
            due |= if choice.every > 0 { age >= choice.every } else { estimate.proposes_keyframe };
            frames.push(TrackedFrame {
                estimate,
                error,
                unit_m,
                truth: true_pose,
                track_ms,
                points: keyframe.points.len(),
                prepare_ms: *prepare_ms,
            });
        }
        let depth = if due { source.depth_at(stamp.capture_nanos)? } else { None };
        if let Some(depth) = depth {
            let id = keyframe.as_ref().map_or(0, |(before, ..)| before.keyframe_id + 1);
            let pose = match frames.last() {
                Some(last) if last.estimate.state.is_tracked() => last.estimate.world_from_camera,
                _ => true_pose,
            };
            let made =
                make_keyframe(id, stamp, &intrinsics, pixels, &depth, pose, choice, &mut noise);
            let begin = Instant::now();
            let mut reference =
                memory.take().unwrap_or_else(|| Box::new(Reference::new(params.reference.clone())));
            reference.prepare_into(&made, &mut scratch);
            let prepare_ms = begin.elapsed().as_secs_f64() * 1e3;
            memory = tracker.adopt(reference);
            keyframe = Some((made, true_pose, prepare_ms));
            (due, age) = (false, 0);
        }
    }
    source.frames = recorded;
    Ok(frames)
}

fn view<'a>(stamp: &FrameStamp, intrinsics: &Intrinsics, pixels: &'a [u8]) -> FrameView<'a> {
    FrameView {
        sequence: stamp.sequence,
        capture_nanos: stamp.capture_nanos,
        exposure_nanos: stamp.exposure_nanos,
        width: intrinsics.width,
        height: intrinsics.height,
        pixels,
    }
}

/// Minimum relative standard deviation of an inverse depth: that of exact depth in f32.
const EXACT_DEPTH: f64 = 1e-3;

#[allow(clippy::too_many_arguments)]
fn make_keyframe(
    keyframe_id: u64,
    stamp: &FrameStamp,
    intrinsics: &Intrinsics,
    pixels: &[u8],
    depth: &Image<f32>,
    world_from_camera: SE3,
    choice: &KeyframeChoice,
    noise: &mut Noise,
) -> Keyframe {
    let (width, height) = (intrinsics.width, intrinsics.height);
    let grey = |u: usize, v: usize| f64::from(pixels[v * width + u]);
    let mut points = Vec::new();
    for v in 2..height - 2 {
        for u in 2..width - 2 {
            let gx = 0.5 * (grey(u + 1, v) - grey(u - 1, v));
            let gy = 0.5 * (grey(u, v + 1) - grey(u, v - 1));
            let z = f64::from(depth.at(u, v));
            if gx.hypot(gy) < choice.min_gradient || !(0.05..50.0).contains(&z) {
                continue;
            }
            points.push((u, v, 1.0 / z));
        }
    }
    while points.len() > MAX_KEYFRAME_POINTS {
        let mut index = 0;
        points.retain(|_| {
            index += 1;
            index % 3 != 0
        });
    }
    let mean = points.iter().map(|point| point.2).sum::<f64>() / points.len().max(1) as f64;
    let points = points.iter().map(|&(u, v, metric)| {
        let exact = metric / mean;
        let spread = match choice.noise_spread {
            1.0 => 1.0,
            spread => spread.powf(2.0 * noise.uniform() - 1.0),
        };
        let std_dev = exact * choice.depth_noise * spread;
        DepthPoint {
            u: u as u16,
            v: v as u16,
            inverse_depth: (exact + std_dev * noise.normal()).max(0.01 * exact) as f32,
            variance: std_dev.max(EXACT_DEPTH * exact).powi(2) as f32,
            intensity: grey(u, v) as f32,
        }
    });
    Keyframe {
        keyframe_id,
        revision: keyframe_id,
        sequence: stamp.sequence,
        capture_nanos: stamp.capture_nanos,
        ..Keyframe::at(
            Sim3::new(world_from_camera, 1.0 / mean),
            *intrinsics,
            points.collect(),
            pixels.to_vec(),
        )
    }
}
