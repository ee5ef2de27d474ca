//! The `sensor.yaml` of a EuRoC camera: lens, intrinsics, and the camera's pose on the body.
//!
//! Only the part of YAML that these files use is read: `key: value`, lists in brackets, one level of keys below a key.
//! Anything else is an error that names its line, never a guess.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::capture::listing::{Row, read_text, rows};
use crate::capture::rig::{LensModel, Rig, RigFile, side};
use crate::capture::source_error::SourceError;
use crate::slam::geometry::se3::SE3;

/// Largest deviation of the rotation of `T_BS` from orthonormal: files are written with few digits.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Contents of a camera's `sensor.yaml`.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorYaml {
    /// Lens, intrinsics and rate.
    pub rig: Rig,
    /// `T_BS`: pose of the camera on the body that the ground truth describes.
    pub body_from_camera: SE3,
}

/// A value with the line of its key.
struct Entry<'a> {
    row: Row<'a>,
    value: String,
}

/// Reads the `sensor.yaml` at `path`.
pub fn read(path: &Path) -> Result<SensorYaml, SourceError> {
    parse(path, &read_text(path)?)
}

/// Reads the text of a `sensor.yaml` that came from `path`.
pub fn parse(path: &Path, text: &str) -> Result<SensorYaml, SourceError> {
    let entries = read_entries(path, text)?;
    let get = |key: &str| {
        entries.get(key).ok_or_else(|| SourceError::Line {
            path: path.to_owned(),
            line: 1,
            problem: format!("the key `{key}` is missing; use the file of the original recording"),
        })
    };
    let model = get("camera_model")?;
    if model.value != "pinhole" {
        let problem = format!("camera_model is `{}`; only `pinhole` is supported", model.value);
        return Err(model.row.error(problem));
    }
    let coefficients = get("distortion_coefficients")?.list()?;
    let lens = get("distortion_model")?;
    let model = match lens.value.as_str() {
        "radial-tangential" | "radtan" => LensModel::Radtan,
        "equidistant" => LensModel::Equidistant,
        "none" => LensModel::Pinhole,
        other => {
            return Err(lens.row.error(format!(
                "distortion_model is `{other}`; supported are radial-tangential, equidistant, none"
            )));
        }
    };
    let [fx, fy, cx, cy] = get("intrinsics")?.numbers()?;
    let [width, height] = get("resolution")?.numbers()?.map(side);
    let rate_hz = entries.get("rate_hz").map(|entry| entry.row.number(&entry.value)).transpose()?;
    let lens = RigFile::of_lens(model, [width, height], [fx, fy, cx, cy], coefficients);
    let file = RigFile { rate_hz, ..lens };
    let rig = file.rig_of(path)?;
    let transform = get("T_BS.data")?;
    let body_from_camera = rigid_from_rows(&transform.numbers()?).ok_or_else(|| {
        transform.row.error("T_BS is not a rigid transform: a rotation, a translation, 0 0 0 1")
    })?;
    Ok(SensorYaml { rig, body_from_camera })
}

/// Reads all entries by key, `outer.inner` below a key.
fn read_entries<'a>(
    path: &'a Path,
    text: &'a str,
) -> Result<BTreeMap<String, Entry<'a>>, SourceError> {
    let mut entries: BTreeMap<String, Entry<'a>> = BTreeMap::new();
    let mut outer = String::new();
    let mut open_list: Option<(String, Entry<'a>)> = None;
    for row in rows(path, text) {
        // Drops a comment after a value; none of these files has a `#` inside a value.
        let content = row.text.split('#').next().unwrap_or_default().trim();
        if content.starts_with('%') || content == "---" || content.is_empty() {
            continue;
        }
        let (key, entry) = match open_list.take() {
            Some((key, mut entry)) => {
                entry.value.push_str(content);
                (key, entry)
            }
            None => {
                let (key, value) = content
                    .split_once(':')
                    .ok_or_else(|| row.error("is not `key: value`; remove it"))?;
                let key = key.trim();
                let key = if row.is_indented { format!("{outer}.{key}") } else { key.to_owned() };
                if !row.is_indented {
                    outer.clone_from(&key);
                }
                (key, Entry { row, value: value.trim().to_owned() })
            }
        };
        if entry.value.starts_with('[') && !entry.value.ends_with(']') {
            open_list = Some((key, entry));
        } else if let Some(twice) = entries.insert(key, entry) {
            return Err(row.error(format!("repeats the key of `{}`", twice.row.text)));
        }
    }
    match open_list {
        Some((_, entry)) => Err(entry.row.error("its list is not closed with `]`")),
        None => Ok(entries),
    }
}

