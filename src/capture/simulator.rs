//! The simulator: a camera in a textured scene, with exact poses and exact depth.
//!
//! `trajectory` is the camera's path, `render` what the camera sees on it, `sensor` the conversion of light to pixels;
//! `furnish` builds the scenes. The same [`params`] give the same bytes.

use std::borrow::Cow;
use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::OnceLock;

use rayon::prelude::*;

use crate::capture::frame_store::FrameStore;
use crate::capture::simulator::lens::Lens;
use crate::capture::simulator::params::{SensorParams, SimulatorParams};
use crate::capture::simulator::render::Renderer;
use crate::capture::simulator::scene::Scene;
use crate::capture::simulator::sensor::Sensor;
use crate::capture::simulator::trajectory::Trajectory;
use crate::capture::source::{FrameSource, FrameStamp};
use crate::capture::source_error::SourceError;
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::rectification::Rectification;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::kernel::Kernel;
use crate::slam::parameter::ParameterError;
use crate::slam::trajectory::StampedPose;

pub use crate::capture::simulator::render::RenderScratch;

mod canvas;
mod cull;
mod edges;
pub(crate) mod flat;
pub(crate) mod furnish;
pub(crate) mod lens;
pub mod params;
pub(crate) mod pattern;
pub mod random;
pub(crate) mod render;
pub(crate) mod route;
pub(crate) mod scene;
pub mod scene_kind;
pub(crate) mod sensor;
mod shade;
pub mod summary;
pub(crate) mod texture;
pub(crate) mod trajectory;
pub(crate) mod twins;
mod view;

/// Stamp of the first frame: one second, so that no reader takes it for a missing stamp.
const FIRST_NANOS: i64 = 1_000_000_000;
/// Frames rendered between two reports of progress.
const FRAMES_PER_REPORT: usize = 8;
/// Motion blur is averaged over instants at most this far apart in the image, but over no more than `MAX_BLUR_STEPS`.
const BLUR_STEP_PX: f64 = 1.0;
/// Maximum number of instants of one exposure.
const MAX_BLUR_STEPS: usize = 24;

/// A simulated camera as a source of frames.
///
/// [`FrameSource::prepare`] renders all frames on the current rayon pool and keeps them: `frames × width × height`
/// bytes, 184 MB for the default 600 frames; frames that were not prepared are rendered on request. Depth is always
/// cast on request. Frames of a distorted lens are rectified when they are returned.
#[derive(Debug)]
pub struct Simulator {
    params: SimulatorParams,
    /// Painted when the first frame is rendered: a capture process that replaces another already has its frames.
    scene: OnceLock<Scene>,
    camera: CameraModel,
    /// Rays of the raw images.
    lens: Lens,
    rectification: Rectification,
    /// Rays of the rectified images, if they differ from the raw ones.
    rectified_lens: Option<Lens>,
    sensor: Sensor,
    trajectory: Trajectory,
    ground_truth: Vec<StampedPose>,
    /// Raw frames rendered so far.
    frames: FrameStore,
    next: usize,
    /// Instructions of the renderer.
    kernel: Kernel,
}

impl Simulator {
    /// Builds the scene and the path; nothing is rendered yet.
    pub fn new(params: SimulatorParams) -> Result<Self, ParameterError> {
        let simulator = Self::unpainted(params)?;
        simulator.scene();
        Ok(simulator)
    }

    /// Builds only the path. The first frame must be requested through [`FrameSource`]: the scene is painted on the
    /// rayon pool, which must not be busy with frames that wait for it.
    pub fn unpainted(params: SimulatorParams) -> Result<Self, ParameterError> {
        params.validate()?;
        let stage = furnish::furnish(params.scene, params.seed).stage;
        let trajectory = Trajectory::new(stage, &params.motion, params.seed);
        let camera = params.camera()?;
        let rectification = Rectification::new(&camera).map_err(|error| ParameterError {
            key: "sensor.distortion".to_owned(),
            value: format!("{:?}", params.sensor.distortion),
            allowed: format!("a lens that can be rectified ({error})"),
        })?;
        let rectified_lens =
            (!rectification.is_identity()).then(|| Lens::pinhole(rectification.intrinsics()));
        let sensor = Sensor::new(&params.sensor, params.seed, params.width, params.height);
        let frames = FrameStore::in_memory(params.width * params.height);
        let mut simulator = Self {
            params,
            scene: OnceLock::new(),
            lens: Lens::of_camera(&camera),
            camera,
            rectification,
            rectified_lens,
            sensor,
            trajectory,
            ground_truth: Vec::new(),
            frames,
            next: 0,
            kernel: Kernel::fastest(),
        };
        simulator.ground_truth = (0..simulator.params.frames)
            .map(|i| {
                let mut world_from_camera = simulator.pose(simulator.time_s(i));
                world_from_camera.translation *= simulator.params.world_scale;
                StampedPose { nanos: simulator.nanos(i), world_from_camera }
            })
            .collect();
        Ok(simulator)
    }

