//! Rigs: the calibration of a camera, known before it is opened, from TOML or a TUM `camera.txt`.

use std::path::Path;

use nalgebra::Vector2;
use serde::Deserialize;

use crate::capture::decode_error::MAX_SIDE;
use crate::capture::foreign_rig;
use crate::capture::listing;
use crate::capture::rig_error::RigError;
use crate::capture::source_error::SourceError;
use crate::slam::geometry::camera_model::{CameraModel, Distortion};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::parameter::{ParameterError, check_range};

/// Allowed sides of an image, pixels.
const SIDE_RANGE: std::ops::RangeInclusive<usize> = 16..=MAX_SIDE;
/// Allowed focal lengths, pixels: from a fisheye on the smallest image to a telescope on the largest.
const FOCAL_RANGE: std::ops::RangeInclusive<f64> = 1.0..=100_000.0;
/// Allowed lens coefficients; those of rational lenses reach tens.
const COEFFICIENT_RANGE: std::ops::RangeInclusive<f64> = -1000.0..=1000.0;
/// Widest view of a lens that is not modelled as a fisheye, degrees: at the edge of a pinhole image of 160° a pixel is
/// 33 times as fine as in the middle.
const WIDEST_PINHOLE_DEG: f64 = 160.0;
/// Widest view of any lens, degrees; fisheyes that look backwards reach 280.
const WIDEST_DEG: f64 = 300.0;
/// Narrowest view of a camera, degrees; telescopes have less.
const NARROWEST_DEG: f64 = 0.5;
/// Usual views of robots' cameras, degrees; others get a remark.
const USUAL_DEG: std::ops::RangeInclusive<f64> = 10.0..=160.0;
/// Largest ratio of a pixel's sides, which is that of fx and fy. Pixels of cameras are square, those of the video formats
/// with the widest ones (DV in 16:9) have 1.46.
const USUAL_ASPECT: f64 = 1.5;
/// Allowed frame rates, frames per second.
const RATE_RANGE: std::ops::RangeInclusive<f64> = 0.1..=1000.0;
/// Allowed read-out times of all rows, milliseconds; slow webcams need 60.
pub const READOUT_MS_RANGE: std::ops::RangeInclusive<f64> = 0.0..=200.0;

/// One camera: lens, intrinsics of the raw image, how long it reads out rows and, if known, its frame rate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rig {
    /// The calibrated camera.
    pub camera: CameraModel,
    /// Frames per second, if the rig gives it.
    pub rate_hz: Option<f64>,
    /// Time in which all rows are read out, milliseconds; 0 if they are exposed together.
    pub readout_ms: f64,
}

/// The lens models of a rig file.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LensModel {
    /// No distortion.
    Pinhole,
    /// OpenCV's radial-tangential model.
    Radtan,
    /// Kannala–Brandt, OpenCV's `fisheye`.
    Equidistant,
}

/// A rig as a file states it, unchecked.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigFile {
    /// The lens model.
    pub model: LensModel,
    /// Width of the raw image, pixels.
    pub width: usize,
    /// Height of the raw image, pixels.
    pub height: usize,
    /// Focal length along u, pixels.
    pub fx: f64,
    /// Focal length along v, pixels.
    pub fy: f64,
    /// Principal point, u; an integer is the centre of a pixel.
    pub cx: f64,
    /// Principal point, v.
    pub cy: f64,
    /// Lens coefficients in OpenCV's order, as many as the model needs.
    #[serde(default)]
    pub coefficients: Vec<f64>,
    /// Frames per second.
    pub rate_hz: Option<f64>,
    /// Time in which all rows are read out (rolling shutter), milliseconds; 0 if they are exposed together.
    #[serde(default)]
    pub readout_ms: f64,
}

impl Rig {
    /// Reads a rig from a TOML file (`config/rigs/` has examples with every key).
    pub fn read(path: &Path) -> Result<Self, SourceError> {
        let text = listing::read_text(path)?;
        Ok(Self::from_toml(path, &text)?)
    }

    /// Reads a rig from TOML text that came from `path`.
    pub fn from_toml(path: &Path, text: &str) -> Result<Self, RigError> {
        let file: RigFile = toml::from_str(text).map_err(|error| {
            if let Some((tool, values)) = foreign_rig::tool(text) {
                return RigError::Foreign { path: path.to_owned(), tool, values };
            }
            let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
            RigError::Syntax {
                path: path.to_owned(),
                line: before.matches('\n').count() + 1,
                problem: foreign_rig::with_own_lens(error.message().replace('\n', " ")),
            }
        })?;
        file.rig_of(path)
    }

