//! Parameters of a simulated sequence.

use serde::{Deserialize, Serialize};

use crate::capture::simulator::furnish::furnish;
use crate::capture::simulator::scene_kind::SceneKind;
use crate::slam::geometry::camera_model::{CameraModel, Distortion};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::parameter::{ParameterError, check_range};

/// Maximum number of frames of a sequence: more than an hour at 25 Hz.
const MAX_FRAMES: usize = 100_000;

/// How the camera moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionKind {
    /// A walk with a hand-held camera: swaying, turning, trembling.
    Handheld,
    /// Back and forth on a straight line across the view, without turning or tremor.
    Straight,
    /// Turning about the optical centre, without moving or tremor.
    Rotation,
    /// Nothing moves.
    Standing,
}

/// The camera's path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotionParams {
    /// Kind of motion.
    pub kind: MotionKind,
    /// Mean speed along the path, metres per second before `world_scale`; 0.5 is a slow walk.
    pub mean_speed_m_s: f64,
    /// Mean rate of turning, degrees per second; 15 turns 300° in the default 20 s.
    pub mean_turn_deg_s: f64,
    /// Factor on the tremor of the hand (about 1.5 mm and 0.1° at 1.5 to 6 Hz); 0 is a gimbal.
    pub tremor: f64,
}

impl Default for MotionParams {
    fn default() -> Self {
        Self { kind: MotionKind::Handheld, mean_speed_m_s: 0.5, mean_turn_deg_s: 15.0, tremor: 1.0 }
    }
}

/// Effects of lens and sensor on the light.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorParams {
    /// Standard deviation of the noise of a pixel, grey levels; 2 is a small sensor indoors.
    pub noise_std_dev: f64,
    /// Share of the light that is lost in the image corner (∝ r⁴ from the centre); 0 means none.
    pub vignette: f64,
    /// Amplitude of the slow change of gain, as a natural logarithm; 0 is a locked exposure.
    pub gain_amplitude: f64,
    /// Amplitude of the slow change of offset, grey levels.
    pub offset_amplitude: f64,
    /// Period of both changes, seconds.
    pub exposure_period_s: f64,
    /// Exposure time, milliseconds: motion is averaged over it; 0 freezes it.
    pub exposure_ms: f64,
    /// Time from the start of one row to the next, microseconds; 0 is a global shutter.
    pub row_time_us: f64,
    /// Radial-tangential lens of the raw image, OpenCV's order `k1 k2 p1 p2 [k3 [k4 k5 k6]]`;
    /// empty is a pinhole. Frames are rectified like those of a real camera.
    pub distortion: Vec<f64>,
}

impl Default for SensorParams {
    fn default() -> Self {
        Self {
            noise_std_dev: 2.0,
            vignette: 0.0,
            gain_amplitude: 0.0,
            offset_amplitude: 0.0,
            exposure_period_s: 5.0,
            exposure_ms: 0.0,
            row_time_us: 0.0,
            distortion: Vec::new(),
        }
    }
}

/// A simulated sequence: the same values give the same bytes, on any number of threads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulatorParams {
    /// The scene.
    pub scene: SceneKind,
    /// Chooses textures, path and noise.
    pub seed: u64,
    /// Number of frames; all are kept in memory (307 kB each at 640 × 480). With the default value, a scene chosen by
    /// name is shown completely, see [`SimulatorParams::with_scene`].
    pub frames: usize,
    /// Frames per second.
    pub rate_hz: f64,
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Focal length, pixels; 525 is a depth camera's colour sensor at 640 × 480.
    pub focal_px: f64,
    /// Factor on every length of world and path; the images do not change.
    pub world_scale: f64,
    /// The camera's path.
    pub motion: MotionParams,
    /// Lens and sensor.
    pub sensor: SensorParams,
}

impl Default for SimulatorParams {
    fn default() -> Self {
        Self {
            scene: SceneKind::Room,
            seed: 1,
            frames: 600,
            rate_hz: 30.0,
            width: 640,
            height: 480,
            focal_px: 525.0,
            world_scale: 1.0,
            motion: MotionParams::default(),
            sensor: SensorParams::default(),
        }
    }
}

impl SimulatorParams {
    /// The default camera at half its resolution: the same view in a quarter of the time.
    pub fn half_size() -> Self {
        let Self { width, height, focal_px, .. } = Self::default();
        Self { width: width / 2, height: height / 2, focal_px: 0.5 * focal_px, ..Self::default() }
    }

    /// Returns the same parameters with another scene. One with a route, such as the flat, is walked through as often
    /// as it takes to show everything, unless the number of frames differs from the default.
    pub fn with_scene(mut self, scene: SceneKind) -> Self {
        self.scene = scene;
        let stage = furnish(scene, self.seed).stage;
        let speed = self.motion.mean_speed_m_s;
        if let (Some(route), true) = (stage.route, self.frames == Self::default().frames) {
            let duration_s = route.rounds as f64 * route.length_m() / speed;
            // Would be out of range for a camera that hardly moves.
            let frames = (duration_s * self.rate_hz).clamp(1.0, MAX_FRAMES as f64);
            self.frames = frames.ceil() as usize;
        }
        self
    }

