//! Exposure, gain, white balance and focus: set, locked, read.

use rustix::io::Errno;

use super::kernel::{CONTROL_READ_ONLY, CONTROL_WRITE_ONLY};
use super::params::{CameraParams, Setting};
use super::video_device::VideoDevice;

/// `V4L2_CID_EXPOSURE_AUTO`.
const EXPOSURE_AUTO: u32 = 0x009a_0901;
/// `V4L2_EXPOSURE_MANUAL`.
const EXPOSURE_MANUAL: i32 = 1;
/// `V4L2_CID_EXPOSURE_ABSOLUTE`, in 100 µs.
const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
/// `V4L2_CID_EXPOSURE_AUTO_PRIORITY`: whether the rate may fall in the dark.
const EXPOSURE_AUTO_PRIORITY: u32 = 0x009a_0903;
/// `V4L2_CID_AUTOGAIN`.
const AUTO_GAIN: u32 = 0x0098_0912;
/// `V4L2_CID_GAIN`.
const GAIN: u32 = 0x0098_0913;
/// `V4L2_CID_ANALOGUE_GAIN`.
const ANALOGUE_GAIN: u32 = 0x009e_0903;
/// `V4L2_CID_AUTO_WHITE_BALANCE`.
const AUTO_WHITE_BALANCE: u32 = 0x0098_090c;
/// `V4L2_CID_WHITE_BALANCE_TEMPERATURE`, in kelvin.
const WHITE_BALANCE_TEMPERATURE: u32 = 0x0098_091a;
/// `V4L2_CID_FOCUS_AUTO`.
const FOCUS_AUTO: u32 = 0x009a_090c;
/// `V4L2_CID_FOCUS_ABSOLUTE`.
const FOCUS_ABSOLUTE: u32 = 0x009a_090a;
/// `V4L2_CTRL_FLAG_VOLATILE`: the device changes the value, and reading returns its current value.
const VOLATILE: u32 = 0x80;

/// Microseconds of one step of the exposure control.
const EXPOSURE_STEP_MICROS: i32 = 100;

/// A setting that the camera may also control automatically.
struct Knob {
    key: &'static str,
    name: &'static str,
    /// The control of the automatic mode, its values for on in the order of trial, and for off.
    auto: (u32, &'static [i32], i32),
    /// Controls that hold the value; the first that exists is used.
    values: &'static [u32],
    /// Units of the configuration per step of the control.
    units_per_step: i32,
}

const EXPOSURE: Knob = Knob {
    key: "exposure_us",
    name: "exposure time",
    // Webcams have aperture priority: the time is automatic, and there is no aperture.
    auto: (EXPOSURE_AUTO, &[3, 0], EXPOSURE_MANUAL),
    values: &[EXPOSURE_ABSOLUTE],
    units_per_step: EXPOSURE_STEP_MICROS,
};
const GAIN_KNOB: Knob = knob("gain", "gain", AUTO_GAIN, &[GAIN, ANALOGUE_GAIN]);
const WHITE_BALANCE: Knob =
    knob("white_balance_k", "colour temperature", AUTO_WHITE_BALANCE, &[WHITE_BALANCE_TEMPERATURE]);
const FOCUS: Knob = knob("focus", "focus", FOCUS_AUTO, &[FOCUS_ABSOLUTE]);

/// A knob in the units of its control, whose automatic mode is on or off.
const fn knob(key: &'static str, name: &'static str, auto: u32, values: &'static [u32]) -> Knob {
    Knob { key, name, auto: (auto, &[1], 0), values, units_per_step: 1 }
}

/// The settings with their knobs.
fn settings(params: &CameraParams) -> [(Setting, Knob); 4] {
    [
        (params.exposure_us, EXPOSURE),
        (params.gain, GAIN_KNOB),
        (params.white_balance_k, WHITE_BALANCE),
        (params.focus, FOCUS),
    ]
}

/// Applies every setting that takes effect at once; returns the camera's refusals, in words. A camera that lacks a
/// control works without it: brightness is estimated for every frame.
pub fn apply(device: &mut dyn VideoDevice, params: &CameraParams) -> Vec<String> {
    if params.exposure_us != Setting::Leave && device.control(EXPOSURE_AUTO_PRIORITY).is_some() {
        // A rate that falls in the dark is a longer exposure by another name. Not all cameras can set it.
        let _ = device.set_value(EXPOSURE_AUTO_PRIORITY, 0);
    }
    let one = |(setting, knob): (Setting, Knob)| match setting {
        // The value that the camera finds first is kept later.
        Setting::Leave | Setting::Lock => None,
        Setting::Auto => knob.automatic(device).err(),
        Setting::Value(value) => knob.fix(device, value).err(),
    };
    settings(params).into_iter().filter_map(one).collect()
}

/// Whether any setting is to be locked once the camera has settled.
pub fn has_locks(params: &CameraParams) -> bool {
    settings(params).iter().any(|(setting, _)| *setting == Setting::Lock)
}

/// Keeps the values that the camera has found; returns its refusals, in words.
pub fn lock(device: &mut dyn VideoDevice, params: &CameraParams) -> Vec<String> {
    let locked = settings(params).into_iter().filter(|(setting, _)| *setting == Setting::Lock);
    locked.filter_map(|(_, knob)| knob.keep(device).err()).collect()
}

impl Knob {
    fn complaint(&self, problem: &str) -> String {
        let key = self.key;
        format!("capture.camera.{key}: {problem} (semidense cameras lists its controls)")
    }