    /// Reads a rig from a `camera.txt`: `fx fy cx cy width height` and 0, 4, 5 or 8 radtan
    /// coefficients (`k1 k2 p1 p2 [k3 [k4 k5 k6]]`), OpenCV's model and order.
    pub fn read_camera_txt(path: &Path) -> Result<Self, SourceError> {
        Self::from_camera_txt(path, &listing::read_text(path)?)
    }

    /// Reads a rig from the text of a `camera.txt` that came from `path`.
    pub fn from_camera_txt(path: &Path, text: &str) -> Result<Self, SourceError> {
        const SHAPE: &str =
            "needs one line `fx fy cx cy width height [k1 k2 p1 p2 [k3 [k4 k5 k6]]]`";
        let mut rows = listing::rows(path, text);
        let row = rows.next().ok_or_else(|| SourceError::Line {
            path: path.to_owned(),
            line: 1,
            problem: SHAPE.to_owned(),
        })?;
        if let Some(second) = rows.next() {
            return Err(second.error(format!("a second camera; {SHAPE}")));
        }
        let numbers = row
            .text
            .split_whitespace()
            .map(|field| row.number(field))
            .collect::<Result<Vec<f64>, SourceError>>()?;
        let [fx, fy, cx, cy, width, height, ref coefficients @ ..] = numbers[..] else {
            return Err(row.error(format!("{SHAPE}, has {} numbers", numbers.len())));
        };
        let model = if coefficients.is_empty() { LensModel::Pinhole } else { LensModel::Radtan };
        let (width, height) = (side(width), side(height));
        let coefficients = coefficients.to_vec();
        let file = RigFile::of_lens(model, [width, height], [fx, fy, cx, cy], coefficients);
        Ok(file.rig_of(path)?)
    }

    /// Returns the difference between the images of two cameras at the same position, pixels: the largest shift over a
    /// grid of rays; infinite if the sizes differ or a ray meets only one of the images.
    pub fn largest_shift_px(&self, other: &Self) -> f64 {
        /// Rays along each side, borders included.
        const GRID: usize = 9;
        let (own, others) = (self.camera.intrinsics(), other.camera.intrinsics());
        if (own.width, own.height) != (others.width, others.height) {
            return f64::INFINITY;
        }
        let place = |i: usize, side: usize| i as f64 / (GRID - 1) as f64 * (side - 1) as f64;
        let shift = |index: usize| {
            let (column, row) = (index % GRID, index / GRID);
            let pixel = Vector2::new(place(column, own.width), place(row, own.height));
            let ray = self.camera.unproject(&pixel)?;
            Some((other.camera.project(&ray)? - pixel).norm())
        };
        (0..GRID * GRID).map(|index| shift(index).unwrap_or(f64::INFINITY)).fold(0.0, f64::max)
    }

    /// Describes in one line what is unusual about the camera and may be a mistake.
    pub fn remark(&self) -> Option<String> {
        let k = self.camera.intrinsics();
        let aspect = (k.fx / k.fy).max(k.fy / k.fx);
        if aspect > USUAL_ASPECT {
            return Some(format!(
                "fx = {} and fy = {} belong to pixels with one side {aspect:.1} times as long as the other; cameras have at most \
                 {USUAL_ASPECT}: is one of them wrong?",
                k.fx, k.fy
            ));
        }
        let is_fisheye = matches!(self.camera.distortion(), Distortion::Equidistant(_));
        let (across, down) =
            (view_deg(k.fx, k.cx, k.width, is_fisheye), view_deg(k.fy, k.cy, k.height, is_fisheye));
        if USUAL_DEG.contains(&across.max(down)) {
            return None;
        }
        Some(format!(
            "fx = {} and fy = {} with {}x{} pixels give a field of view of {across:.1}° x {down:.1}°; cameras usually have {} to {}°: \
             are they in pixels, and for this image size?",
            k.fx,
            k.fy,
            k.width,
            k.height,
            USUAL_DEG.start(),
            USUAL_DEG.end()
        ))
    }
}

/// Converts any number to the side of an image; a fraction or a negative number becomes 0, which the range refuses.
pub(super) fn side(number: f64) -> usize {
    if number.fract() == 0.0 { number as usize } else { 0 }
}

/// Angle between the first and the last pixel of a row or column by the focal length alone, degrees. A fisheye's image
/// grows with the angle, that of other lenses with its tangent.
fn view_deg(focal_px: f64, centre_px: f64, side: usize, is_fisheye: bool) -> f64 {
    let half = |distance_px: f64| match distance_px / focal_px {
        angle if is_fisheye => angle,
        tangent => tangent.atan(),
    };
    (half(centre_px) + half((side - 1) as f64 - centre_px)).to_degrees()
}