    /// The parameters it was built with.
    pub fn params(&self) -> &SimulatorParams {
        &self.params
    }

    fn scene(&self) -> &Scene {
        self.scene.get_or_init(|| furnish::build(self.params.scene, self.params.seed))
    }

    fn renderer<'a>(&'a self, lens: &'a Lens) -> Renderer<'a> {
        Renderer { scene: self.scene(), lens, kernel: self.kernel }
    }

    /// Stamp of a frame: the middle of the exposure (of the middle row), nanoseconds.
    pub fn nanos(&self, frame: usize) -> i64 {
        FIRST_NANOS + (frame as f64 * 1e9 / self.params.rate_hz).round() as i64
    }

    /// Time of a frame from the start, seconds.
    fn time_s(&self, frame: usize) -> f64 {
        (self.nanos(frame) - FIRST_NANOS) as f64 * 1e-9
    }

    /// The pose at a time from the start, in metres before the world's scale.
    fn pose(&self, time_s: f64) -> SE3 {
        self.trajectory.world_from_camera(time_s)
    }

    /// Brightness of a frame before the sensor, grey levels.
    fn light(&self, frame: usize, scratch: &mut RenderScratch) -> Vec<f32> {
        let sensor = &self.params.sensor;
        let mut light = vec![0.0; self.params.width * self.params.height];
        let renderer = self.renderer(&self.lens);
        let middle_s = self.time_s(frame);
        let exposure_s = sensor.exposure_ms * 1e-3;
        let row_s = sensor.row_time_us * 1e-6;
        let middle_row = 0.5 * (self.params.height as f64 - 1.0);
        let steps = self.blur_steps(middle_s, exposure_s);
        for step in 0..steps {
            let instant_s = middle_s + ((step as f64 + 0.5) / steps as f64 - 0.5) * exposure_s;
            let pose_of_row = |row: usize| self.pose(instant_s + (row as f64 - middle_row) * row_s);
            let weight = 1.0 / steps as f32;
            renderer.add_grey(&pose_of_row, row_s == 0.0, weight, scratch, &mut light);
        }
        light
    }

    /// Number of instants that an exposure is averaged over: one per pixel of motion.
    fn blur_steps(&self, middle_s: f64, exposure_s: f64) -> usize {
        /// Distance at which the motion is estimated: most of the scene is farther away.
        const TYPICAL_DEPTH_M: f64 = 1.5;
        if exposure_s == 0.0 {
            return 1;
        }
        let (before, after) =
            (self.pose(middle_s - 0.5 * exposure_s), self.pose(middle_s + 0.5 * exposure_s));
        let turn = before.rotation.angle_to(&after.rotation);
        let step = (after.translation - before.translation).norm();
        let motion_px = self.params.focal_px * (turn + step / TYPICAL_DEPTH_M);
        ((motion_px / BLUR_STEP_PX).ceil() as usize + 1).clamp(2, MAX_BLUR_STEPS)
    }

    /// Renders one frame as read out by the sensor.
    fn render(&self, frame: usize, scratch: &mut RenderScratch) -> Vec<u8> {
        let mut light = self.light(frame, scratch);
        let mut pixels = vec![0; light.len()];
        self.sensor.read_out(frame as u64, self.time_s(frame), &mut light, &mut pixels);
        pixels
    }

