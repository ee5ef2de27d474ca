//! Whether a process of this machine runs, is stopped or is gone, from `/proc`.

use std::fs;
use std::time::Duration;

/// State of a process in the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Liveness {
    /// It runs or sleeps.
    Running,
    /// It is stopped by a signal (SIGSTOP, Ctrl-Z) or by a debugger, and does nothing until it is continued.
    Stopped,
    /// No such process exists, or only its exit code is left.
    Gone,
}

impl Liveness {
    /// Liveness of the process with this id.
    pub fn of(process_id: u32) -> Self {
        let stat = fs::read_to_string(format!("/proc/{process_id}/stat")).unwrap_or_default();
        Self::from_stat(&stat)
    }

    /// From the contents of `/proc/ID/stat`.
    fn from_stat(stat: &str) -> Self {
        let state = field(stat, STATE).and_then(|state| state.chars().next());
        match state {
            None | Some('Z' | 'X' | 'x') => Self::Gone,
            Some('T' | 't') => Self::Stopped,
            Some(_) => Self::Running,
        }
    }
}

/// Whether the process with this id was killed or has exited and still releases its resources: the kernel closes its
/// files, and with them its locks, when the last of its threads has ended.
pub fn is_ending(process_id: u32) -> bool {
    is_ending_by_stat(&fs::read_to_string(format!("/proc/{process_id}/stat")).unwrap_or_default())
}

/// From the contents of `/proc/ID/stat`.
fn is_ending_by_stat(stat: &str) -> bool {
    const FLAGS: usize = 9;
    const NUM_THREADS: usize = 20;
    /// `PF_EXITING` of the kernel.
    const EXITING: u32 = 4;
    let number = |at: usize| field(stat, at).and_then(|of| of.parse::<u32>().ok());
    // The first thread of a process stays a zombie until the others are gone and until its exit code is collected.
    let is_left =
        field(stat, STATE) == Some("Z") && number(NUM_THREADS).is_none_or(|threads| threads <= 1);
    number(FLAGS).is_some_and(|flags| flags & EXITING != 0) && !is_left
}

/// Field of the state in `/proc/ID/stat`, the first after the name.
const STATE: usize = 3;

/// A field of `/proc/ID/stat`, from the state on, counted from 1 as in the kernel's manual: the name before it may
/// contain anything.
fn field(stat: &str, at: usize) -> Option<&str> {
    stat.rsplit_once(')')?.1.split_whitespace().nth(at - STATE)
}

/// Age of the process with this id; `None` where no such process exists.
pub fn age(process_id: u32) -> Option<Duration> {
    let stat = fs::read_to_string(format!("/proc/{process_id}/stat")).ok()?;
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    let now = Duration::new(u64::try_from(now.tv_sec).ok()?, u32::try_from(now.tv_nsec).ok()?);
    let began = began_ticks(&stat)? as f64 / rustix::param::clock_ticks_per_second() as f64;
    Some(now.saturating_sub(Duration::try_from_secs_f64(began).ok()?))
}

/// Clock ticks from the start of the machine to that of the process, from the contents of `/proc/ID/stat`.
fn began_ticks(stat: &str) -> Option<u64> {
    const START_TIME: usize = 22;
    field(stat, START_TIME)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_follows_the_name() {
        assert_eq!(Liveness::from_stat("7 (a) T b) S 1 7"), Liveness::Running);
        assert_eq!(Liveness::from_stat("7 (semidense) T 1 7"), Liveness::Stopped);
        assert_eq!(Liveness::from_stat("7 (semidense) t 1 7"), Liveness::Stopped);
        assert_eq!(Liveness::from_stat("7 (semidense) Z 1 7"), Liveness::Gone);
        assert_eq!(Liveness::from_stat(""), Liveness::Gone);
        assert_eq!(Liveness::of(std::process::id()), Liveness::Running);
    }

    #[test]
    fn a_process_is_ending_until_its_last_thread_is_gone() {
        let stat = |state: &str, flags: u32, threads: u32| {
            format!("7 (a) b) {state} 1 7 7 0 -1 {flags} 0 0 0 0 0 0 0 0 20 0 {threads} 0 4711 0 0")
        };
        let (usual, exiting) = (4_194_560, 4_194_564);
        assert!(!is_ending_by_stat(&stat("S", usual, 4)));
        assert!(
            is_ending_by_stat(&stat("R", exiting, 4)) && is_ending_by_stat(&stat("R", exiting, 1))
        );
        assert!(is_ending_by_stat(&stat("Z", exiting, 2)));
        assert!(!is_ending_by_stat(&stat("Z", exiting, 1)) && !is_ending_by_stat(""));
        assert!(!is_ending(std::process::id()) && !is_ending(u32::MAX));
        let mut child = std::process::Command::new("true").spawn().unwrap();
        while Liveness::of(child.id()) != Liveness::Gone {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(!is_ending(child.id()), "only its exit code is left");
        child.wait().unwrap();
    }

    #[test]
    fn a_process_has_an_age() {
        let stat = "7 (a) b) S 1 7 7 0 -1 4194560 0 0 0 0 0 0 0 0 20 0 1 0 4711 0 0";
        assert_eq!(began_ticks(stat), Some(4711));
        assert_eq!(began_ticks(""), None);
        let (own, first) = (age(std::process::id()).unwrap(), age(1).unwrap());
        assert!(own <= first && own < Duration::from_secs(86_400), "{own:?} {first:?}");
        assert_eq!(age(u32::MAX), None);
    }
}
