//! Reports the contents of a map folder.

use std::fs;
use std::io;
use std::path::Path;

use serde::Serialize;

use crate::service::map_folder::depth_file::MapDetail;
use crate::service::map_folder::manifest::VERSION;
use crate::service::map_folder::reading::{KEYFRAMES, Loaded};
use crate::service::results::ResultsParams;
use crate::service::results::full_points::write_full_points;
use crate::service::results::pcd::write_pcd;
use crate::service::results::ply::write_surface;
use crate::service::results::poses::keyframe_pose;
use crate::service::trajectory_file::write_trajectory;
use crate::slam::fusion::fuse;
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;
use crate::slam::trajectory::StampedPose;

/// The contents of a map folder. Lengths are in the unit of their epoch, which the map has chosen.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MapReport {
    /// Version of the format.
    pub version: u32,
    /// How much of a keyframe is kept.
    pub detail: MapDetail,
    /// Width of its images, pixels.
    pub width: usize,
    /// Height of its images, pixels.
    pub height: usize,
    /// Rectified intrinsics: fx, fy, cx, cy, pixels.
    pub intrinsics: [f64; 4],
    /// Keyframes of each epoch.
    pub epochs: Vec<EpochReport>,
    /// Total number of keyframes.
    pub keyframes: usize,
    /// Keyframes whose depth can be read.
    pub keyframes_with_depth: usize,
    /// Points of all keyframes, however uncertain.
    pub points: usize,
    /// Number of corrections of the map.
    pub revision: u64,
    /// Number of saves.
    pub saves: u64,
    /// Time of the last save, seconds since 1970.
    pub saved_secs: u64,
    /// Size of the folder, bytes.
    pub bytes: u64,
    /// Damage, one line per file.
    pub problems: Vec<String>,
}

/// An epoch, with a separate unit and world.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpochReport {
    /// Its number.
    pub epoch: u32,
    /// Its keyframes.
    pub keyframes: usize,
    /// Length of the path from keyframe to keyframe, map units.
    pub path_length: f64,
}

impl MapReport {
    /// Reports a map that was read with all of its depth.
    pub fn of(folder: &Path, loaded: &Loaded) -> Self {
        let Loaded { manifest, map, problems, .. } = loaded;
        let k = &manifest.camera;
        Self {
            version: VERSION,
            detail: manifest.detail,
            width: k.width,
            height: k.height,
            intrinsics: [k.fx, k.fy, k.cx, k.cy],
            epochs: epochs_of(map),
            keyframes: map.keyframes.len(),
            keyframes_with_depth: map.keyframes.iter().filter(|of| of.has_depth()).count(),
            points: map.keyframes.iter().map(|of| of.points.len()).sum(),
            revision: manifest.revision,
            saves: manifest.saves,
            saved_secs: manifest.saved_secs,
            bytes: bytes_in(folder) + bytes_in(&folder.join(KEYFRAMES)),
            problems: problems.clone(),
        }
    }
}

fn epochs_of(map: &Map) -> Vec<EpochReport> {
    let mut numbers: Vec<u32> = map.keyframes.iter().map(|keyframe| keyframe.epoch).collect();
    numbers.sort_unstable();
    numbers.dedup();
    let report = |epoch: u32| {
        let of_epoch = map.keyframes.iter().filter(|keyframe| keyframe.epoch == epoch);
        let places: Vec<_> =
            of_epoch.map(|keyframe| keyframe.map_from_keyframe.rigid.translation).collect();
        let path_length = places.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
        EpochReport { epoch, keyframes: places.len(), path_length }
    };
    numbers.into_iter().map(report).collect()
}

/// Bytes of the files of a folder.
fn bytes_in(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let files = entries.filter_map(|entry| entry.metadata().ok()).filter(|of| of.is_file());
    files.map(|metadata| metadata.len()).sum()
}

/// Writes the points (PLY, on request PCD and every point) and the keyframe trajectory (TUM) of one epoch; returns the
/// number of each. Calls `progress` with the number of keyframes fused so far, and of all.
pub fn export(
    folder: &Path,
    map: &Map,
    epoch: u32,
    params: &ResultsParams,
    progress: &mut dyn FnMut(usize, usize),
) -> io::Result<(usize, usize)> {
    fs::create_dir_all(folder)?;
    let of_epoch = map.keyframes.iter().filter(|keyframe| keyframe.epoch == epoch);
    let map = Map { keyframes: of_epoch.cloned().collect(), ..Map::default() };
    let keyframes: Vec<&Keyframe> = map.keyframes.iter().collect();
    let surface = fuse(&keyframes, &params.fusion(), progress);
    write_surface(&folder.join("map.ply"), &surface)?;
    if params.pcd {
        write_pcd(&folder.join("map.pcd"), &surface)?;
    }
    if params.full_points {
        let path = folder.join("points-full.ply");
        write_full_points(&path, &map, params.max_relative_std_dev)?;
    }
    let poses: Vec<StampedPose> = map.keyframes.iter().map(keyframe_pose).collect();
    let comment = "map_from_keyframe of every keyframe, map units";
    write_trajectory(&folder.join("keyframes.txt"), comment, &poses)?;
    Ok((surface.len(), poses.len()))
}
