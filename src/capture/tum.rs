//! Recordings in the layout of TUM RGB-D: `rgb.txt`, `depth.txt`, `groundtruth.txt`, `camera.txt`.

use std::path::{Path, PathBuf};

use crate::capture::listing::read_list;
use crate::capture::recording::{Contents, ListedImage, Recording};
use crate::capture::rig::Rig;
use crate::capture::source_error::SourceError;
use crate::slam::trajectory::StampedPose;

/// The list of the images, by which the layout is recognised.
pub const FRAME_LIST: &str = "rgb.txt";

/// The camera of a folder, if no rig is named: `camera.txt`, see [`Rig::read_camera_txt`].
pub const CAMERA_FILE: &str = "camera.txt";

/// Opens the recording in `folder`; without `rig`, its `camera.txt` is used. `depth.txt` and `groundtruth.txt` may be
/// missing.
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

/// Returns the folder's own camera and the path of its file; `None` if it cannot be read.
pub fn own_rig(folder: &Path) -> Option<(Rig, PathBuf)> {
    let path = folder.join(CAMERA_FILE);
    Some((Rig::read_camera_txt(&path).ok()?, path))
}

/// Reads the named rig, otherwise the folder's `camera.txt`; also returns the path of the file.
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
    read_list(list, |row| {
        let (stamp, name) = row.text.split_once(char::is_whitespace).ok_or_else(|| {
            row.error("needs `timestamp filename`; complete the line or remove it")
        })?;
        let path = folder.join(name.trim_start());
        let nanos = row.seconds(stamp)?;
        Ok((nanos, ListedImage { nanos, path, exposure_nanos: 0 }))
    })
}

/// Reads a trajectory of `timestamp tx ty tz qx qy qz qw` lines, `world_from_camera`.
pub fn read_trajectory(list: &Path) -> Result<Vec<StampedPose>, SourceError> {
    read_list(list, |row| {
        let fields: Vec<&str> = row.text.split_whitespace().collect();
        let [stamp, tx, ty, tz, qx, qy, qz, qw] = fields[..] else {
            return Err(row.error("needs the eight numbers `timestamp tx ty tz qx qy qz qw`"));
        };
        let nanos = row.seconds(stamp)?;
        let world_from_camera = row.pose([qx, qy, qz, qw], [tx, ty, tz])?;
        Ok((nanos, StampedPose { nanos, world_from_camera }))
    })
}