impl RigFile {
    /// A rig that names nothing but the lens: size of the raw image, `[fx, fy, cx, cy]` and coefficients.
    pub fn of_lens(
        model: LensModel,
        [width, height]: [usize; 2],
        [fx, fy, cx, cy]: [f64; 4],
        coefficients: Vec<f64>,
    ) -> Self {
        let (rate_hz, readout_ms) = (None, 0.0);
        Self { model, width, height, fx, fy, cx, cy, coefficients, rate_hz, readout_ms }
    }

    /// Checks the values and returns the rig; errors name `path`.
    pub fn rig_of(&self, path: &Path) -> Result<Rig, RigError> {
        self.rig().map_err(|source| RigError::Value { path: path.to_owned(), source })
    }

    /// Checks that a focal length gives a view that a lens of this model can have.
    fn check_view(
        &self,
        key: &str,
        focal_px: f64,
        centre_px: f64,
        side: usize,
    ) -> Result<(), ParameterError> {
        let is_fisheye = self.model == LensModel::Equidistant;
        let widest = if is_fisheye { WIDEST_DEG } else { WIDEST_PINHOLE_DEG };
        let view_deg = view_deg(focal_px, centre_px, side, is_fisheye);
        if (NARROWEST_DEG..=widest).contains(&view_deg) {
            return Ok(());
        }
        Err(ParameterError {
            key: key.to_owned(),
            value: focal_px.to_string(),
            allowed: format!(
                "a focal length in pixels with a field of view of {NARROWEST_DEG} to {widest}°, this one has {view_deg:.1}° on {side} px"
            ),
        })
    }

    fn rig(&self) -> Result<Rig, ParameterError> {
        check_range("width", self.width, SIDE_RANGE)?;
        check_range("height", self.height, SIDE_RANGE)?;
        check_range("fx", self.fx, FOCAL_RANGE)?;
        check_range("fy", self.fy, FOCAL_RANGE)?;
        // The view around the optical axis is used, so the axis must meet the image.
        check_range("cx", self.cx, 0.0..=(self.width - 1) as f64)?;
        check_range("cy", self.cy, 0.0..=(self.height - 1) as f64)?;
        self.check_view("fx", self.fx, self.cx, self.width)?;
        self.check_view("fy", self.fy, self.cy, self.height)?;
        for (i, &k) in self.coefficients.iter().enumerate() {
            check_range(&format!("coefficients[{i}]"), k, COEFFICIENT_RANGE)?;
        }
        if let Some(rate_hz) = self.rate_hz {
            check_range("rate_hz", rate_hz, RATE_RANGE)?;
        }
        check_range("readout_ms", self.readout_ms, READOUT_MS_RANGE)?;
        let Self { width, height, fx, fy, cx, cy, .. } = *self;
        let count_error = |allowed: &str| ParameterError {
            key: "coefficients".to_owned(),
            value: format!("{:?}", self.coefficients),
            allowed: allowed.to_owned(),
        };
        let lens = match self.model {
            LensModel::Pinhole if self.coefficients.is_empty() => Distortion::None,
            LensModel::Pinhole => return Err(count_error("none with model = \"pinhole\"")),
            LensModel::Radtan => Distortion::try_radtan(&self.coefficients)
                .filter(|lens| *lens != Distortion::None)
                .ok_or_else(|| count_error("4, 5 or 8 numbers: k1 k2 p1 p2 [k3 [k4 k5 k6]]"))?,
            LensModel::Equidistant => Distortion::try_equidistant(&self.coefficients)
                .ok_or_else(|| count_error("4 numbers: k1 k2 k3 k4"))?,
        };
        let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
        let camera = CameraModel::new(intrinsics, lens)
            .ok_or_else(|| count_error("finite numbers that belong to a camera"))?;
        Ok(Rig { camera, rate_hz: self.rate_hz, readout_ms: self.readout_ms })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::rectification::Rectification;

    #[test]
    fn every_shipped_rig_is_valid() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rigs");
        let mut names = Vec::new();
        for entry in std::fs::read_dir(&folder).expect("config/rigs") {
            let path = entry.expect("entry").path();
            let rig = Rig::read(&path).unwrap_or_else(|error| panic!("{error}"));
            assert!(rig.rate_hz.is_some(), "{} names its rate", path.display());
            Rectification::new(&rig.camera).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            names.push(path.file_name().expect("name").to_string_lossy().into_owned());
        }
        for name in ["tum-fr1.toml", "euroc-cam0.toml", "7scenes-kinect.toml", "simulator.toml"] {
            assert!(names.iter().any(|n| n == name), "{name} is missing");
        }
    }

