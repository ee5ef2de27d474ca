//! Writes a sequence as a dataset in the layout of TUM RGB-D or EuRoC, with depth and poses.
//!
//! All files are written to a folder next to the target, which replaces the target once it is complete.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::capture::image_file::{
    DEPTH_STEPS_PER_METRE, ImageFileError, write_depth_png, write_gray_png,
};
use crate::slam::geometry::camera_model::{CameraModel, Distortion};
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::trajectory::StampedPose;

/// Where the files of a dataset are and how they are named.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DatasetLayout {
    /// `rgb/`, `depth/`, `rgb.txt`, `depth.txt`, `groundtruth.txt`, `camera.txt`.
    Tum,
    /// `mav0/cam0/`, `mav0/depth0/`, `mav0/state_groundtruth_estimate0/`.
    Euroc,
}

/// Why a dataset cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The target holds files that would be lost.
    #[error("{}: is not empty; name another folder, or replace the dataset with --force", folder.display())]
    NotEmpty {
        /// The target.
        folder: PathBuf,
    },
    /// The folder to be replaced does not look like a dataset.
    #[error("{}: is not a dataset, so it is not replaced; name another folder", folder.display())]
    NotADataset {
        /// The target.
        folder: PathBuf,
    },
    /// TUM's `camera.txt` and EuRoC's `sensor.yaml` cannot describe such a lens.
    #[error("the layout has no equidistant lens; write the dataset with a radtan lens")]
    Lens,
    /// A file or folder cannot be written.
    #[error("{}: cannot be written: {source}; check space and permissions", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// An image cannot be written.
    #[error(transparent)]
    Image(#[from] ImageFileError),
}

/// A dataset being written; [`DatasetWriter::finish`] moves it into place, dropping it earlier removes what was
/// written.
#[derive(Debug)]
pub struct DatasetWriter {
    layout: DatasetLayout,
    target: PathBuf,
    partial: PathBuf,
    camera: CameraModel,
    rate_hz: f64,
    is_finished: bool,
}

/// Pose of the camera on the body of a EuRoC dataset: the optical axis along the body's x, the image's right along −y,
/// and a lever arm, so that a reader that ignores it is detected.
fn body_from_camera() -> SE3 {
    let axes = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    SE3 {
        rotation: UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)),
        translation: Vector3::new(0.05, 0.0, 0.02),
    }
}

impl DatasetWriter {
    /// Starts a dataset of raw images of `camera` that will be placed at `target`. A target that is not empty is
    /// refused; with `replace` an existing dataset is replaced, anything else still refused.
    pub fn create(
        target: &Path,
        layout: DatasetLayout,
        camera: CameraModel,
        rate_hz: f64,
        replace: bool,
    ) -> Result<Self, DatasetError> {
        if matches!(camera.distortion(), Distortion::Equidistant(_)) {
            return Err(DatasetError::Lens);
        }
        check_target(target, replace)?;
        // `.` and a link cannot be renamed over: the folder itself can.
        let target = &target.canonicalize().unwrap_or_else(|_| target.to_owned());
        let writer = Self {
            layout,
            target: target.clone(),
            partial: beside(target, "partial"),
            camera,
            rate_hz,
            is_finished: false,
        };
        for folder in writer.folders() {
            fs::create_dir_all(&folder).map_err(failed(&folder))?;
        }
        Ok(writer)
    }

    /// Writes the raw image and depth (metres, 0 where none) of one frame. May be called from several threads. Depths
    /// beyond 13 m do not fit 16 bits and are written as 0.
    pub fn write_frame(
        &self,
        nanos: i64,
        pixels: &[u8],
        depth: &Image<f32>,
    ) -> Result<(), DatasetError> {
        let (width, height) = (depth.width(), depth.height());
        let name = self.image_name(nanos);
        let [image_path, depth_path] = self.folders().map(|folder| folder.join(&name));
        write_gray_png(&image_path, width, height, pixels)?;
        let steps: Vec<u16> = depth.pixels().iter().map(|&z| depth_steps(z)).collect();
        Ok(write_depth_png(&depth_path, width, height, &steps)?)
    }

    /// Writes lists, calibration and the poses of all frames, and moves the dataset into place.
    pub fn finish(mut self, ground_truth: &[StampedPose]) -> Result<(), DatasetError> {
        match self.layout {
            DatasetLayout::Tum => self.write_tum_lists(ground_truth)?,
            DatasetLayout::Euroc => self.write_euroc_lists(ground_truth)?,
        }
        self.rename_into_place()?;
        self.is_finished = true;
        Ok(())
    }

