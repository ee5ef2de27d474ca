//! Opens a source by its name, with the reader of its kind.

use std::path::{Path, PathBuf};

use crate::capture::looped::Looped;
use crate::capture::rig::Rig;
use crate::capture::simulator::Simulator;
use crate::capture::simulator::params::SimulatorParams;
use crate::capture::source::FrameSource;
use crate::capture::source_error::SourceError;
use crate::capture::source_name::SourceName;
use crate::capture::v4l::params::CameraParams;
use crate::capture::{bag, euroc, image_folder, stream, tum, v4l};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::two_frame::MIN_SIDE_PX;

/// Settings of sources.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SourceParams {
    /// The simulated camera and its world.
    pub simulator: SimulatorParams,
    /// Settings requested of a camera.
    pub camera: CameraParams,
}

/// Opens a source. `rig` is a rig file, which overrides a recording's own calibration. A camera is opened when its
/// first frame is awaited.
pub fn open(
    name: &SourceName,
    rig: Option<&Path>,
    params: &SourceParams,
) -> Result<Box<dyn FrameSource>, SourceError> {
    let refused = |problem: &str| {
        Err(SourceError::Name { name: name.to_string(), problem: problem.to_owned() })
    };
    if let Some(folder) = name.folder().filter(|folder| !folder.is_dir()) {
        return refused(&format!("there is no folder {}; check the path", folder.display()));
    }
    if let Some(likely) = misnamed(name) {
        return refused(&format!("the folder does not have this layout; it looks like {likely}"));
    }
    let stall_s = params.camera.stall_s;
    Ok(match name {
        SourceName::Tum(folder) => Box::new(tum::open(folder, rig)?),
        SourceName::Euroc(folder) => Box::new(euroc::open(folder, rig)?),
        SourceName::Images(folder) => {
            Box::new(image_folder::open(folder, rig).map_err(|error| of_recording(folder, error))?)
        }
        SourceName::Mcap { file, topic } => Box::new(bag::open(file, topic.as_deref(), rig)?),
        SourceName::Simulator { .. } if rig.is_some() => {
            return refused(
                "the simulator takes no rig; its camera is in the table [simulator] of the configuration",
            );
        }
        SourceName::Simulator { scene } => {
            let mut params = params.simulator.clone();
            match scene.as_ref().map(|scene| scene.parse()) {
                None => {}
                Some(Ok(scene)) => params = params.with_scene(scene),
                Some(Err(problem)) => return refused(problem),
            }
            Box::new(Simulator::unpainted(params)?)
        }
        SourceName::Looped { inner, .. } if inner.is_camera() => {
            return refused("a camera cannot be repeated; name a recording or the simulator");
        }
        SourceName::Looped { num_frames, rate_hz, inner } => {
            let source = open(inner, rig, params)?;
            Box::new(Looped::new(name.clone(), source, *num_frames, *rate_hz))
        }
        SourceName::Camera(device) => Box::new(v4l::open(device, rig, &params.camera)?),
        SourceName::Stream(path) => Box::new(stream::open_socket(path, rig, stall_s)?),
        SourceName::Ros2(topic) => Box::new(stream::open_ros2(topic, rig, stall_s)?),
    })
}

/// Refuses a source whose images are too small to start a map on.
pub fn check_size(name: &str, intrinsics: &Intrinsics) -> Result<(), SourceError> {
    let Intrinsics { width, height, .. } = *intrinsics;
    if width.min(height) >= MIN_SIDE_PX {
        return Ok(());
    }
    let problem = format!(
        "its images have {width}x{height} pixels, and tracking needs {MIN_SIDE_PX} to each side; enlarge them"
    );
    Err(SourceError::Name { name: name.to_owned(), problem })
}

