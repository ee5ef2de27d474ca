//! `doctor`'s findings on cameras: which exist, whether this user and the services' user may open them, and which
//! processes use them.

use std::fs;
use std::path::Path;

use super::{Finding, Machine, user};
use crate::capture::v4l::listing::{Access, nodes};

/// The user of the services of an installed system.
const SERVICE_USER: &str = "semidense";
/// The group of video nodes, by udev's usual rules.
const VIDEO_GROUP: &str = "video";

impl Machine {
    /// One finding per camera, or one that there is none.
    pub(super) fn cameras(&self) -> Vec<Finding> {
        const SUBJECT: &str = "cameras";
        let found = nodes(&self.root.join("dev"));
        let findings: Vec<Finding> = found
            .iter()
            .filter_map(|path| Some(self.camera(path, (self.camera_access)(path)?)))
            .collect();
        if findings.is_empty() {
            let found = "none: recordings and the simulator need none";
            return vec![Finding::ok(SUBJECT, found)];
        }
        findings.into_iter().chain(self.service_user()).collect()
    }

    fn camera(&self, path: &Path, access: Access) -> Finding {
        const SUBJECT: &str = "cameras";
        let name = path.display();
        match access {
            Access::Free => Finding::ok(SUBJECT, name.to_string()),
            Access::Forbidden => Finding::warning(
                SUBJECT,
                format!("{name}: {} has no permission to open it", user()),
                format!("usermod -aG {VIDEO_GROUP} {}, then log in again", user()),
            ),
            Access::Unusable => Finding::warning(
                SUBJECT,
                format!("{name} cannot be opened"),
                "unplug it and plug it in again; see `dmesg` for the driver's error",
            ),
            Access::Busy => match self.holder(path) {
                Some((_, program)) if program == env!("CARGO_PKG_NAME") => {
                    Finding::ok(SUBJECT, format!("{name} is in use by {program}"))
                }
                Some((process, program)) => Finding::warning(
                    SUBJECT,
                    format!("{name} is in use by {program} (process {process})"),
                    format!("kill {process}"),
                ),
                None => Finding::warning(
                    SUBJECT,
                    format!("{name} is in use by another program"),
                    format!(
                        "find it with `sudo fuser {name}` and stop it, unless it is semidense itself"
                    ),
                ),
            },
        }
    }

    /// The process that has a node open, and its program's name, as far as this user may see.
    fn holder(&self, path: &Path) -> Option<(u32, String)> {
        let processes = fs::read_dir(self.root.join("proc")).ok()?.flatten();
        let mut numbers: Vec<u32> = processes
            .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
            .filter(|number| *number != std::process::id())
            .collect();
        numbers.sort_unstable();
        numbers.into_iter().find_map(|number| {
            let open = fs::read_dir(self.root.join(format!("proc/{number}/fd"))).ok()?.flatten();
            let mut targets = open.filter_map(|entry| fs::read_link(entry.path()).ok());
            let holds = targets.any(|target| target == path || self.root.join(target) == path);
            let program = self.read(&format!("proc/{number}/comm"))?;
            holds.then_some((number, program))
        })
    }

    /// On an installed system: whether the services' user is in the cameras' group.
    fn service_user(&self) -> Option<Finding> {
        const SUBJECT: &str = "services' user";
        let users = self.read("etc/passwd")?;
        users.lines().find(|line| line.split(':').next() == Some(SERVICE_USER))?;
        let groups = self.read("etc/group")?;
        let group = groups.lines().find(|line| line.split(':').next() == Some(VIDEO_GROUP))?;
        let members = group.split(':').nth(3).unwrap_or("");
        if members.split(',').any(|member| member == SERVICE_USER) {
            let found = format!("{SERVICE_USER} is in the group {VIDEO_GROUP}");
            return Some(Finding::ok(SUBJECT, found));
        }
        Some(Finding::warning(
            SUBJECT,
            format!("{SERVICE_USER} is not in the group {VIDEO_GROUP}"),
            format!("usermod -aG {VIDEO_GROUP} {SERVICE_USER}"),
        ))
    }
}

/// Whether a camera can be used, `None` for a node that is not a camera; a test can replace it.
pub(super) type CameraAccess = fn(&Path) -> Option<Access>;

#[cfg(test)]
mod tests {
    use super::super::Severity;
    use super::super::tests::machine;
    use super::*;

    fn by_name(path: &Path) -> Option<Access> {
        match path.file_name().unwrap().to_str().unwrap() {
            "video0" => Some(Access::Free),
            "video1" => Some(Access::Forbidden),
            "video2" | "video3" => Some(Access::Busy),
            "video4" => Some(Access::Unusable),
            _ => None,
        }
    }

    #[test]
    fn every_camera_is_a_finding_with_its_remedy() {
        let (folder, mut machine) = machine(&[
            ("dev/video0", ""),
            ("dev/video1", ""),
            ("dev/video2", ""),
            ("dev/video3", ""),
            ("dev/video4", ""),
            ("dev/video5", "an output node"),
            ("proc/71/comm", "cheese\n"),
            ("proc/72/comm", "semidense\n"),
            ("etc/passwd", "root:x:0:0::/root:/bin/sh\nsemidense:x:990:990::/:/bin/false\n"),
            ("etc/group", "video:x:44:me,you\nsemidense:x:990:\n"),
        ]);
        machine.camera_access = by_name;
        for (process, node) in [(71, "video2"), (72, "video3")] {
            let open = folder.path().join(format!("proc/{process}/fd"));
            fs::create_dir_all(&open).unwrap();
            std::os::unix::fs::symlink(folder.path().join("dev").join(node), open.join("5"))
                .unwrap();
        }
        let findings = machine.cameras();
        let texts: Vec<String> = findings
            .iter()
            .map(|f| format!("{:?} {} | {}", f.severity, f.found, f.remedy))
            .collect();
        assert_eq!(findings.len(), 6, "{texts:#?}");
        for (text, expected) in texts.iter().zip([
            ["Ok ", "dev/video0"],
            ["Warning ", "usermod -aG video "],
            ["Warning ", "video2 is in use by cheese (process 71) | kill 71"],
            ["Ok ", "video3 is in use by semidense"],
            ["Warning ", "video4 cannot be opened"],
            ["Warning semidense is not in the group video", "usermod -aG video semidense"],
        ]) {
            assert!(expected.iter().all(|part| text.contains(part)), "{text} {expected:?}");
        }
    }

    #[test]
    fn a_machine_without_cameras_is_ok() {
        let (_folder, machine) =
            machine(&[("dev/video-camera", ""), ("etc/group", "video:x:44:\n")]);
        let findings = machine.cameras();
        assert_eq!(findings.len(), 1);
        assert_eq!(findings[0].severity, Severity::Ok);
        assert!(findings[0].found.starts_with("none"));
    }

    #[test]
    fn the_services_user_may_be_in_the_video_group() {
        let (_folder, mut machine) = machine(&[
            ("dev/video0", ""),
            ("etc/passwd", "semidense:x:990:990::/:/bin/false\n"),
            ("etc/group", "video:x:44:semidense\n"),
        ]);
        machine.camera_access = by_name;
        assert!(machine.cameras().iter().all(|finding| finding.severity == Severity::Ok));
    }
}
