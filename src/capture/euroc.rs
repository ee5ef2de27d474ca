//! Recordings in the layout of EuRoC (ASL): `mav0/cam0` and `mav0/state_groundtruth_estimate0`.

use std::path::{Path, PathBuf};

use crate::capture::listing::read_list;
use crate::capture::recording::{Contents, ListedImage, Recording};
use crate::capture::rig::Rig;
use crate::capture::sensor_yaml;
use crate::capture::source_error::SourceError;
use crate::slam::geometry::se3::SE3;
use crate::slam::trajectory::StampedPose;

/// File with lens and mounting of the camera, below the recording's folder.
const SENSOR_FILE: &str = "cam0/sensor.yaml";

/// Opens the recording in `folder`, which is `mav0` or contains it. The lens is that of `cam0/sensor.yaml` unless `rig`
/// names another. The ground truth may be missing; it is the body's and is transformed to the camera by the `T_BS` of
/// `sensor.yaml`.
pub fn open(folder: &Path, rig: Option<&Path>) -> Result<Recording, SourceError> {
    let root = root_of(folder);
    let frame_list = frame_list(folder);
    let frames = read_frames(&root.join("cam0/data"), &frame_list)?;
    let sensor_path = root.join(SENSOR_FILE);
    let pose_list = root.join("state_groundtruth_estimate0/data.csv");
    let has_truth = pose_list.exists();
    // With a separate rig and no ground truth, the sensor's file is not needed.
    let sensor = match rig {
        Some(_) if !has_truth => None,
        _ => Some(sensor_yaml::read(&sensor_path)?),
    };
    let body_from_camera = sensor.as_ref().map_or_else(SE3::identity, |s| s.body_from_camera);
    let ground_truth =
        if has_truth { read_truth(&pose_list, &body_from_camera)? } else { Vec::new() };
    let (rig, rig_path) = match (rig, sensor) {
        (None, Some(sensor)) => (sensor.rig, sensor_path),
        (Some(path), _) => (Rig::read(path)?, path.to_owned()),
        (None, None) => return Err(SourceError::NoRig { folder: root }),
    };
    let contents = Contents { frames, depths: Vec::new(), ground_truth };
    Recording::new(contents, &rig, rig_path, frame_list)
}

/// Path of the image list of the recording in `folder`.
pub(super) fn frame_list(folder: &Path) -> PathBuf {
    root_of(folder).join("cam0/data.csv")
}

fn root_of(folder: &Path) -> PathBuf {
    let inner = folder.join("mav0");
    if inner.is_dir() { inner } else { folder.to_owned() }
}

/// Returns the camera of the recording's own `sensor.yaml` and the path of that file; `None` if it cannot be read.
pub fn own_rig(folder: &Path) -> Option<(Rig, PathBuf)> {
    let path = root_of(folder).join(SENSOR_FILE);
    Some((sensor_yaml::read(&path).ok()?.rig, path))
}

/// Path of the camera's `sensor.yaml` next to the folder of `pose_list`, if it exists.
pub fn sensor_beside(pose_list: &Path) -> Option<PathBuf> {
    // A bare file name is in a folder too.
    let pose_list = pose_list.canonicalize().ok()?;
    Some(pose_list.parent()?.parent()?.join(SENSOR_FILE)).filter(|path| path.is_file())
}

/// Reads the `timestamp [ns],filename` lines of a camera.
fn read_frames(images: &Path, list: &Path) -> Result<Vec<ListedImage>, SourceError> {
    read_list(list, |row| {
        let (stamp, name) =
            row.text.split_once(',').ok_or_else(|| row.error("needs `timestamp,filename`"))?;
        let path = images.join(name.trim());
        let nanos = row.nanos(stamp.trim())?;
        Ok((nanos, ListedImage { nanos, path, exposure_nanos: 0 }))
    })
}

/// Reads the body's poses, `timestamp, p x y z, q w x y z` and more, and returns the camera's.
fn read_truth(list: &Path, body_from_camera: &SE3) -> Result<Vec<StampedPose>, SourceError> {
    read_list(list, |row| {
        let fields: Vec<&str> = row.text.split(',').map(str::trim).collect();
        let [stamp, px, py, pz, qw, qx, qy, qz, ..] = fields[..] else {
            return Err(row.error("needs `timestamp,px,py,pz,qw,qx,qy,qz` and maybe more"));
        };
        let nanos = row.nanos(stamp)?;
        let world_from_camera = row.pose([qx, qy, qz, qw], [px, py, pz])? * *body_from_camera;
        Ok((nanos, StampedPose { nanos, world_from_camera }))
    })
}
