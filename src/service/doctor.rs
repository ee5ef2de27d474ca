//! Finds what on this machine will cost latency or fail, each finding with the command that fixes it.

mod cameras;
mod processes;

use std::fs;
use std::path::PathBuf;

use rustix::process::{Resource, getrlimit};
use serde::Serialize;

use self::cameras::CameraAccess;
use crate::capture::v4l::listing::access;
use crate::service::config::Config;
use crate::service::schedule::Policy;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::wire::folders::SHARED_MEMORY;
use crate::wire::place::Place;
use crate::wire::topic::shared_memory_bytes;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// As it should be.
    Ok,
    /// It works, but later or less reliably than it could.
    Warning,
    /// It will not work.
    Error,
}

/// Result of one check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was checked.
    pub subject: &'static str,
    /// How bad it is.
    pub severity: Severity,
    /// What was found.
    pub found: String,
    /// The command that fixes it; empty where nothing needs fixing.
    pub remedy: String,
}

impl Finding {
    fn ok(subject: &'static str, found: impl Into<String>) -> Self {
        let (severity, found) = (Severity::Ok, found.into());
        Self { subject, severity, found, remedy: String::new() }
    }

    fn warning(subject: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        let (severity, found, remedy) = (Severity::Warning, found.into(), remedy.into());
        Self { subject, severity, found, remedy }
    }

    fn error(subject: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { severity: Severity::Error, ..Self::warning(subject, found, remedy) }
    }
}

/// The largest usual camera, which shared memory must hold.
const LARGE_CAMERA: Intrinsics = Intrinsics::pinhole(1280, 720, 1000.0);
/// The smallest limit on locked memory that a tracker needs, bytes.
const MIN_LOCKED_BYTES: u64 = 512 << 20;

/// The kernel's files below `root` (`/`).
#[derive(Debug, Clone)]
pub struct Machine {
    /// Folder that holds `proc`, `sys` and `dev`.
    pub root: PathBuf,
    /// How to check whether a camera can be used.
    camera_access: CameraAccess,
}

impl Default for Machine {
    fn default() -> Self {
        Self { root: PathBuf::from("/"), camera_access: access }
    }
}

/// Runs every check.
pub fn examine(machine: &Machine, config: &Config) -> Vec<Finding> {
    let mut findings = vec![
        real_time_limit(config),
        memory_limit(config),
        machine.real_time_throttling(),
        machine.governor(),
        machine.clock_source(),
        machine.cpus(),
        shared_memory(),
        runtime_folder(config),
    ];
    findings.extend(machine.processes(config));
    findings.extend(machine.cameras());
    findings
}

fn wants_real_time(config: &Config) -> bool {
    let processes = [&config.capture.scheduling, &config.tracker.scheduling];
    processes.iter().any(|s| matches!(s.policy, Policy::Fifo | Policy::Deadline))
}

fn real_time_limit(config: &Config) -> Finding {
    const SUBJECT: &str = "real-time limit";
    let wanted =
        u64::from(config.capture.scheduling.priority.max(config.tracker.scheduling.priority));
    let limit = getrlimit(Resource::Rtprio).current;
    let is_root = rustix::process::geteuid().is_root();
    let found = limit.map_or("none".to_owned(), |limit| limit.to_string());
    if is_root || limit.is_none_or(|limit| limit >= wanted) {
        return Finding::ok(SUBJECT, if is_root { "root: any priority".to_owned() } else { found });
    }
    let remedy = format!(
        "LimitRTPRIO={wanted} in the unit, or `{} - rtprio {wanted}` in /etc/security/limits.conf, then log in again",
        user()
    );
    let found = format!("priorities up to {found}, {wanted} needed");
    match wants_real_time(config) {
        true => Finding::error(SUBJECT, found, remedy),
        false => Finding::warning(SUBJECT, found, remedy),
    }
}

