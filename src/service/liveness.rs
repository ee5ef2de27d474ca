//! Whether a process of this machine runs, is stopped, or is there no more, by `/proc`.

use std::fs;

/// What the kernel says of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Liveness {
    /// It runs or sleeps.
    Running,
    /// It is stopped by a signal (SIGSTOP, Ctrl-Z) or by a debugger, and does nothing until it is continued.
    Stopped,
    /// There is no such process, or only its exit code is left.
    Gone,
}

impl Liveness {
    /// Of the process with this id.
    pub fn of(process_id: u32) -> Self {
        let stat = fs::read_to_string(format!("/proc/{process_id}/stat")).unwrap_or_default();
        Self::from_stat(&stat)
    }

    /// By the contents of `/proc/ID/stat`: the state stands behind the name, which may hold anything.
    fn from_stat(stat: &str) -> Self {
        let state = stat.rsplit_once(')').and_then(|(_, rest)| rest.trim_start().chars().next());
        match state {
            None | Some('Z' | 'X' | 'x') => Self::Gone,
            Some('T' | 't') => Self::Stopped,
            Some(_) => Self::Running,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_stands_behind_the_name() {
        assert_eq!(Liveness::from_stat("7 (a) T b) S 1 7"), Liveness::Running);
        assert_eq!(Liveness::from_stat("7 (semidense) T 1 7"), Liveness::Stopped);
        assert_eq!(Liveness::from_stat("7 (semidense) t 1 7"), Liveness::Stopped);
        assert_eq!(Liveness::from_stat("7 (semidense) Z 1 7"), Liveness::Gone);
        assert_eq!(Liveness::from_stat(""), Liveness::Gone);
        assert_eq!(Liveness::of(std::process::id()), Liveness::Running);
    }
}