impl Entry<'_> {
    /// The numbers of a list in brackets.
    fn list(&self) -> Result<Vec<f64>, SourceError> {
        let inner = self.value.strip_prefix('[').and_then(|rest| rest.strip_suffix(']'));
        let inner = inner.ok_or_else(|| self.row.error("needs a list: [number, …]"))?;
        let fields = inner.split(',').map(str::trim).filter(|field| !field.is_empty());
        fields.map(|field| self.row.number(field)).collect()
    }

    /// The numbers of a list of known length.
    fn numbers<const COUNT: usize>(&self) -> Result<[f64; COUNT], SourceError> {
        self.list()?.try_into().map_err(|numbers: Vec<f64>| {
            self.row.error(format!("needs {COUNT} numbers, has {}", numbers.len()))
        })
    }
}

/// Returns a rigid transform from the rows of its 4×4 matrix; `None` if it is not rigid.
fn rigid_from_rows(m: &[f64; 16]) -> Option<SE3> {
    let &[a, b, c, x, d, e, f, y, g, h, i, z, 0.0, 0.0, 0.0, 1.0] = m else { return None };
    let matrix = Matrix3::new(a, b, c, d, e, f, g, h, i);
    let off = (matrix * matrix.transpose() - Matrix3::identity()).norm();
    let is_rotation = off < ROTATION_TOLERANCE && matrix.determinant() > 0.0;
    is_rotation.then(|| SE3 {
        rotation: UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix)),
        translation: Vector3::new(x, y, z),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::camera_model::Distortion;

    /// The file of EuRoC's first recording.
    const EUROC: &str = "%YAML:1.0
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
";

    fn read_back(text: &str) -> Result<SensorYaml, SourceError> {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("sensor.yaml");
        std::fs::write(&path, text).expect("written");
        read(&path)
    }

    #[test]
    fn the_original_file_is_read() {
        let sensor = read_back(EUROC).expect("valid");
        let raw = sensor.rig.camera.intrinsics();
        assert_eq!((raw.width, raw.height, raw.fx, raw.cy), (752, 480, 458.654, 248.375));
        let lens = Distortion::RadTan4([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]);
        assert_eq!(sensor.rig.camera.distortion(), &lens);
        assert_eq!(sensor.rig.rate_hz, Some(20.0));
        // The camera's x axis is the body's y axis, to within the mounting.
        let x_axis = sensor.body_from_camera.rotation * Vector3::x();
        assert!((x_axis - Vector3::new(0.0148655, 0.9995572, -0.0257744)).norm() < 1e-6);
        assert_eq!(sensor.body_from_camera.translation.y, -0.064676986768);
    }

    #[test]
    fn errors_name_the_line() {
        for (from, to, expected) in [
            ("resolution: [752, 480]", "resolution: [752]", "line 17: needs 2 numbers, has 1"),
            ("[752, 480]", "[752, 4.5]", "height = 0: must be 16 to 8192"),
            ("radial-tangential", "double-sphere", "line 20: distortion_model is `double-sphere`"),
            ("camera_model: pinhole", "camera_model: omni", "line 18: camera_model is `omni`"),
            ("458.654", "nan", "line 19: `nan` is not a finite number"),
            ("intrinsics:", "intrinsic:", "the key `intrinsics` is missing"),
            ("0.999557249008", "0.5", "line 10: T_BS is not a rigid transform"),
            ("76187114e-05]", "76187114e-05", "line 21: its list is not closed"),
            ("rate_hz: 20", "rate_hz: 20\nrate_hz: 30", "repeats the key of `rate_hz: 20`"),
            ("rate_hz: 20", "rate_hz 20", "line 16: is not `key: value`"),
        ] {
            let message = read_back(&EUROC.replace(from, to)).expect_err(expected).to_string();
            assert!(message.contains(expected), "{message}");
            assert!(!message.contains('\n'), "{message}");
        }
    }
}