    fn refused(&self, error: Errno) -> String {
        self.complaint(&format!("the camera refused it ({error})"))
    }

    /// The control that holds the value.
    fn value_control(&self, device: &dyn VideoDevice) -> Result<u32, String> {
        let mut there = self.values.iter().copied().filter(|&id| device.control(id).is_some());
        there.next().ok_or_else(|| {
            self.complaint(&format!(
                "the camera has no control for {}; it stays unchanged",
                self.name
            ))
        })
    }

    /// Whether the camera chooses the value.
    fn is_automatic(&self, device: &dyn VideoDevice) -> bool {
        let (id, _, off) = self.auto;
        device.control(id).is_some() && device.value(id).is_ok_and(|value| value != off)
    }

    fn automatic(&self, device: &mut dyn VideoDevice) -> Result<(), String> {
        let (id, on, _) = self.auto;
        if device.control(id).is_none() {
            return Err(self.complaint(&format!("the camera has no automatic {}", self.name)));
        }
        if self.is_automatic(device) {
            return Ok(());
        }
        let mut answer = Err(Errno::INVAL);
        for &value in on {
            answer = answer.or_else(|_| device.set_value(id, value));
        }
        answer.map_err(|error| self.refused(error))
    }

    fn manual(&self, device: &mut dyn VideoDevice) -> Result<(), String> {
        let (id, _, off) = self.auto;
        if !self.is_automatic(device) {
            return Ok(());
        }
        device.set_value(id, off).map_err(|error| self.refused(error))
    }

    /// Sets the value, in the configuration's units, to the nearest that the camera supports.
    fn fix(&self, device: &mut dyn VideoDevice, wanted: i32) -> Result<(), String> {
        let id = self.value_control(device)?;
        // First: the value of an automatic control cannot be set.
        self.manual(device)?;
        let range = device.control(id).ok_or_else(|| self.refused(Errno::INVAL))?;
        let (minimum, maximum) = (i64::from(range.minimum), i64::from(range.maximum));
        let step = i64::from(range.step.max(1));
        let units = i64::from(self.units_per_step);
        let steps = (i64::from(wanted) + units / 2).div_euclid(units);
        let inside = steps.clamp(minimum, maximum.max(minimum));
        let on_grid = minimum + (inside - minimum + step / 2) / step * step;
        let value = if on_grid > maximum { on_grid - step } else { on_grid };
        let value = i32::try_from(value).unwrap_or(range.default);
        device.set_value(id, value).map_err(|error| self.refused(error))?;
        let granted = device.value(id).unwrap_or(value);
        let granted_units = i64::from(granted) * units;
        // Within half a step of the control the value counts as granted.
        if (granted_units - i64::from(wanted)).abs() * 2 <= units * step {
            return Ok(());
        }
        Err(self.complaint(&format!(
            "{wanted} was requested, {granted_units} is set; the range is {} to {}",
            minimum * units,
            maximum * units
        )))
    }

