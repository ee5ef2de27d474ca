//! Recognises calibrations of other tools, which are easily named in place of a rig.

/// A word that only files of one tool have, the tool, and where a rig's values are in them.
const TOOLS: [(&str, &str, &str); 5] = [
    (
        "!!opencv-matrix",
        "OpenCV",
        "the rows of its camera matrix are fx 0 cx, 0 fy cy, 0 0 1, and its lens is model = \"radtan\"",
    ),
    (
        "distortion_coeffs:",
        "Kalibr",
        "its intrinsics are fx, fy, cx, cy, and its models have the same names",
    ),
    (
        "T_BS:",
        "EuRoC (sensor.yaml)",
        "its intrinsics are fx, fy, cx, cy, and radial-tangential is model = \"radtan\"",
    ),
    (
        "distortion_model:",
        "ROS (camera_info)",
        "the rows of its camera matrix (K) are fx 0 cx, 0 fy cy, 0 0 1; plumb_bob and rational_polynomial are model = \"radtan\"",
    ),
    (
        "Camera.fx:",
        "ORB-SLAM",
        "Camera.k1, k2, p1, p2 and k3 are the coefficients of model = \"radtan\"",
    ),
];

/// Names that other tools give to our lens models.
const LENSES: [(&str, &str); 5] = [
    ("plumb_bob", "radtan"),
    ("rational_polynomial", "radtan"),
    ("radial-tangential", "radtan"),
    ("equi", "equidistant"),
    ("fisheye", "equidistant"),
];

/// The tool that wrote a calibration, and where a rig's values are in it.
pub(super) fn tool(text: &str) -> Option<(&'static str, &'static str)> {
    let known = TOOLS.iter().find(|(word, ..)| text.contains(word))?;
    Some((known.1, known.2))
}

/// The parser's `problem` with a rig, with our name of a lens model that it does not know by another tool's.
pub(super) fn with_own_lens(problem: String) -> String {
    let is_named = |(name, _): &&(&str, &str)| problem.contains(&format!("variant `{name}`"));
    match LENSES.iter().find(is_named) {
        Some((name, own)) => format!("{problem}; {name} is model = \"{own}\""),
        None => problem,
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use crate::capture::rig::Rig;

    #[test]
    fn calibrations_of_other_tools_are_recognised() {
        let ros = "image_width: 640\nimage_height: 480\ncamera_name: narrow\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
                   data: [500, 0, 320, 0, 500, 240, 0, 0, 1]\ndistortion_model: plumb_bob\n";
        let kalibr = "cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: [0.1, 0, 0, 0]\n  \
                      distortion_model: radtan\n  intrinsics: [500, 500, 320, 240]\n";
        let euroc = "sensor_type: camera\nT_BS:\n  cols: 4\ndistortion_model: radial-tangential\n";
        let opencv = "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n";
        for (text, tool, word) in [
            (ros, "of ROS (camera_info), not a rig", "plumb_bob and rational_polynomial are model"),
            (kalibr, "of Kalibr, not a rig", "same names"),
            (euroc, "of EuRoC (sensor.yaml), not a rig", "radial-tangential is model"),
            (opencv, "of OpenCV, not a rig", "0 fy cy"),
            ("%YAML:1.0\nCamera.fx: 500.0\n", "of ORB-SLAM, not a rig", "Camera.k1"),
        ] {
            let error = Rig::from_toml(Path::new("x.yaml"), text).unwrap_err().to_string();
            assert!(error.starts_with("x.yaml: this is a calibration "), "{error}");
            assert!(error.contains(tool) && error.contains(word), "{error}");
            assert!(error.contains("copy one from config/rigs"), "{error}");
        }
        let error = Rig::from_toml(Path::new("x.yaml"), "width: 640\n").unwrap_err().to_string();
        assert!(error.starts_with("x.yaml, line 1: "), "{error}");
    }

    #[test]
    fn a_lens_by_the_name_of_another_tool_is_translated() {
        for (name, own) in [("plumb_bob", "radtan"), ("fisheye", "equidistant")] {
            let text = format!("model = \"{name}\"\nwidth = 640\n");
            let error = Rig::from_toml(Path::new("x.toml"), &text).unwrap_err().to_string();
            assert!(error.starts_with("x.toml, line 1: unknown variant"), "{error}");
            assert!(error.ends_with(&format!("; {name} is model = \"{own}\"")), "{error}");
        }
    }
}
