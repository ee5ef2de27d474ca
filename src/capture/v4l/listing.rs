//! The cameras of this machine: their identity, what they offer, whether they can be opened.

use std::path::{Path, PathBuf};

use rustix::io::Errno;
use serde::Serialize;

use super::device::KernelDevice;
use super::device_name::NAME_FOLDERS;
use super::kernel::{
    CAP_VIDEO_CAPTURE, CAP_VIDEO_CAPTURE_MPLANE, CONTROL_INACTIVE, CONTROL_READ_ONLY,
    CONTROL_TYPE_BOOLEAN, CONTROL_TYPE_INTEGER, CONTROL_TYPE_INTEGER_MENU, CONTROL_TYPE_MENU,
    CONTROL_WRITE_ONLY,
};
use super::pixel_format::PixelFormat;
use super::video_device::{ControlRange, OfferedFormat, SizeRange, VideoDevice, rate_hz};
use crate::capture::input_file::entries;

/// Whether a node can be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Access {
    /// It can be opened, and no other program streams from it.
    #[default]
    Free,
    /// Another program holds its buffers.
    Busy,
    /// This user may not open it.
    Forbidden,
    /// It cannot be opened for another reason.
    Unusable,
}

/// A size of a format.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SizeReport {
    /// The size, or the smallest and the largest.
    pub size: String,
    /// Supported frames per second, highest first; empty if the driver does not report them.
    pub rates_hz: Vec<f64>,
}

/// A format.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FormatReport {
    /// Its four-letter code.
    pub code: String,
    /// Its name.
    pub description: String,
    /// Whether it can be converted here.
    pub usable: bool,
    /// Its sizes.
    pub sizes: Vec<SizeReport>,
}

/// A control.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ControlReport {
    /// Its name.
    pub name: String,
    /// integer, boolean, menu or other.
    pub kind: &'static str,
    /// Smallest value.
    pub minimum: i32,
    /// Largest value.
    pub maximum: i32,
    /// Step.
    pub step: i32,
    /// Value after plugging in.
    pub default: i32,
    /// Current value, if it can be read.
    pub value: Option<i32>,
    /// Whether it cannot be set now: it is read-only, or controlled automatically.
    pub fixed: bool,
    /// Names of a menu's values.
    pub items: Vec<(u32, String)>,
}

/// A video node that delivers pictures, or could not be queried.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct CameraReport {
    /// The node.
    pub path: PathBuf,
    /// udev's names for it, as used in `v4l:NAME`.
    pub names: Vec<String>,
    /// Whether it can be used.
    pub access: Access,
    /// Why not, in the kernel's words.
    pub problem: Option<String>,
    /// The camera's name.
    pub card: String,
    /// Its driver.
    pub driver: String,
    /// Where it is plugged in.
    pub bus: String,
    /// The formats that it offers.
    pub formats: Vec<FormatReport>,
    /// Its controls.
    pub controls: Vec<ControlReport>,
}

/// The video nodes below `dev` (`/dev`), in the order of their numbers.
pub fn nodes(dev: &Path) -> Vec<PathBuf> {
    let number = |path: &Path| -> Option<u32> {
        path.file_name()?.to_str()?.strip_prefix("video")?.parse().ok()
    };
    let mut found = entries(dev);
    found.retain(|path| number(path).is_some());
    found.sort_by_key(|path| number(path));
    found
}

/// Every camera below `dev`, and every node that cannot be queried.
pub fn cameras(dev: &Path) -> Vec<CameraReport> {
    nodes(dev).iter().filter_map(|path| report(dev, path)).collect()
}

/// Whether a node can be used; `None` if it is not a camera.
pub fn access(path: &Path) -> Option<Access> {
    open(path).map(|(_, problem)| access_of(problem))
}

fn access_of(problem: Option<Errno>) -> Access {
    match problem {
        None => Access::Free,
        Some(Errno::BUSY) => Access::Busy,
        Some(Errno::ACCESS | Errno::PERM) => Access::Forbidden,
        Some(_) => Access::Unusable,
    }
}

/// Opens a node: its device, if it can be opened, and why it cannot be used; `None` if it is not a camera.
fn open(path: &Path) -> Option<(Option<KernelDevice>, Option<Errno>)> {
    let mut device = match KernelDevice::open(path) {
        Ok(device) => device,
        Err(error) => return Some((None, Some(error))),
    };
    let flags = device.capability().map_or(0, |capability| capability.flags);
    if flags & (CAP_VIDEO_CAPTURE | CAP_VIDEO_CAPTURE_MPLANE) == 0 {
        return None;
    }
    // A device without buffers of ours is busy if another program has some.
    let busy = device.make_buffers(0).err().filter(|error| *error == Errno::BUSY);
    Some((Some(device), busy))
}