    /// Ends the automatic mode and keeps its last value.
    fn keep(&self, device: &mut dyn VideoDevice) -> Result<(), String> {
        let found =
            self.value_control(device).ok().and_then(|id| Some((id, device.value(id).ok()?)));
        if device.control(self.auto.0).is_none() && found.is_none() {
            return self.value_control(device).map(|_| ());
        }
        self.manual(device)?;
        match found {
            // Cameras differ in the value that they fall back to.
            Some((id, value)) => device.set_value(id, value).map_err(|error| self.refused(error)),
            None => Ok(()),
        }
    }

    /// Returns the value in the configuration's units, if it is known: it was set, or the camera reports its choice.
    /// Also whether the value may change without being set.
    fn reading(&self, device: &dyn VideoDevice) -> Option<(i64, bool)> {
        let mut there = self.values.iter().filter_map(|&id| device.control(id));
        let control = there.find(|control| control.flags & CONTROL_WRITE_ONLY == 0)?;
        let tells = control.flags & (VOLATILE | CONTROL_READ_ONLY) != 0;
        let is_automatic = self.is_automatic(device);
        if is_automatic && !tells {
            return None;
        }
        let value = device.value(control.id).ok()?;
        Some((i64::from(value) * i64::from(self.units_per_step), is_automatic || tells))
    }
}

/// Exposure and gain of a frame, as far as known.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Exposure {
    /// Exposure time, nanoseconds; 0 where unknown.
    pub nanos: u64,
    /// Gain in the camera's steps; 0 where unknown.
    pub gain: f32,
    /// Whether the camera changes it, so that it must be read again.
    pub changes: bool,
}

/// No suitable camera exposes longer than a second: a longer time is in another unit.
const LONGEST_EXPOSURE_NANOS: u64 = 1_000_000_000;

