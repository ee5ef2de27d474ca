//! The rig of a `sensor_msgs/CameraInfo`.

use std::path::Path;

use crate::capture::bag::message::CameraInfo;
use crate::capture::rig::{LensModel, Rig, RigFile};
use crate::capture::ros_topic::is_rectified;

/// Maximum number of non-zero lens coefficients: those of the rational model after the eighth describe a thin prism and
/// a tilt, which no rig has.
const MAX_COEFFICIENTS: usize = 8;

/// Returns the rig of the camera of the images on `topic`, or the reason why there is none.
pub fn rig_of(camera: &CameraInfo, topic: &str, path: &Path) -> Result<Rig, String> {
    if camera.binning_x > 1 || camera.binning_y > 1 {
        return Err("its images are binned".to_owned());
    }
    if camera.roi != [0; 4] && camera.roi[2..] != [camera.height, camera.width] {
        return Err("its images cover only part of the sensor".to_owned());
    }
    let coefficients = coefficients(camera)?;
    let is_fisheye = matches!(camera.distortion_model.as_str(), "equidistant" | "fisheye");
    let [fx, _, cx, _, fy, cy, ..] = camera.k;
    let [px, _, pcx, _, _, py, pcy, ..] = camera.p;
    let (model, coefficients, [fx, fy, cx, cy]) = match (is_rectified(topic), is_fisheye) {
        (true, _) => (LensModel::Pinhole, Vec::new(), [px, py, pcx, pcy]),
        (false, true) => (LensModel::Equidistant, coefficients, [fx, fy, cx, cy]),
        (false, false) if coefficients.iter().all(|k| *k == 0.0) => {
            (LensModel::Pinhole, Vec::new(), [fx, fy, cx, cy])
        }
        (false, false) => (LensModel::Radtan, coefficients, [fx, fy, cx, cy]),
    };
    let (width, height) = (camera.width as usize, camera.height as usize);
    let file = RigFile::of_lens(model, [width, height], [fx, fy, cx, cy], coefficients);
    file.rig_of(path).map_err(|error| error.to_string())
}

/// The coefficients in OpenCV's order, as many as a rig's model has.
fn coefficients(camera: &CameraInfo) -> Result<Vec<f64>, String> {
    let d = &camera.d[..];
    let name = camera.distortion_model.as_str();
    let known = match (name, d.len()) {
        ("plumb_bob", 0 | 4 | 5) | ("equidistant" | "fisheye", 4) => d,
        ("equidistant" | "fisheye", 5) if d[4] == 0.0 => &d[..4],
        ("rational_polynomial", 8) => d,
        ("rational_polynomial", 12 | 14) if d[MAX_COEFFICIENTS..].iter().all(|k| *k == 0.0) => {
            &d[..MAX_COEFFICIENTS]
        }
        // Drivers without a calibration leave the model empty.
        ("", _) if d.iter().all(|k| *k == 0.0) => &[],
        _ => {
            let name: String = name.chars().take(40).collect();
            return Err(format!(
                "the lens `{name}` with {} coefficients is not supported (plumb_bob with 4 or 5, rational_polynomial with 8, \
                 equidistant with 4)",
                d.len()
            ));
        }
    };
    Ok(known.to_vec())
}