fn report(dev: &Path, path: &Path) -> Option<CameraReport> {
    let (device, problem) = open(path)?;
    let mut found = CameraReport {
        path: path.to_owned(),
        names: names(dev, path),
        access: access_of(problem),
        problem: problem.map(|error| error.to_string()),
        ..CameraReport::default()
    };
    if let Some(device) = device {
        describe(&device, &mut found);
    }
    Some(found)
}

/// Reads what a device reports about itself.
fn describe(device: &dyn VideoDevice, found: &mut CameraReport) {
    if let Ok(capability) = device.capability() {
        (found.card, found.driver, found.bus) =
            (capability.card, capability.driver, capability.bus);
    }
    found.formats = device.formats().iter().map(|format| format_report(device, format)).collect();
    let controls = device.controls();
    found.controls = controls.iter().filter_map(|c| control_report(device, c)).collect();
}

fn format_report(device: &dyn VideoDevice, format: &OfferedFormat) -> FormatReport {
    let size = |size: &SizeRange| {
        let (width, height) = size.largest;
        let periods = device.periods(format.code, width, height);
        let mut rates: Vec<f64> = periods
            .iter()
            .flat_map(|period| [rate_hz(period.shortest), rate_hz(period.longest)])
            .collect();
        rates.sort_by(|a, b| b.total_cmp(a));
        rates.dedup();
        SizeReport { size: size.to_string(), rates_hz: rates }
    };
    FormatReport {
        code: format.code.to_string(),
        description: format.description.clone(),
        usable: PixelFormat::of(format.code).is_some(),
        sizes: device.sizes(format.code).iter().map(size).collect(),
    }
}

/// A control with its value; `None` for headings and buttons.
fn control_report(device: &dyn VideoDevice, control: &ControlRange) -> Option<ControlReport> {
    let kind = match control.kind {
        CONTROL_TYPE_INTEGER => "integer",
        CONTROL_TYPE_BOOLEAN => "boolean",
        CONTROL_TYPE_MENU | CONTROL_TYPE_INTEGER_MENU => "menu",
        _ => return None,
    };
    let is_readable = control.flags & CONTROL_WRITE_ONLY == 0;
    let items = if kind == "menu" { device.menu(control) } else { Vec::new() };
    Some(ControlReport {
        name: control.name.clone(),
        kind,
        minimum: control.minimum,
        maximum: control.maximum,
        step: control.step,
        default: control.default,
        value: is_readable.then(|| device.value(control.id).ok()).flatten(),
        fixed: control.flags & (CONTROL_READ_ONLY | CONTROL_INACTIVE) != 0,
        items,
    })
}

/// udev's names that lead to a node.
fn names(dev: &Path, path: &Path) -> Vec<String> {
    let leads_here = |link: &Path| link.canonicalize().is_ok_and(|target| target == path);
    let links = NAME_FOLDERS.iter().flat_map(|folder| entries(&dev.join(folder)));
    links
        .filter(|link| leads_here(link))
        .filter_map(|link| Some(link.file_name()?.to_string_lossy().into_owned()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::v4l::fake::Fake;

    #[test]
    fn nodes_are_sorted_by_number_and_not_by_name() {
        let dev = tempfile::tempdir().unwrap();
        for name in ["video10", "video2", "video", "videox", "video-cam", "vbi0"] {
            std::fs::write(dev.path().join(name), "").unwrap();
        }
        assert_eq!(nodes(dev.path()), [dev.path().join("video2"), dev.path().join("video10")]);
        assert!(nodes(Path::new("/nowhere")).is_empty());
        // A file that is not a device is not a camera.
        assert_eq!(cameras(dev.path()), []);
    }

    #[test]
    fn udev_names_lead_to_their_node() {
        let dev = tempfile::tempdir().unwrap();
        let dev = dev.path().canonicalize().unwrap();
        std::fs::create_dir_all(dev.join("v4l/by-id")).unwrap();
        std::fs::write(dev.join("video0"), "").unwrap();
        std::os::unix::fs::symlink("../../video0", dev.join("v4l/by-id/usb-A-video-index0"))
            .unwrap();
        std::os::unix::fs::symlink("../../video1", dev.join("v4l/by-id/usb-B-video-index0"))
            .unwrap();
        assert_eq!(names(&dev, &dev.join("video0")), ["usb-A-video-index0"]);
    }

    #[test]
    fn a_camera_reports_what_it_offers() {
        let fake = Fake::with_formats(&[(PixelFormat::Yuyv, &[(640, 480), (320, 240)], 30)])
            .with_control(0x0098_0913, "Gain", (0, 100, 5), 40, 0);
        let mut found = CameraReport::default();
        describe(&fake.device(), &mut found);
        let format = &found.formats[0];
        assert_eq!((format.code.as_str(), format.usable), ("YUYV", true));
        assert_eq!(
            format.sizes[0],
            SizeReport { size: "640x480".to_owned(), rates_hz: vec![30.0] }
        );
        let gain = &found.controls[0];
        assert_eq!((gain.name.as_str(), gain.value, gain.maximum), ("Gain", Some(40), 100));
    }
}
