//! Names of cameras: a path, a number, or udev's name.

use std::path::{Path, PathBuf};

use super::video_device::OpenFailure;
use crate::capture::input_file::entries;

/// Folders of udev's names, in the order of preference: an id stays with the camera, a path with the port.
pub const NAME_FOLDERS: [&str; 3] = ["v4l/by-id", "v4l/by-path", "semidense"];
/// Suffix that udev adds to the name of a camera's first image node.
const FIRST_NODE: &str = "-video-index0";

/// Finds the node of a camera by its name below `dev` (`/dev`): a path, a number (`0` is `video0`), `video0`, or a name
/// in `v4l/by-id`, `v4l/by-path` or `semidense`: complete, without `-video-index0`, or an unambiguous beginning.
///
/// Looked up again before every opening: udev's names appear and disappear with the camera.
pub fn find(dev: &Path, name: &str) -> Result<PathBuf, OpenFailure> {
    let number = name.strip_prefix("video").unwrap_or(name);
    if let Ok(number) = number.parse::<u32>() {
        return Ok(dev.join(format!("video{number}")));
    }
    if name.contains('/') {
        return Ok(PathBuf::from(name));
    }
    for folder in NAME_FOLDERS {
        let folder = dev.join(folder);
        for exact in [name.to_owned(), format!("{name}{FIRST_NODE}")] {
            if folder.join(&exact).exists() {
                return Ok(folder.join(exact));
            }
        }
        let mut found = entries(&folder);
        found.retain(|path| {
            let entry = path.file_name().unwrap_or_default().to_string_lossy();
            // Further nodes of the same camera carry no images.
            let is_first = entry.ends_with(FIRST_NODE) || !entry.contains("-video-index");
            is_first && entry.starts_with(name)
        });
        match found.as_slice() {
            [] => {}
            [only] => return Ok(only.clone()),
            _ => return Err(OpenFailure::Ambiguous(found)),
        }
    }
    Err(OpenFailure::Missing)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dev(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
        folder
    }

    #[test]
    fn cameras_are_found_by_path_number_and_id() {
        let left = "v4l/by-id/usb-Maker_Cam_AA11-video-index0";
        let dev = dev(&[
            left,
            "v4l/by-id/usb-Maker_Cam_AA11-video-index1",
            "v4l/by-id/usb-Maker_Cam_BB22-video-index0",
            "v4l/by-path/pci-0000:00:14.0-usb-0:1:1.0-video-index0",
        ]);
        let find = |name: &str| find(dev.path(), name);
        let at = |path: &str| Ok(dev.path().join(path));
        assert_eq!(find("/dev/video7"), Ok(PathBuf::from("/dev/video7")));
        assert_eq!(find("./here"), Ok(PathBuf::from("./here")));
        assert_eq!(find("2"), at("video2"));
        assert_eq!(find("video3"), at("video3"));
        for name in ["usb-Maker_Cam_AA11-video-index0", "usb-Maker_Cam_AA11", "usb-Maker_Cam_A"] {
            assert_eq!(find(name), at(left), "{name}");
        }
        assert_eq!(
            find("usb-Maker_Cam_AA11-video-index1"),
            at("v4l/by-id/usb-Maker_Cam_AA11-video-index1")
        );
        assert!(find("pci-0000:00:14.0").unwrap().to_string_lossy().contains("by-path"));
        assert_eq!(find("usb-Other"), Err(OpenFailure::Missing));
        assert_eq!(find("99999999999"), Err(OpenFailure::Missing));
        let Err(OpenFailure::Ambiguous(found)) = find("usb-Maker") else { panic!("two fit") };
        assert_eq!(found.len(), 2);
    }
}