fn memory_limit(config: &Config) -> Finding {
    const SUBJECT: &str = "locked memory";
    let limit = getrlimit(Resource::Memlock).current;
    let is_root = rustix::process::geteuid().is_root();
    if is_root || limit.is_none_or(|limit| limit >= MIN_LOCKED_BYTES) {
        let found = if is_root { "root: no limit" } else { "enough" };
        return Finding::ok(SUBJECT, found);
    }
    let remedy = format!(
        "LimitMEMLOCK=infinity in the unit, or `{} - memlock unlimited` in /etc/security/limits.conf, then log in again",
        user()
    );
    let found = format!("only {} MB may be locked, which is too little", limit.unwrap_or(0) >> 20);
    match config.tracker.scheduling.lock_memory {
        true => Finding::error(SUBJECT, found, remedy),
        false => Finding::warning(SUBJECT, found, remedy),
    }
}

/// Name of this user: services have no USER, and `usermod` accepts no numbers.
fn user() -> String {
    let number = rustix::process::geteuid().as_raw().to_string();
    let users = fs::read_to_string("/etc/passwd").unwrap_or_default();
    let line = users.lines().find(|line| line.split(':').nth(2) == Some(&number));
    line.and_then(|line| line.split(':').next()).unwrap_or(&number).to_owned()
}

fn shared_memory() -> Finding {
    const SUBJECT: &str = "shared memory";
    let needed = shared_memory_bytes(&LARGE_CAMERA, None);
    match rustix::fs::statvfs(SHARED_MEMORY) {
        Err(error) => Finding::error(
            SUBJECT,
            format!("{SHARED_MEMORY}: {error}"),
            format!("mount -t tmpfs tmpfs {SHARED_MEMORY}"),
        ),
        Ok(stat) => {
            let free = stat.f_bavail.saturating_mul(stat.f_frsize);
            let found =
                format!("{} MB free, {} MB needed for 1280x720", free >> 20, (needed >> 20) + 1);
            if free >= needed {
                return Finding::ok(SUBJECT, found);
            }
            Finding::warning(
                SUBJECT,
                found,
                format!("mount -o remount,size={}M {SHARED_MEMORY}", (2 * needed) >> 20),
            )
        }
    }
}

fn runtime_folder(config: &Config) -> Finding {
    const SUBJECT: &str = "runtime folder";
    let place = match Place::new(&config.instance, &config.root) {
        Ok(place) => place,
        Err(error) => {
            return Finding::error(SUBJECT, error.to_string(), "set root in the configuration");
        }
    };
    let existed = place.root.exists();
    let made = place.create();
    if !existed {
        // Only a trial: a folder that did not exist is removed again.
        drop(fs::remove_dir(&place.root));
    }
    match made {
        Ok(()) => Finding::ok(SUBJECT, place.root.display().to_string()),
        Err(error) => Finding::error(
            SUBJECT,
            error.to_string(),
            "run as the user who owns it, or set SEMIDENSE_ROOT to a folder of your own",
        ),
    }
}

impl Machine {
    fn read(&self, path: &str) -> Option<String> {
        Some(fs::read_to_string(self.root.join(path)).ok()?.trim().to_owned())
    }

    fn real_time_throttling(&self) -> Finding {
        const SUBJECT: &str = "real-time throttling";
        let number =
            |name: &str| self.read(&format!("proc/sys/kernel/{name}"))?.parse::<i64>().ok();
        match (number("sched_rt_runtime_us"), number("sched_rt_period_us")) {
            (Some(runtime), Some(period)) if runtime >= 0 && runtime < period / 2 => {
                Finding::warning(
                    SUBJECT,
                    format!("{runtime} of {period} µs for real-time processes"),
                    "sysctl kernel.sched_rt_runtime_us=950000",
                )
            }
            (Some(runtime), Some(period)) if runtime >= 0 => {
                Finding::ok(SUBJECT, format!("{runtime} of {period} µs: enough"))
            }
            (Some(_), _) => Finding::ok(SUBJECT, "off"),
            _ => Finding::ok(SUBJECT, "unknown: the kernel does not report it"),
        }
    }