    /// Refuses values that cannot be simulated; names the key and what is allowed.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("frames", self.frames, 1..=MAX_FRAMES)?;
        check_range("rate_hz", self.rate_hz, 1.0..=1000.0)?;
        check_range("width", self.width, 16..=4096)?;
        check_range("height", self.height, 16..=4096)?;
        // Between a field of view of 127° and of 3° across the larger side.
        let side = self.width.max(self.height) as f64;
        check_range("focal_px", self.focal_px, 0.25 * side..=20.0 * side)?;
        check_range("world_scale", self.world_scale, 1e-3..=1e3)?;
        self.motion.validate().map_err(|e| e.within("motion"))?;
        self.sensor.validate().map_err(|e| e.within("sensor"))?;
        let period_ms = 1e3 / self.rate_hz;
        check_range("sensor.exposure_ms", self.sensor.exposure_ms, 0.0..=period_ms)?;
        let readout_ms = self.sensor.row_time_us * 1e-3 * self.height as f64;
        check_range("sensor.row_time_us × height, ms", readout_ms, 0.0..=period_ms)
    }

    /// The camera that takes the raw images.
    pub fn camera(&self) -> Result<CameraModel, ParameterError> {
        let lens = self.sensor.lens().map_err(|e| e.within("sensor"))?;
        CameraModel::new(self.intrinsics(), lens).ok_or_else(|| ParameterError {
            key: "focal_px".to_owned(),
            value: self.focal_px.to_string(),
            allowed: "numbers that belong to a camera".to_owned(),
        })
    }

    /// Intrinsics of the raw image; the principal point is the middle of the image.
    pub fn intrinsics(&self) -> Intrinsics {
        Intrinsics::pinhole(self.width, self.height, self.focal_px)
    }
}

impl MotionParams {
    /// Refuses motions that no hand can make.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("mean_speed_m_s", self.mean_speed_m_s, 0.0..=5.0)?;
        check_range("mean_turn_deg_s", self.mean_turn_deg_s, 0.0..=200.0)?;
        check_range("tremor", self.tremor, 0.0..=10.0)
    }
}

impl SensorParams {
    /// Refuses values that no sensor has.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("noise_std_dev", self.noise_std_dev, 0.0..=50.0)?;
        check_range("vignette", self.vignette, 0.0..=0.95)?;
        check_range("gain_amplitude", self.gain_amplitude, 0.0..=2.0)?;
        check_range("offset_amplitude", self.offset_amplitude, 0.0..=100.0)?;
        check_range("exposure_period_s", self.exposure_period_s, 0.1..=1000.0)?;
        check_range("exposure_ms", self.exposure_ms, 0.0..=100.0)?;
        check_range("row_time_us", self.row_time_us, 0.0..=500.0)?;
        for (i, &k) in self.distortion.iter().enumerate() {
            check_range(&format!("distortion[{i}]"), k, -100.0..=100.0)?;
        }
        self.lens().map(|_| ())
    }

    /// The lens; an error unless there are 0, 4, 5 or 8 coefficients.
    pub fn lens(&self) -> Result<Distortion, ParameterError> {
        Distortion::try_radtan(&self.distortion).ok_or_else(|| ParameterError {
            key: "distortion".to_owned(),
            value: format!("{:?}", self.distortion),
            allowed: "0, 4, 5 or 8 numbers: k1 k2 p1 p2 [k3 [k4 k5 k6]]".to_owned(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_out_of_range_name_their_key() {
        let refused = |change: &dyn Fn(&mut SimulatorParams)| {
            let mut params = SimulatorParams::default();
            change(&mut params);
            params.validate().unwrap_err().to_string()
        };
        assert!(SimulatorParams::default().validate().is_ok());
        assert!(refused(&|p| p.frames = 0).starts_with("frames = 0: must be"));
        assert!(refused(&|p| p.width = 1 << 40).starts_with("width ="));
        assert!(refused(&|p| p.focal_px = f64::NAN).starts_with("focal_px = NaN"));
        assert!(refused(&|p| p.motion.mean_speed_m_s = -1.0).starts_with("motion.mean_speed_m_s"));
        assert!(refused(&|p| p.sensor.vignette = 1.5).starts_with("sensor.vignette"));
        assert!(refused(&|p| p.sensor.exposure_ms = 40.0).starts_with("sensor.exposure_ms"));
        assert!(refused(&|p| p.sensor.row_time_us = 90.0).starts_with("sensor.row_time_us"));
        assert!(refused(&|p| p.sensor.distortion = vec![0.1; 3]).starts_with("sensor.distortion"));
        let infinite = vec![f64::INFINITY; 4];
        assert!(refused(&|p| p.sensor.distortion = infinite.clone()).contains("distortion[0]"));
    }

    #[test]
    fn parameters_survive_toml_and_unknown_keys_are_refused() {
        let mut params = SimulatorParams { scene: SceneKind::Corridor, ..Default::default() };
        params.sensor.distortion = vec![0.1, 0.0, 0.0, 0.0];
        let text = toml::to_string(&params).unwrap();
        assert_eq!(toml::from_str::<SimulatorParams>(&text).unwrap(), params);
        assert!(toml::from_str::<SimulatorParams>("[sensor]\nnoise = 2.0").is_err());
        assert!(toml::from_str::<SimulatorParams>("scene = \"moon\"").is_err());
    }
}
