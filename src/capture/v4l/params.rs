//! Parameters of a kernel camera.

use std::fmt;

use serde::de::{self, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::pixel_format::PixelFormat;
use super::video_device::FourCc;
use crate::slam::parameter::{ParameterError, check_range};

/// A setting that the camera can also control automatically.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Setting {
    /// Unchanged.
    #[default]
    Leave,
    /// The camera controls it continuously.
    Auto,
    /// The value that the camera has found after the settling time is kept.
    Lock,
    /// This value.
    #[serde(untagged)]
    Value(i32),
}

impl<'de> Deserialize<'de> for Setting {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Words;
        impl Visitor<'_> for Words {
            type Value = Setting;

            fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(out, "\"leave\", \"auto\", \"lock\" or a whole number")
            }

            fn visit_str<E: de::Error>(self, word: &str) -> Result<Setting, E> {
                match word {
                    "leave" => Ok(Setting::Leave),
                    "auto" => Ok(Setting::Auto),
                    "lock" => Ok(Setting::Lock),
                    _ => Err(E::invalid_value(de::Unexpected::Str(word), &self)),
                }
            }

            fn visit_i64<E: de::Error>(self, value: i64) -> Result<Setting, E> {
                let wrong = || E::invalid_value(de::Unexpected::Signed(value), &self);
                i32::try_from(value).map(Setting::Value).map_err(|_| wrong())
            }
        }
        deserializer.deserialize_any(Words)
    }
}

/// The format requested of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u32)]
pub enum FormatChoice {
    /// The cheapest to convert that reaches the rate.
    #[default]
    Auto = 0,
    /// 8-bit grey.
    Grey = PixelFormat::Grey as u32,
    /// 10-bit grey in 16.
    Y10 = PixelFormat::Y10 as u32,
    /// 12-bit grey in 16.
    Y12 = PixelFormat::Y12 as u32,
    /// 16-bit grey.
    Y16 = PixelFormat::Y16 as u32,
    /// Packed 4:2:2, luma first.
    Yuyv = PixelFormat::Yuyv as u32,
    /// Packed 4:2:2, chroma first.
    Uyvy = PixelFormat::Uyvy as u32,
    /// Planar 4:2:0.
    Nv12 = PixelFormat::Nv12 as u32,
    /// Motion JPEG.
    Mjpeg = PixelFormat::Mjpeg as u32,
}

impl FormatChoice {
    /// The format, if one is named.
    pub fn format(self) -> Option<PixelFormat> {
        PixelFormat::of(FourCc(self as u32))
    }
}

/// Settings requested of a camera. The size is the rig's: a calibration holds for one size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraParams {
    /// Buffers that the driver fills in rotation, 3 to 5. Three are enough if capture is never held up for more than a
    /// frame; each further one saves one frame in a longer pause.
    pub buffers: u32,
    /// auto, grey, y10, y12, y16, yuyv, uyvy, nv12 or mjpeg. Auto takes the first of grey, nv12, yuyv,
    /// uyvy, y10, y12, y16, mjpeg that has the rig's size and reaches the rate.
    pub format: FormatChoice,
    /// Frames per second; 0 is the rig's `rate_hz`, and without that the camera's own.
    pub rate_hz: f64,
    /// Exposure time: leave, auto, lock (the value that the camera has found after `settle_s` is kept), or
    /// microseconds. A fixed one keeps grey levels and stamps steady; keep it below 10 ms because of motion blur.
    pub exposure_us: Setting,
    /// Gain: leave, auto, lock, or a value in the camera's steps (`semidense cameras` lists the range).
    pub gain: Setting,
    /// White balance: leave, auto, lock, or a colour temperature in kelvin. It shifts the grey levels of coloured
    /// objects.
    pub white_balance_k: Setting,
    /// Focus: leave, auto, lock, or a value in the camera's steps. A focus that moves changes the
    /// calibration.
    pub focus: Setting,
    /// Seconds of streaming after which `lock` keeps the value that the camera has found; automatic exposure needs
    /// about one.
    pub settle_s: f64,
    /// Offset added to every stamp, microseconds, after it was moved to the middle of the exposure: the delay found by
    /// a calibration of the stamps, such as minus half the readout of a rolling shutter.
    pub stamp_offset_us: i64,
    /// Seconds without an undamaged frame after which a camera is stale; longer than the longest exposure. If its driver
    /// delivers none, it is also reopened.
    pub stall_s: f64,
    /// Longest pause between two attempts to open a camera, seconds; the first is 0.1 and they double.
    pub retry_s: f64,
}