    /// The camera that takes the raw images.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// Returns the raw image of a frame, as read out by the sensor: from memory if it has been prepared, rendered
    /// otherwise. `None` beyond the last frame.
    pub fn raw_frame(&self, frame: usize) -> Option<Cow<'_, [u8]>> {
        if frame >= self.params.frames {
            return None;
        }
        let render = || Cow::Owned(self.render(frame, &mut RenderScratch::default()));
        Some(self.frames.get(frame).unwrap_or_else(render))
    }

    /// Exact depth along the optical axis of the raw image at a frame's ground-truth pose, in world units (0 where
    /// there is no surface). `None` beyond the last frame.
    pub fn raw_depth(&self, frame: usize) -> Option<Image<f32>> {
        let mut scratch = RenderScratch::default();
        (frame < self.params.frames).then(|| self.depth_through(&self.lens, frame, &mut scratch))
    }

    /// [`Simulator::raw_frame`] and [`Simulator::raw_depth`], rendered together.
    pub fn raw_frame_and_depth(
        &self,
        frame: usize,
        scratch: &mut RenderScratch,
    ) -> Option<(Vec<u8>, Image<f32>)> {
        if frame >= self.params.frames {
            return None;
        }
        let pixels = self.render(frame, scratch);
        let SensorParams { exposure_ms, row_time_us, .. } = self.params.sensor;
        let depth = match exposure_ms == 0.0 && row_time_us == 0.0 {
            // The image was cast at the frame's only pose, so its depth is already available.
            true => self.depth_of_last(&self.lens, scratch),
            false => self.depth_through(&self.lens, frame, scratch),
        };
        Some((pixels, depth))
    }

    fn depth_through(&self, lens: &Lens, frame: usize, scratch: &mut RenderScratch) -> Image<f32> {
        self.renderer(lens).cast_depth(&self.pose(self.time_s(frame)), scratch);
        self.depth_of_last(lens, scratch)
    }

    /// Depth last cast through `lens`, in world units.
    fn depth_of_last(&self, lens: &Lens, scratch: &RenderScratch) -> Image<f32> {
        let mut depth = Image::filled(lens.width, lens.height, 0.0);
        scratch.depth_into(depth.pixels_mut());
        let scale = self.params.world_scale as f32;
        for value in depth.pixels_mut() {
            *value *= scale;
        }
        depth
    }
}

impl FrameSource for Simulator {
    fn intrinsics(&self) -> Intrinsics {
        *self.rectification.intrinsics()
    }

    fn camera(&self) -> CameraModel {
        self.camera
    }

    fn readout_s(&self) -> Option<f64> {
        Some(1e-6 * self.params.sensor.row_time_us * self.params.height as f64)
    }

    fn num_frames(&self) -> Option<usize> {
        Some(self.params.frames)
    }

    fn keep_prepared_in(&mut self, file: File) -> io::Result<()> {
        self.frames = FrameStore::in_file(file, self.frames.frame_bytes)?;
        Ok(())
    }

    fn prepare(
        &mut self,
        progress: &mut dyn FnMut(usize, usize) -> bool,
    ) -> Result<(), SourceError> {
        let total = self.params.frames;
        if self.frames.len() < total {
            // Before the frames, which are rendered in parallel.
            self.scene();
        }
        while self.frames.len() < total {
            if !progress(self.frames.len(), total) {
                return Ok(());
            }
            let first = self.frames.len();
            let batch = first..(first + FRAMES_PER_REPORT).min(total);
            let shared = &*self;
            let rendered: Vec<Vec<u8>> = batch
                .into_par_iter()
                .map_init(RenderScratch::default, |scratch, frame| shared.render(frame, scratch))
                .collect();
            for frame in rendered {
                self.frames.push(frame).map_err(|source| SourceError::Read {
                    path: PathBuf::from("rendered frames"),
                    source,
                })?;
            }
        }
        progress(total, total);
        Ok(())
    }

    fn skip_to(&mut self, sequence: u64) -> Result<(), SourceError> {
        let next = usize::try_from(sequence.saturating_add(1)).unwrap_or(usize::MAX);
        self.next = self.next.max(next);
        Ok(())
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        self.check_buffer(pixels)?;
        let frame = self.next;
        let Some(raw) = self.raw_frame(frame) else { return Ok(None) };
        self.rectification.rectify_into(&raw, pixels);
        self.next += 1;
        let exposure_nanos = (self.params.sensor.exposure_ms * 1e6).round() as u64;
        let gain = self.sensor.exposure(self.time_s(frame)).0 as f32;
        Ok(Some(FrameStamp {
            sequence: frame as u64,
            capture_nanos: self.nanos(frame),
            exposure_nanos,
            gain,
            clocks: None,
        }))
    }

    fn ground_truth(&self) -> &[StampedPose] {
        &self.ground_truth
    }

    fn depth_at(&mut self, capture_nanos: i64) -> Result<Option<Image<f32>>, SourceError> {
        let frame = self.ground_truth.binary_search_by_key(&capture_nanos, |pose| pose.nanos);
        // Cast through the rectified rays: exact, where resampling would blur or shift it.
        let lens = self.rectified_lens.as_ref().unwrap_or(&self.lens);
        let mut scratch = RenderScratch::default();
        Ok(frame.ok().map(|frame| self.depth_through(lens, frame, &mut scratch)))
    }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod route_tests;