    #[test]
    fn an_unusual_field_of_view_gets_a_remark_and_an_impossible_one_is_refused() {
        let rig = |model: &str, focal: f64| {
            let lens = if model == "equidistant" { "coefficients = [0, 0, 0, 0]\n" } else { "" };
            let text = format!(
                "model = \"{model}\"\nwidth = 640\nheight = 480\nfx = {focal}\nfy = {focal}\ncx = 320\ncy = 240\n{lens}"
            );
            Rig::from_toml(Path::new("x.toml"), &text).map_err(|error| error.to_string())
        };
        for (model, focal, degrees) in [
            ("pinhole", 500.0, None),
            ("pinhole", 60.0, None),
            ("pinhole", 5000.0, Some("7.3° x 5.5°")),
            ("equidistant", 200.0, Some("183.1° x 137.2°")),
        ] {
            let remark = rig(model, focal).unwrap().remark();
            assert_eq!(remark.is_some(), degrees.is_some(), "{model} {focal}: {remark:?}");
            assert!(remark.unwrap_or_default().contains(degrees.unwrap_or_default()));
        }
        for (model, focal) in [("pinhole", 50.0), ("pinhole", 90000.0), ("equidistant", 100.0)] {
            let error = rig(model, focal).unwrap_err();
            assert!(error.starts_with(&format!("x.toml: fx = {focal}: must be")), "{error}");
        }
    }

    #[test]
    fn focal_lengths_of_pixels_that_no_camera_has_get_a_remark() {
        let remark = |fx: f64, fy: f64| {
            let text = format!(
                "model = \"pinhole\"\nwidth = 640\nheight = 480\nfx = {fx}\nfy = {fy}\ncx = 320\ncy = 240\n"
            );
            Rig::from_toml(Path::new("x.toml"), &text).unwrap().remark()
        };
        for (fx, fy) in [(500.0, 500.0), (728.0, 500.0), (500.0, 728.0)] {
            assert_eq!(remark(fx, fy), None, "{fx} {fy}");
        }
        for (fx, fy, ratio) in
            [(5000.0, 500.0, "10.0"), (500.0, 5000.0, "10.0"), (250.0, 500.0, "2.0")]
        {
            let remark = remark(fx, fy).unwrap_or_default();
            assert!(remark.starts_with(&format!("fx = {fx} and fy = {fy} ")), "{remark}");
            assert!(remark.contains(&format!("one side {ratio} times as long")), "{remark}");
        }
    }

    #[test]
    fn a_bad_rig_names_file_key_value_and_range() {
        const GOOD: &str = "model = \"radtan\"\nwidth = 640\nheight = 480\nfx = 500\nfy = 500.0\n\
                            cx = 320\ncy = 240\ncoefficients = [0.1, 0.0, 0.0, 0.0]\n";
        let path = Path::new("rigs/mine.toml");
        assert!(Rig::from_toml(path, GOOD).is_ok());
        for (from, to, expected) in [
            ("width = 640", "width = 8", "rigs/mine.toml: width = 8: must be 16 to 8192"),
            ("height = 480", "height = 9000", "height = 9000: must be 16 to 8192"),
            ("height = 480", "height = -1", "rigs/mine.toml, line 3: "),
            ("fx = 500", "fx = 0", "fx = 0: must be 1 to 100000"),
            ("fy = 500.0", "fy = inf", "fy = inf: must be 1 to 100000"),
            ("cx = 320", "cx = 640", "cx = 640: must be 0 to 639"),
            ("cy = 240", "cy = -3", "cy = -3: must be 0 to 479"),
            ("[0.1, ", "[nan, ", "coefficients[0] = NaN: must be -1000 to 1000"),
            ("[0.1, ", "[", "coefficients = [0.0, 0.0, 0.0]: must be 4, 5 or 8 numbers"),
            ("radtan", "pinhole", "must be none with model = \"pinhole\""),
            ("radtan", "fov", "line 1: unknown variant `fov`, expected one of"),
            ("cy = 240", "", "missing field `cy`"),
            ("cy = 240", "cy = 240\nvignette = 1", "line 8: unknown field `vignette`"),
            ("cy = 240", "cy = 240\nreadout_ms = 201", "readout_ms = 201: must be 0 to 200"),
            ("cy = 240", "cy = 240\nreadout_ms = nan", "readout_ms = NaN: must be 0 to 200"),
            ("cy = 240", "cy 240", "line 7: "),
        ] {
            let text = GOOD.replace(from, to);
            let message = Rig::from_toml(path, &text).expect_err(expected).to_string();
            assert!(message.contains(expected), "{message}");
            assert!(message.starts_with("rigs/mine.toml") && !message.contains('\n'), "{message}");
        }
        let equidistant = GOOD.replace("radtan", "equidistant").replace("0.0]", "0.0, 0.0]");
        let message = Rig::from_toml(path, &equidistant).expect_err("five").to_string();
        assert!(message.contains("4 numbers: k1 k2 k3 k4"), "{message}");
    }
}
