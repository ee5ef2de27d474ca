//! Everything that can be set about a simulated sequence.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::parameter::{ParameterError, check_range};

/// Which scene is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SceneKind {
    /// A furnished room of 6 × 5 × 3 m.
    Room,
    /// One large printed plane, seen from 1.5 m above.
    Plane,
    /// A corridor of 24 × 2.4 × 2.6 m.
    Corridor,
}

impl FromStr for SceneKind {
    type Err = &'static str;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        match name {
            "room" => Ok(Self::Room),
            "plane" => Ok(Self::Plane),
            "corridor" => Ok(Self::Corridor),
            _ => Err("there is no such scene; scenes are room, plane and corridor"),
        }
    }
}

/// How the camera moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionKind {
    /// A walk with the camera in the hand: swaying, turning, trembling.
    Handheld,
    /// To and fro on a straight line across the view, without turning or tremor.
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
    /// Mean speed along the path, metres a second before `world_scale`; 0.5 is a slow walk.
    pub mean_speed_m_s: f64,
    /// Mean rate of turning, degrees a second; 15 turns 300° in the default 20 s.
    pub mean_turn_deg_s: f64,
    /// Factor on the tremor of the hand (about 1.5 mm and 0.1° at 1.5 to 6 Hz); 0 is a gimbal.
    pub tremor: f64,
}

impl Default for MotionParams {
    fn default() -> Self {
        Self { kind: MotionKind::Handheld, mean_speed_m_s: 0.5, mean_turn_deg_s: 15.0, tremor: 1.0 }
    }
}

/// What lens and sensor do to the light.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorParams {
    /// Standard deviation of the noise of a pixel, grey levels; 2 is a small sensor indoors.
    pub noise_std_dev: f64,
    /// Share of the light that is lost in the image corner (∝ r⁴ from the centre); 0 is none.
    pub vignette: f64,
    /// Amplitude of the slow change of gain, as natural logarithm; 0 is a locked exposure.
    pub gain_amplitude: f64,
    /// Amplitude of the slow change of offset, grey levels.
    pub offset_amplitude: f64,
    /// Period of both changes, seconds.
    pub exposure_period_s: f64,
    /// Exposure time, milliseconds: motion is averaged over it; 0 freezes it.
    pub exposure_ms: f64,
    /// Time from the start of one row to the next, microseconds; 0 is a global shutter.
    pub row_time_us: f64,
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
        }
    }
}

/// A simulated sequence: the same values give the same bytes, on any number of threads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulatorParams {
    /// What is seen.
    pub scene: SceneKind,
    /// Chooses textures, path and noise.
    pub seed: u64,
    /// Number of frames; all are kept in memory (307 kB each at 640 × 480).
    pub frames: usize,
    /// Frames a second.
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
    /// Refuses values that cannot be simulated; names the key and what is allowed.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("frames", self.frames, 1..=100_000)?;
        check_range("rate_hz", self.rate_hz, 1.0..=1000.0)?;
        check_range("width", self.width, 16..=4096)?;
        check_range("height", self.height, 16..=4096)?;
        // Between a field of view of 127° and of 3° across the larger side.
        let side = self.width.max(self.height) as f64;
        check_range("focal_px", self.focal_px, 0.25 * side..=20.0 * side)?;
        check_range("world_scale", self.world_scale, 1e-3..=1e3)?;
        self.motion.validate().map_err(|e| e.within("motion"))?;
        self.sensor.validate().map_err(|e| e.within("sensor"))
    }

    /// The ideal pinhole intrinsics; the principal point is the middle of the image.
    pub fn intrinsics(&self) -> Intrinsics {
        Intrinsics {
            fx: self.focal_px,
            fy: self.focal_px,
            cx: 0.5 * (self.width as f64 - 1.0),
            cy: 0.5 * (self.height as f64 - 1.0),
            width: self.width,
            height: self.height,
        }
    }
}

impl MotionParams {
    /// Refuses values that no hand can do.
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
        check_range("row_time_us", self.row_time_us, 0.0..=500.0)
    }
}
