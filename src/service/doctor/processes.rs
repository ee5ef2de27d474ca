//! `doctor`'s findings on running processes: the limits set by their units. The doctor's own limits, most often those
//! of a login or of root, do not apply to them.

use std::fs;

use super::{Finding, MIN_LOCKED_BYTES, Machine};
use crate::service::config::Config;
use crate::service::schedule::Policy;

/// The processes of a rig.
const PROCESSES: [&str; 3] = ["capture", "tracker", "mapper"];

/// A running process of the rig.
struct Running {
    number: u32,
    name: &'static str,
    limits: String,
}

impl Running {
    /// A soft limit by its name in the kernel; `u64::MAX` where unlimited.
    fn limit(&self, name: &str) -> Option<u64> {
        let line = self.limits.lines().find(|line| line.starts_with(name))?;
        let word = line.get(name.len()..)?.split_whitespace().next()?;
        if word == "unlimited" { Some(u64::MAX) } else { word.parse().ok() }
    }
}

impl Machine {
    /// One finding for all running processes, or one for each limit that is too low.
    pub(super) fn processes(&self, config: &Config) -> Vec<Finding> {
        const SUBJECT: &str = "running processes";
        let running = self.running();
        let found = running.iter().flat_map(|process| self.limits_of(process, config));
        let findings: Vec<Finding> = found.collect();
        if !findings.is_empty() {
            return findings;
        }
        let names: Vec<String> = running
            .iter()
            .map(|process| format!("{} ({})", process.name, process.number))
            .collect();
        match names.is_empty() {
            true => vec![Finding::ok(SUBJECT, "none")],
            false => {
                vec![Finding::ok(SUBJECT, format!("{}: their limits are enough", names.join(", ")))]
            }
        }
    }

    /// The rig's running processes, as far as this user may see, in the order of their ids.
    fn running(&self) -> Vec<Running> {
        let entries = fs::read_dir(self.root.join("proc")).into_iter().flatten().flatten();
        let mut found: Vec<Running> = entries
            .filter_map(|entry| {
                let number: u32 = entry.file_name().to_str()?.parse().ok()?;
                let command = fs::read(entry.path().join("cmdline")).ok()?;
                let mut words = command.split(|&byte| byte == 0);
                let program = words.next()?.rsplit(|&byte| byte == b'/').next()?;
                if program != env!("CARGO_PKG_NAME").as_bytes() {
                    return None;
                }
                let mut names = words
                    .filter_map(|word| PROCESSES.into_iter().find(|name| name.as_bytes() == word));
                let name = names.next()?;
                let limits = fs::read_to_string(entry.path().join("limits")).ok()?;
                Some(Running { number, name, limits })
            })
            .collect();
        found.sort_by_key(|process| process.number);
        found
    }

    fn limits_of(&self, process: &Running, config: &Config) -> Vec<Finding> {
        const SUBJECT: &str = "running processes";
        let Running { number, name, .. } = process;
        let scheduling = match *name {
            "capture" => &config.capture.scheduling,
            "tracker" => &config.tracker.scheduling,
            _ => &config.mapper.scheduling,
        };
        let mut findings = Vec::new();
        let mut complain = |found: String, line: String| {
            let remedy = format!("{line} in the unit semidense-{name}@.service, then restart it");
            findings.push(Finding::warning(SUBJECT, found, remedy));
        };
        let wants_real_time = matches!(scheduling.policy, Policy::Fifo | Policy::Deadline);
        let priority = u64::from(scheduling.priority);
        if let Some(limit) = process.limit("Max realtime priority")
            && wants_real_time
            && limit < priority
        {
            complain(
                format!("{name} ({number}) may have priorities up to {limit}, {priority} needed"),
                format!("LimitRTPRIO={priority}"),
            );
        }
        if let Some(limit) = process.limit("Max locked memory")
            && scheduling.lock_memory
            && limit < MIN_LOCKED_BYTES
        {
            complain(
                format!("{name} ({number}) may lock {} MB", limit >> 20),
                "LimitMEMLOCK=infinity".to_owned(),
            );
        }
        findings
    }
}

#[cfg(test)]
mod tests {
    use super::super::Severity;
    use super::super::tests::machine;
    use super::*;

    const LIMITS: &str = "Limit                     Soft Limit           Hard Limit           Units     \n\
        Max locked memory         8388608              8388608              bytes     \n\
        Max realtime priority     0                    0                    \n";

    #[test]
    fn limits_are_those_of_the_running_processes() {
        let (_folder, machine) = machine(&[
            ("proc/12/cmdline", "/usr/bin/semidense\0tracker\0--live\0"),
            ("proc/12/limits", LIMITS),
            ("proc/13/cmdline", "/usr/bin/semidense\0--instance\0a\0mapper\0"),
            ("proc/13/limits", LIMITS),
            ("proc/14/cmdline", "/usr/bin/other\0tracker\0"),
            ("proc/14/limits", LIMITS),
        ]);
        let mut config = Config::default();
        let findings = machine.processes(&config);
        assert_eq!(findings.len(), 1, "nothing is wanted: {findings:?}");
        assert!(findings[0].found.starts_with("tracker (12), mapper (13): "), "{findings:?}");
        config.tracker.scheduling.policy = Policy::Fifo;
        config.tracker.scheduling.lock_memory = true;
        let findings = machine.processes(&config);
        assert_eq!(findings.len(), 2, "{findings:?}");
        assert!(findings.iter().all(|finding| finding.severity == Severity::Warning));
        assert!(findings[0].found.contains("priorities up to 0, 70 needed"), "{findings:?}");
        assert!(findings[0].remedy.starts_with("LimitRTPRIO=70 in the unit semidense-tracker@"));
        assert!(findings[1].found.contains("may lock 8 MB"), "{findings:?}");
    }

    #[test]
    fn a_machine_without_running_processes_is_ok() {
        let (_folder, machine) = machine(&[]);
        assert_eq!(machine.processes(&Config::default())[0].found, "none");
    }
}