/// Reads exposure time and gain.
pub fn exposure(device: &dyn VideoDevice) -> Exposure {
    let time = EXPOSURE.reading(device);
    let gain = GAIN_KNOB.reading(device);
    Exposure {
        nanos: time
            .and_then(|(micros, _)| u64::try_from(micros).ok()?.checked_mul(1000))
            .filter(|nanos| *nanos <= LONGEST_EXPOSURE_NANOS)
            .unwrap_or(0),
        gain: gain.map_or(0.0, |(value, _)| value as f32),
        changes: [time, gain].iter().flatten().any(|(_, changes)| *changes),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::v4l::fake::Fake;

    fn params(change: impl Fn(&mut CameraParams)) -> CameraParams {
        let mut params = CameraParams::default();
        change(&mut params);
        params
    }

    /// A webcam: exposure in 100 µs steps, automatic at first, gain without an automatic mode, no focus.
    fn webcam() -> Fake {
        Fake::default()
            .with_control(EXPOSURE_AUTO, "Auto Exposure", (0, 3, 1), 3, 0)
            .with_control(EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", (3, 2047, 1), 250, 0)
            .with_control(EXPOSURE_AUTO_PRIORITY, "Exposure, Dynamic Framerate", (0, 1, 1), 1, 0)
            .with_control(GAIN, "Gain", (0, 100, 5), 40, 0)
    }

    #[test]
    fn a_fixed_exposure_is_set_manually_to_the_nearest_step() {
        let fake = webcam();
        let mut device = fake.device();
        let refused = apply(&mut device, &params(|p| p.exposure_us = Setting::Value(8040)));
        assert_eq!(refused, [""; 0]);
        assert_eq!(fake.value_of(EXPOSURE_AUTO), EXPOSURE_MANUAL);
        assert_eq!(fake.value_of(EXPOSURE_ABSOLUTE), 80);
        assert_eq!(fake.value_of(EXPOSURE_AUTO_PRIORITY), 0);
        let known = exposure(&device);
        assert_eq!(known, Exposure { nanos: 8_000_000, gain: 40.0, changes: false });
    }

    #[test]
    fn an_automatic_exposure_is_unknown_unless_the_camera_reports_it() {
        assert_eq!(exposure(&webcam().device()).nanos, 0);
        let telling = webcam().with_control(
            EXPOSURE_ABSOLUTE,
            "Exposure Time, Absolute",
            (3, 2047, 1),
            250,
            VOLATILE,
        );
        let known = exposure(&telling.device());
        assert_eq!((known.nanos, known.changes), (25_000_000, true));
    }

    #[test]
    fn a_value_out_of_range_is_clamped_and_reported() {
        let fake = webcam();
        let mut device = fake.device();
        let refused = apply(
            &mut device,
            &params(|p| {
                p.exposure_us = Setting::Value(1_000_000);
                p.gain = Setting::Value(42);
            }),
        );
        assert_eq!(fake.value_of(EXPOSURE_ABSOLUTE), 2047);
        assert_eq!(fake.value_of(GAIN), 40);
        assert_eq!(refused.len(), 1, "{refused:?}");
        assert!(
            refused[0].contains(
                "exposure_us: 1000000 was requested, 204700 is set; the range is 300 to 204700"
            ),
            "{refused:?}"
        );
    }

    #[test]
    fn a_lock_keeps_the_values_found() {
        let fake = webcam();
        let wish = params(|p| {
            p.exposure_us = Setting::Lock;
            p.focus = Setting::Lock;
        });
        let mut device = fake.device();
        assert!(has_locks(&wish) && !has_locks(&CameraParams::default()));
        assert_eq!(apply(&mut device, &wish), [""; 0], "nothing before it has settled");
        assert_eq!(fake.value_of(EXPOSURE_AUTO), 3);
        fake.set(EXPOSURE_ABSOLUTE, 333);
        let refused = lock(&mut device, &wish);
        assert_eq!(fake.value_of(EXPOSURE_AUTO), EXPOSURE_MANUAL);
        assert_eq!(fake.value_of(EXPOSURE_ABSOLUTE), 333);
        assert_eq!(refused.len(), 1, "{refused:?}");
        assert!(
            refused[0].starts_with("capture.camera.focus: the camera has no control for focus")
        );
    }

    #[test]
    fn refusals_of_a_camera_are_reported() {
        let fake = webcam();
        fake.refuse_controls(Errno::IO);
        let mut device = fake.device();
        let refused = apply(&mut device, &params(|p| p.exposure_us = Setting::Value(8000)));
        assert!(refused[0].contains("exposure_us: the camera refused it ("), "{refused:?}");
        let refused = apply(&mut device, &params(|p| p.gain = Setting::Auto));
        assert!(refused[0].contains("gain: the camera has no automatic gain"), "{refused:?}");
    }

    #[test]
    fn the_automatic_mode_is_set_to_a_value_that_the_camera_accepts() {
        let fake = webcam();
        fake.set(EXPOSURE_AUTO, EXPOSURE_MANUAL);
        fake.refuse_value(EXPOSURE_AUTO, 3);
        let mut device = fake.device();
        assert_eq!(apply(&mut device, &params(|p| p.exposure_us = Setting::Auto)), [""; 0]);
        assert_eq!(fake.value_of(EXPOSURE_AUTO), 0);
    }
}