/// The error of a folder without a camera or stamps, where these are in the recording that it is part of.
fn of_recording(folder: &Path, error: SourceError) -> SourceError {
    /// EuRoC's images are in cam0/data.
    const MAX_LEVELS: usize = 2;
    if !matches!(error, SourceError::NoRig { .. } | SourceError::NoStamps { .. }) {
        return error;
    }
    let folder_path = folder.canonicalize().unwrap_or_default();
    let around = folder_path.ancestors().skip(1).take(MAX_LEVELS);
    let has_lists = |name: &SourceName| !matches!(name, SourceName::Images(_));
    match around.filter_map(SourceName::of_folder).find(has_lists) {
        Some(recording) => SourceError::Name {
            name: folder.display().to_string(),
            problem: format!("this is a folder of images in a recording: name that, {recording}"),
        },
        None => error,
    }
}

/// For a folder without the layout that its source names, returns the source by the layout that it has.
fn misnamed(name: &SourceName) -> Option<SourceName> {
    let (SourceName::Tum(folder) | SourceName::Euroc(folder) | SourceName::Images(folder)) = name
    else {
        // The source of a loop is checked when it is opened.
        return None;
    };
    if name.has_layout() { None } else { SourceName::of_folder(folder) }
}

/// Describes in one line how the recording's own camera differs from that of the `rig` that overrides it. `None` if
/// they agree, or if the recording has no camera that can be read.
fn rig_conflict(name: &SourceName, rig: Option<&Path>) -> Option<String> {
    /// Displacement that no two calibrations of the same camera differ by, pixels: files are written with few digits,
    /// and calibrations of one camera differ by tenths.
    const MAX_SHIFT_PX: f64 = 2.0;
    let (folder, rig) = (name.folder()?, rig?);
    let (own, own_path) = own_rig(name, folder)?;
    let shift_px = own.largest_shift_px(&Rig::read(rig).ok()?);
    let difference = match shift_px.is_finite() {
        true => format!("differ by up to {shift_px:.0} px"),
        false => "see different parts of the world or have images of different sizes".to_owned(),
    };
    (shift_px > MAX_SHIFT_PX).then(|| {
        format!(
            "the camera of {} and that of {} {difference}; the first is used; omit --rig to use the second",
            rig.display(),
            own_path.display()
        )
    })
}

/// Remarks on the camera of a source, one line each: it differs from the recording's own, or its field of view is
/// unusual.
pub fn rig_remarks(name: &SourceName, rig: Option<&Path>) -> Vec<String> {
    let used = match (name.folder(), rig) {
        (_, Some(path)) => Rig::read(path).ok().map(|rig| (rig, path.to_owned())),
        (Some(folder), None) => own_rig(name, folder),
        (None, None) => None,
    };
    let unusual =
        used.and_then(|(rig, path)| Some(format!("{}: {}", path.display(), rig.remark()?)));
    rig_conflict(name, rig).into_iter().chain(unusual).collect()
}

/// Returns a recording's own camera and the path of its file.
fn own_rig(name: &SourceName, folder: &Path) -> Option<(Rig, PathBuf)> {
    match name {
        SourceName::Euroc(_) => euroc::own_rig(folder),
        _ => tum::own_rig(folder),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_images_of_a_recording_are_refused_with_its_name() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path().canonicalize().unwrap();
        for (list, images, recording) in [
            ("a/rgb.txt", "a/rgb", "tum:{}/a"),
            ("b/mav0/cam0/data.csv", "b/mav0/cam0/data", "euroc:{}/b/mav0"),
        ] {
            let images = root.join(images);
            std::fs::create_dir_all(&images).unwrap();
            std::fs::write(root.join(list), "").unwrap();
            std::fs::write(images.join("1.png"), "").unwrap();
            let name = SourceName::Images(images.clone());
            let error = open(&name, None, &SourceParams::default()).err().unwrap().to_string();
            let recording = recording.replace("{}", &root.display().to_string());
            assert!(error.starts_with(&format!("source `{}`: ", images.display())), "{error}");
            assert!(error.ends_with(&format!("name that, {recording}")), "{error}");
        }
    }
}
