//! A rig file from ROS's description of a camera (`sensor_msgs/CameraInfo`).

use std::path::Path;

use semidense::capture::rig::Rig;
use semidense::capture::rig_error::RigError;

use crate::ros::message::CameraInfo;

/// Why a CameraInfo gives no rig.
#[derive(Debug, thiserror::Error)]
pub enum CameraRigError {
    /// The camera is not calibrated.
    #[error("the camera is not calibrated: its CameraInfo has no focal length")]
    Uncalibrated,
    /// The images differ from those that were calibrated.
    #[error(
        "its images are binned or cover only part of the sensor, which is not supported; name a rig for them with --rig"
    )]
    Part,
    /// An unsupported lens model.
    #[error(
        "its lens model `{0}` is not supported; supported are plumb_bob, rational_polynomial, equidistant and fisheye"
    )]
    Model(String),
    /// Invalid values.
    #[error(transparent)]
    Rig(#[from] RigError),
}

/// The text of a rig file, validated; `topic` is the origin of `info`.
pub fn rig_text(
    info: &CameraInfo,
    topic: &str,
    is_rectified: bool,
) -> Result<String, CameraRigError> {
    let roi = &info.roi;
    let is_part = (roi.width != 0 && roi.width != info.width)
        || (roi.height != 0 && roi.height != info.height);
    if info.binning_x > 1 || info.binning_y > 1 || is_part {
        return Err(CameraRigError::Part);
    }
    let has_lens = info.d.iter().any(|coefficient| *coefficient != 0.0);
    let (fx, fy, cx, cy) = match is_rectified {
        true => (info.p[0], info.p[5], info.p[2], info.p[6]),
        false => (info.k[0], info.k[4], info.k[2], info.k[5]),
    };
    if fx == 0.0 || fy == 0.0 {
        return Err(CameraRigError::Uncalibrated);
    }
    let model = match info.distortion_model.as_str() {
        _ if is_rectified => "pinhole",
        // Without coefficients it still is no pinhole.
        "equidistant" | "fisheye" => "equidistant",
        _ if !has_lens => "pinhole",
        "plumb_bob" | "rational_polynomial" => "radtan",
        other => return Err(CameraRigError::Model(other.to_owned())),
    };
    // A rig has no coefficients of a thin prism and a tilt, which follow.
    let most = match model {
        "pinhole" => 0,
        "equidistant" => 4,
        _ => 8,
    };
    let fits = model == "pinhole" || info.d.iter().skip(most).all(|further| *further == 0.0);
    let coefficients = if fits { &info.d[..info.d.len().min(most)] } else { &info.d[..] };
    let numbers: Vec<String> =
        coefficients.iter().map(|number| format!("{number:?}").to_lowercase()).collect();
    let text = format!(
        "# From the CameraInfo on {topic}.\nmodel = \"{model}\"\nwidth = {}\nheight = {}\nfx = {fx:?}\nfy = {fy:?}\n\
         cx = {cx:?}\ncy = {cy:?}\ncoefficients = [{}]\n",
        info.width,
        info.height,
        numbers.join(", ")
    );
    Rig::from_toml(Path::new(topic), &text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::message::{Header, RegionOfInterest};
    use semidense::slam::geometry::camera_model::Distortion;

    fn info(model: &str, d: &[f64]) -> CameraInfo {
        CameraInfo {
            header: Header::default(),
            height: 480,
            width: 640,
            distortion_model: model.to_owned(),
            d: d.to_vec(),
            k: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0],
            r: [0.0; 9],
            p: [400.0, 0.0, 310.0, 0.0, 0.0, 401.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            binning_x: 0,
            binning_y: 0,
            roi: RegionOfInterest::default(),
        }
    }

    fn rig(info: &CameraInfo, is_rectified: bool) -> Result<Rig, CameraRigError> {
        let text = rig_text(info, "/c/camera_info", is_rectified)?;
        Ok(Rig::from_toml(Path::new("x"), &text)?)
    }

    #[test]
    fn every_lens_model_of_ros_is_converted() {
        let plain = rig(&info("plumb_bob", &[0.0; 5]), false).unwrap();
        assert_eq!(*plain.camera.distortion(), Distortion::None);
        assert_eq!(plain.camera.intrinsics().fy, 501.0);
        let five = rig(&info("plumb_bob", &[-0.1, 0.02, 0.001, 0.0, 0.0]), false).unwrap();
        assert!(matches!(five.camera.distortion(), Distortion::RadTan5(_)));
        rig(&info("rational_polynomial", &[0.1, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0]), false)
            .unwrap();
        let fisheye = rig(&info("equidistant", &[0.0, 0.01, 0.0, 0.0]), false).unwrap();
        assert!(matches!(fisheye.camera.distortion(), Distortion::Equidistant(_)));
        let ideal = rig(&info("fisheye", &[0.0; 5]), false).unwrap();
        assert!(matches!(ideal.camera.distortion(), Distortion::Equidistant(_)));
        rig(&info("rational_polynomial", &[&[0.1; 8][..], &[0.0; 6]].concat()), false).unwrap();
        let rectified = rig(&info("plumb_bob", &[-0.1, 0.02, 0.0, 0.0, 0.0]), true).unwrap();
        assert_eq!(*rectified.camera.distortion(), Distortion::None);
        assert_eq!(rectified.camera.intrinsics().cx, 310.0);
    }

    #[test]
    fn errors_explain_why_there_is_no_calibration() {
        let words = |info: CameraInfo| rig(&info, false).unwrap_err().to_string();
        let none = CameraInfo { k: [0.0; 9], ..info("plumb_bob", &[]) };
        assert!(words(none).contains("not calibrated"));
        assert!(words(info("thin_prism", &[1.0])).contains("`thin_prism`"));
        assert!(words(CameraInfo { binning_x: 2, ..info("plumb_bob", &[]) }).contains("binned"));
        assert!(words(info("plumb_bob", &[f64::NAN; 5])).contains("coefficients"));
        assert!(words(CameraInfo { width: 0, ..info("plumb_bob", &[]) }).contains("width"));
    }
}