    fn governor(&self) -> Finding {
        const SUBJECT: &str = "CPU governor";
        let path = "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor";
        match self.read(path).as_deref() {
            None => Finding::ok(SUBJECT, "none: the CPU clock is fixed"),
            Some("performance") => Finding::ok(SUBJECT, "performance"),
            Some(other) => Finding::warning(
                SUBJECT,
                format!("{other}: the first milliseconds after idling are slow"),
                "cpupower frequency-set -g performance",
            ),
        }
    }

    fn clock_source(&self) -> Finding {
        const SUBJECT: &str = "clock source";
        let folder = "sys/devices/system/clocksource/clocksource0";
        let Some(current) = self.read(&format!("{folder}/current_clocksource")) else {
            return Finding::ok(SUBJECT, "unknown: the kernel does not report it");
        };
        let slow = ["hpet", "acpi_pm", "jiffies", "refined-jiffies"];
        if !slow.contains(&current.as_str()) {
            return Finding::ok(SUBJECT, current);
        }
        Finding::warning(
            SUBJECT,
            format!("{current}: reading the clock takes a microsecond each time"),
            format!(
                "echo tsc > /{folder}/current_clocksource, or tsc=reliable on the kernel's command line"
            ),
        )
    }

    fn cpus(&self) -> Finding {
        const SUBJECT: &str = "CPUs";
        let count = std::thread::available_parallelism().map_or(1, usize::from);
        let kernel = match self.read("sys/kernel/realtime").as_deref() {
            Some("1") => "a real-time kernel",
            _ => "not a real-time kernel",
        };
        let found = format!("{count}, {kernel}");
        if count >= 2 {
            return Finding::ok(SUBJECT, found);
        }
        Finding::warning(SUBJECT, found, "provide two or more: the mapper occupies one")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A machine whose kernel shows these files.
    pub(super) fn machine(files: &[(&str, &str)]) -> (tempfile::TempDir, Machine) {
        let folder = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let machine = Machine { root: folder.path().to_owned(), ..Machine::default() };
        (folder, machine)
    }

    #[test]
    fn slow_settings_are_found_with_their_remedies() {
        let (_folder, machine) = machine(&[
            ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "powersave\n"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet\n"),
            ("proc/sys/kernel/sched_rt_runtime_us", "100000\n"),
            ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
        ]);
        for finding in [machine.governor(), machine.clock_source(), machine.real_time_throttling()]
        {
            assert_eq!(finding.severity, Severity::Warning, "{finding:?}");
            assert!(!finding.remedy.is_empty());
        }
        assert!(machine.governor().found.contains("powersave"));
    }

    #[test]
    fn a_well_configured_machine_has_no_remedies() {
        let (_folder, machine) = machine(&[
            ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc"),
            ("proc/sys/kernel/sched_rt_runtime_us", "950000"),
            ("proc/sys/kernel/sched_rt_period_us", "1000000"),
        ]);
        for finding in [machine.governor(), machine.clock_source(), machine.real_time_throttling()]
        {
            assert_eq!(finding.severity, Severity::Ok, "{finding:?}");
        }
    }

    #[test]
    fn missing_kernel_files_are_not_a_fault() {
        let (_folder, machine) = machine(&[]);
        let findings = [machine.governor(), machine.clock_source(), machine.real_time_throttling()];
        assert!(findings.iter().all(|finding| finding.severity == Severity::Ok));
    }

    #[test]
    fn the_examination_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("root");
        let config = Config { root: root.display().to_string(), ..Config::default() };
        let findings = examine(&Machine::default(), &config);
        assert!(findings.len() >= 10 && !root.exists());
        let foreign = Config { root: "/proc/nowhere".to_owned(), ..Config::default() };
        assert_eq!(runtime_folder(&foreign).severity, Severity::Error);
    }
}