impl Default for CameraParams {
    fn default() -> Self {
        Self {
            buffers: 4,
            format: FormatChoice::Auto,
            rate_hz: 0.0,
            exposure_us: Setting::Leave,
            gain: Setting::Leave,
            white_balance_k: Setting::Leave,
            focus: Setting::Leave,
            settle_s: 1.0,
            stamp_offset_us: 0,
            stall_s: 2.0,
            retry_s: 2.0,
        }
    }
}

impl CameraParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("buffers", self.buffers, 3..=5)?;
        check_range("rate_hz", self.rate_hz, 0.0..=1000.0)?;
        for (key, setting, range) in [
            ("exposure_us", self.exposure_us, 1..=10_000_000),
            ("gain", self.gain, i32::MIN..=i32::MAX),
            ("white_balance_k", self.white_balance_k, 1000..=20_000),
            ("focus", self.focus, i32::MIN..=i32::MAX),
        ] {
            if let Setting::Value(value) = setting {
                check_range(key, value, range)?;
            }
        }
        check_range("settle_s", self.settle_s, 0.0..=60.0)?;
        check_range("stamp_offset_us", self.stamp_offset_us, -1_000_000..=1_000_000)?;
        check_range("stall_s", self.stall_s, 0.1..=60.0)?;
        check_range("retry_s", self.retry_s, 0.1..=3600.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_words_or_numbers() {
        let read = |text: &str| toml::from_str::<CameraParams>(text).map_err(|e| e.to_string());
        let params = read("exposure_us = 8000\ngain = \"auto\"\nfocus = \"lock\"\n").unwrap();
        assert_eq!(params.exposure_us, Setting::Value(8000));
        assert_eq!((params.gain, params.focus), (Setting::Auto, Setting::Lock));
        assert_eq!(params.white_balance_k, Setting::Leave);
        let again = toml::from_str(&toml::to_string(&params).unwrap()).unwrap();
        assert_eq!(params, again);
        for wrong in ["gain = \"on\"", "gain = 1.5", "gain = 3000000000", "shutter = 3"] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
        assert!(read("gain = \"on\"").unwrap_err().contains("\"lock\" or a whole number"));
    }

    #[test]
    fn a_named_format_is_that_of_its_name() {
        use PixelFormat::*;
        let of = |name: &str| {
            let text = format!("format = {name:?}");
            toml::from_str::<CameraParams>(&text).unwrap().format.format()
        };
        let names = ["grey", "y10", "y12", "y16", "yuyv", "uyvy", "nv12", "mjpeg"];
        assert_eq!(names.map(of), [Grey, Y10, Y12, Y16, Yuyv, Uyvy, Nv12, Mjpeg].map(Some));
        assert_eq!(of("auto"), None);
    }

    #[test]
    fn values_out_of_range_are_named() {
        assert!(CameraParams::default().validate().is_ok());
        let wrong = |change: fn(&mut CameraParams)| {
            let mut params = CameraParams::default();
            change(&mut params);
            params.validate().unwrap_err().to_string()
        };
        assert_eq!(wrong(|p| p.buffers = 2), "buffers = 2: must be 3 to 5");
        assert!(wrong(|p| p.exposure_us = Setting::Value(0)).starts_with("exposure_us = 0"));
        assert!(wrong(|p| p.rate_hz = f64::NAN).starts_with("rate_hz = NaN"));
        assert!(wrong(|p| p.stall_s = 0.0).starts_with("stall_s"));
    }
}
