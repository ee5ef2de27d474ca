//! Recordings in the layout of TUM RGB-D: `rgb.txt`, `depth.txt`, `groundtruth.txt`, `camera.txt`.

use std::path::{Path, PathBuf};

use crate::capture::listing::{read_text, rows};
use crate::capture::recording::{Contents, ListedImage, Recording};
use crate::capture::rig::Rig;
use crate::capture::source_error::SourceError;
use crate::slam::trajectory::StampedPose;

/// The list of the images, by which the layout is known.
pub const FRAME_LIST: &str = "rgb.txt";

/// The camera of a folder, where no rig is named: `camera.txt`, see [`Rig::read_camera_txt`].
pub const CAMERA_FILE: &str = "camera.txt";

/// Opens the recording in `folder`; without `rig` its `camera.txt` serves. `depth.txt` and
/// `groundtruth.txt` may be missing.
pub fn open(folder: &Path, rig: Option<&Path>) -> Result<Recording, SourceError> {
    let frame_list = folder.join(FRAME_LIST);
    let frames = read_images(folder, &frame_list)?;
    let (rig, rig_path) = read_rig(folder, rig)?;
    let depth_list = folder.join("depth.txt");
    let depths = if depth_list.exists() { read_images(folder, &depth_list)? } else { Vec::new() };
    let pose_list = folder.join("groundtruth.txt");
    let ground_truth = if pose_list.exists() { read_trajectory(&pose_list)? } else { Vec::new() };
    let contents = Contents { frames, depths, ground_truth };
    Recording::new(contents, &rig, rig_path, frame_list)
}

/// The camera that the folder itself brings, and where it says so; `None` where it does not.
pub fn own_rig(folder: &Path) -> Option<(Rig, PathBuf)> {
    let path = folder.join(CAMERA_FILE);
    Some((Rig::read_camera_txt(&path).ok()?, path))
}

/// The rig that is named, otherwise the folder's `camera.txt`; with where it was read.
pub fn read_rig(folder: &Path, rig: Option<&Path>) -> Result<(Rig, PathBuf), SourceError> {
    if let Some(path) = rig {
        return Ok((Rig::read(path)?, path.to_owned()));
    }
    let path = folder.join(CAMERA_FILE);
    if !path.exists() {
        return Err(SourceError::NoRig { folder: folder.to_owned() });
    }
    Ok((Rig::read_camera_txt(&path)?, path))
}

/// Reads a list of `timestamp filename` lines; file names are relative to `folder`.
fn read_images(folder: &Path, list: &Path) -> Result<Vec<ListedImage>, SourceError> {
    let text = read_text(list)?;
    let mut images: Vec<ListedImage> = Vec::new();
    for row in rows(list, &text) {
        let (stamp, name) = row.text().split_once(char::is_whitespace).ok_or_else(|| {
            row.error("needs `timestamp filename`; complete the line or remove it")
        })?;
        let nanos = row.seconds(stamp)?;
        row.check_after(images.last().map(|image| image.nanos), nanos)?;
        let path = folder.join(name.trim_start());
        images.push(ListedImage { nanos, path, exposure_nanos: 0 });
    }
    Ok(images)
}

/// Reads a trajectory of `timestamp tx ty tz qx qy qz qw` lines, `world_from_camera`.
pub fn read_trajectory(list: &Path) -> Result<Vec<StampedPose>, SourceError> {
    let text = read_text(list)?;
    let mut poses: Vec<StampedPose> = Vec::new();
    for row in rows(list, &text) {
        let fields: Vec<&str> = row.text().split_whitespace().collect();
        let [stamp, numbers @ ..] = &fields[..] else { continue };
        let nanos = row.seconds(stamp)?;
        let numbers =
            numbers.iter().map(|n| row.number(n)).collect::<Result<Vec<f64>, SourceError>>()?;
        let &[tx, ty, tz, qx, qy, qz, qw] = &numbers[..] else {
            return Err(row.error("needs the eight numbers `timestamp tx ty tz qx qy qz qw`"));
        };
        row.check_after(poses.last().map(|pose| pose.nanos), nanos)?;
        let world_from_camera = row.pose([qx, qy, qz, qw], [tx, ty, tz])?;
        poses.push(StampedPose { nanos, world_from_camera });
    }
    Ok(poses)
}