    fn rename_into_place(&self) -> Result<(), DatasetError> {
        let old = beside(&self.target, "old");
        // Checked again: rendering takes time, and a folder filled meanwhile stays untouched.
        let had_one = is_dataset(&self.target);
        if had_one {
            fs::rename(&self.target, &old).map_err(failed(&old))?;
        }
        if let Err(source) = fs::rename(&self.partial, &self.target) {
            if had_one {
                // Restores the old dataset; the error that matters is the first one.
                let _ = fs::rename(&old, &self.target);
            }
            return Err(DatasetError::Write { path: self.target.clone(), source });
        }
        if had_one { fs::remove_dir_all(&old).map_err(failed(&old)) } else { Ok(()) }
    }

    /// Folders of the images and of the depth images.
    fn folders(&self) -> [PathBuf; 2] {
        let folders = match self.layout {
            DatasetLayout::Tum => ["rgb", "depth"],
            DatasetLayout::Euroc => ["mav0/cam0/data", "mav0/depth0/data"],
        };
        folders.map(|folder| self.partial.join(folder))
    }

    fn image_name(&self, nanos: i64) -> String {
        match self.layout {
            DatasetLayout::Tum => format!("{}.png", seconds(nanos)),
            DatasetLayout::Euroc => format!("{nanos}.png"),
        }
    }

    fn write_tum_lists(&self, poses: &[StampedPose]) -> Result<(), DatasetError> {
        for (list, folder, what) in
            [("rgb.txt", "rgb", "grey images"), ("depth.txt", "depth", "depth images, 5000 = 1 m")]
        {
            self.write_text(list, |file| {
                writeln!(file, "# {what}\n# timestamp filename")?;
                poses.iter().try_for_each(|pose| {
                    let name = self.image_name(pose.nanos);
                    writeln!(file, "{} {folder}/{name}", seconds(pose.nanos))
                })
            })?;
        }
        self.write_text("groundtruth.txt", |file| {
            writeln!(file, "# world_from_camera, exact\n# timestamp tx ty tz qx qy qz qw")?;
            poses.iter().try_for_each(|pose| {
                let t = pose.world_from_camera.translation;
                let [x, y, z, w] = pose.world_from_camera.quaternion_xyzw();
                writeln!(file, "{} {} {} {} {x} {y} {z} {w}", seconds(pose.nanos), t.x, t.y, t.z)
            })
        })?;
        self.write_text("camera.txt", |file| {
            let k = self.camera.intrinsics();
            write!(file, "{} {} {} {} {} {}", k.fx, k.fy, k.cx, k.cy, k.width, k.height)?;
            for coefficient in self.camera.distortion().coefficients() {
                write!(file, " {coefficient}")?;
            }
            writeln!(file)
        })
    }

    fn write_euroc_lists(&self, poses: &[StampedPose]) -> Result<(), DatasetError> {
        for sensor in ["cam0", "depth0"] {
            self.write_text(&format!("mav0/{sensor}/data.csv"), |file| {
                writeln!(file, "#timestamp [ns],filename")?;
                poses.iter().try_for_each(|pose| {
                    writeln!(file, "{},{}", pose.nanos, self.image_name(pose.nanos))
                })
            })?;
        }
        self.write_text("mav0/cam0/sensor.yaml", |file| self.write_sensor_yaml(file))?;
        let folder = "mav0/state_groundtruth_estimate0";
        let path = self.partial.join(folder);
        fs::create_dir_all(&path).map_err(failed(&path))?;
        self.write_text(&format!("{folder}/data.csv"), |file| write_euroc_states(file, poses))
    }

    fn write_sensor_yaml(&self, file: &mut BufWriter<File>) -> io::Result<()> {
        let k = self.camera.intrinsics();
        let (r, t) = (body_from_camera().rotation_matrix(), body_from_camera().translation);
        let none = [0.0; 4];
        let coefficients = match self.camera.distortion().coefficients() {
            [] => &none[..],
            some => some,
        };
        let list = |numbers: &[f64]| {
            numbers.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
        };
        let row = |i: usize| list(&[r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]]);
        writeln!(file, "%YAML:1.0")?;
        writeln!(file, "sensor_type: camera\ncomment: simulated camera\n")?;
        writeln!(file, "# Pose of the camera on the body: p_body = T_BS p_camera.")?;
        writeln!(file, "T_BS:\n  cols: 4\n  rows: 4")?;
        writeln!(file, "  data: [{},\n         {},", row(0), row(1))?;
        writeln!(file, "         {},\n         0.0, 0.0, 0.0, 1.0]\n", row(2))?;
        writeln!(file, "rate_hz: {}", self.rate_hz)?;
        writeln!(file, "resolution: [{}, {}]", k.width, k.height)?;
        writeln!(file, "camera_model: pinhole")?;
        writeln!(file, "intrinsics: [{}] #fu, fv, cu, cv", list(&[k.fx, k.fy, k.cx, k.cy]))?;
        writeln!(file, "distortion_model: radial-tangential")?;
        writeln!(file, "distortion_coefficients: [{}]", list(coefficients))
    }

    fn write_text(
        &self,
        name: &str,
        write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
    ) -> Result<(), DatasetError> {
        let path = self.partial.join(name);
        let result = File::create(&path).and_then(|file| {
            let mut file = BufWriter::new(file);
            write(&mut file)?;
            file.flush()
        });
        result.map_err(failed(&path))
    }
}

impl Drop for DatasetWriter {
    fn drop(&mut self) {
        if !self.is_finished {
            // The error cannot be reported here; the name .partial explains a folder that remains.
            let _ = fs::remove_dir_all(&self.partial);
        }
    }
}

/// EuRoC's ground truth: pose and velocity of the body, biases zero.
fn write_euroc_states(file: &mut impl Write, poses: &[StampedPose]) -> io::Result<()> {
    writeln!(
        file,
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], \
         q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], \
         b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], \
         b_a_RS_S_z [m s^-2]"
    )?;
    let camera_from_body = body_from_camera().inverse();
    let bodies: Vec<SE3> =
        poses.iter().map(|pose| pose.world_from_camera * camera_from_body).collect();
    for (i, (pose, body)) in poses.iter().zip(&bodies).enumerate() {
        let (before, after) = (i.saturating_sub(1), (i + 1).min(poses.len() - 1));
        let elapsed_s = (poses[after].nanos - poses[before].nanos) as f64 * 1e-9;
        let moved = bodies[after].translation - bodies[before].translation;
        let v = if elapsed_s > 0.0 { moved / elapsed_s } else { Vector3::zeros() };
        let t = body.translation;
        let [x, y, z, w] = body.quaternion_xyzw();
        write!(file, "{},{},{},{},{w},{x},{y},{z}", pose.nanos, t.x, t.y, t.z)?;
        writeln!(file, ",{},{},{},0,0,0,0,0,0", v.x, v.y, v.z)?;
    }
    Ok(())
}

/// Refuses a target that holds anything that may not be replaced.
fn check_target(target: &Path, replace: bool) -> Result<(), DatasetError> {
    let entries = match fs::read_dir(target) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        other => other.map_err(failed(target))?,
    };
    let folder = target.to_owned();
    if entries.count() == 0 {
        return Ok(());
    }
    match (replace, is_dataset(target)) {
        (false, _) => Err(DatasetError::NotEmpty { folder }),
        (true, false) => Err(DatasetError::NotADataset { folder }),
        (true, true) => Ok(()),
    }
}

/// Whether a folder looks like one of the layouts.
fn is_dataset(folder: &Path) -> bool {
    folder.join("rgb.txt").is_file() || folder.join("mav0/cam0/data.csv").is_file()
}

/// A hidden name next to `target`, unique to this process.
fn beside(target: &Path, what: &str) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    target.with_file_name(format!(".{name}.{}.{what}", std::process::id()))
}

fn failed(path: &Path) -> impl FnOnce(io::Error) -> DatasetError {
    let path = path.to_owned();
    move |source| DatasetError::Write { path, source }
}

/// Converts a depth to steps of the 16-bit image, 0 if there is none or it does not fit.
fn depth_steps(depth_m: f32) -> u16 {
    let steps = (depth_m * DEPTH_STEPS_PER_METRE).round();
    if steps > 0.0 && steps <= f32::from(u16::MAX) { steps as u16 } else { 0 }
}

/// A stamp in seconds with all nine digits.
fn seconds(nanos: i64) -> String {
    const PER_SECOND: u64 = 1_000_000_000;
    let (sign, size) = (if nanos < 0 { "-" } else { "" }, nanos.unsigned_abs());
    format!("{sign}{}.{:09}", size / PER_SECOND, size % PER_SECOND)
}

#[cfg(test)]
mod tests;
