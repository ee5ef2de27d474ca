//! One process from the supervisor's side: whether it lives, its last sign of life, when it is restarted and why it had
//! to be.

use std::io;
use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::service::child::Child;
use crate::service::health::{ProcessState, cause};
use crate::service::liveness::Liveness;
use crate::service::mapper::WRITES_MAP;
use crate::service::peers::Peer;
use crate::service::results::record::RestartCause;
use crate::wire::folders::SHARED_MEMORY;
use crate::wire::port::ReceiveError;
use crate::wire::shared_memory::free_shared_memory;
use crate::wire::topic::CAPTURE_HEALTH;

/// Pause before the second restart in a row; it doubles up to the longest. The first restart is immediate.
const FIRST_BACK_OFF: Duration = Duration::from_millis(50);
/// Longest pause before a restart.
const LONGEST_BACK_OFF: Duration = Duration::from_secs(5);
/// A process that has lived this long did not die of its start: the pauses begin anew.
const HEALTHY_LIFE: Duration = Duration::from_secs(2);
/// External kills in a row, of ready processes, that are not a sign of a fault: an operator or a test kills at any
/// rate. The kernel, when memory runs out, would kill the next one too: from then on they count.
const KILLS_AT_ONCE: u32 = 10;
/// Shortest time that a process has for its first sign of life: it is loaded, reads its configuration and joins the
/// others, on a machine that may be busy.
const FIRST_SIGN_TIMEOUT: Duration = Duration::from_secs(30);
/// A supervisor that has not checked for this long was held up itself and cannot tell which process was silent.
const SUPERVISOR_STALL: Duration = Duration::from_secs(1);
/// Free shared memory below which a SIGBUS is attributed to its exhaustion, bytes: less than the smallest segment of
/// images.
const NEARLY_FULL_BYTES: u64 = 1 << 20;

/// Why a process ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Death {
    /// One line that names the process.
    pub cause: String,
    /// Whether it exited with an error of its own, which it would meet again.
    pub is_fault: bool,
    /// Whether memory that it had mapped was missing.
    pub is_bus_error: bool,
    /// Whether it was killed by a SIGKILL that its supervisor did not send.
    pub is_kill: bool,
}

/// One of the three processes.
#[derive(Debug)]
pub struct Supervised {
    /// Its published health.
    pub peer: Peer,
    child: Option<Child>,
    /// When the next start is due, while it does not run.
    due: Option<Instant>,
    /// Restarts in a row of processes that died young.
    hasty_restarts: u32,
    /// Kills in a row that did not count as such.
    kills: u32,
    /// Causes of the restarts so far, each with its count.
    causes: Vec<(String, u64)>,
    last_sign: Instant,
    last_look: Instant,
    was_ready: bool,
}

impl Supervised {
    /// A process that is due to start.
    pub fn new(peer: Peer) -> Self {
        let now = Instant::now();
        Self {
            peer,
            child: None,
            due: Some(now),
            hasty_restarts: 0,
            kills: 0,
            causes: Vec::new(),
            last_sign: now,
            last_look: now,
            was_ready: false,
        }
    }

    /// Its name.
    pub fn name(&self) -> &'static str {
        self.peer.name()
    }

    /// The process itself, if it was started and its end has not been noticed.
    pub fn child(&mut self) -> Option<&mut Child> {
        self.child.as_mut()
    }

    /// Whether it is due to start now.
    pub fn is_due(&self) -> bool {
        self.due.is_some_and(|due| due <= Instant::now())
    }

    /// Notes that it was started.
    pub fn run(&mut self, child: Child) {
        (self.child, self.due, self.was_ready) = (Some(child), None, false);
        (self.last_sign, self.last_look) = (Instant::now(), Instant::now());
    }

    /// Receives its published health.
    pub fn listen(&mut self) -> Result<(), ReceiveError> {
        // The last health of a process that has ended is kept; that of a killed one has been counted already.
        let Some(pid) = self.child.as_ref().map(Child::id) else { return Ok(()) };
        let now = Instant::now();
        let before = self.peer.last().map(|health| health.published_nanos);
        let last = self.peer.update()?.map(|health| (health.process_id, health.published_nanos));
        // Not the last message of its predecessor.
        let is_own = last.is_some_and(|(id, _)| id == pid);
        let was_held_up = now.duration_since(self.last_look) > SUPERVISOR_STALL;
        if was_held_up || is_own && last.map(|(_, nanos)| nanos) != before {
            self.last_sign = now;
        }
        self.was_ready |= is_own && self.peer.is_ready();
        self.last_look = now;
        if !is_own {
            self.peer.forget();
        }
        Ok(())
    }

    /// Whether it has given no sign of life for longer than `watchdog` allows.
    pub fn is_silent(&self, watchdog: Duration) -> bool {
        if watchdog.is_zero() || self.child.is_none() {
            return false;
        }
        let has_spoken = self.peer.last().is_some();
        let allowed = if has_spoken { watchdog } else { watchdog.max(FIRST_SIGN_TIMEOUT) };
        let is_at_its_end =
            matches!(self.peer.state(), Some(ProcessState::Finished | ProcessState::Failed));
        let writes_map = self.peer.last().is_some_and(|last| cause(last) == WRITES_MAP);
        let silence = self.last_look.duration_since(self.last_sign);
        // A process at its end has sent its last message, and has as long as any other to exit. One that writes its map
        // gives a sign between two keyframes, each of which a slow disk may delay.
        let extra = if is_at_its_end || writes_map { FIRST_SIGN_TIMEOUT } else { Duration::ZERO };
        silence > allowed + extra
    }

    /// How it ended, if it did; a process without a sign of life is killed. An orderly end (`None` within) is not a
    /// death.
    pub fn poll(&mut self, watchdog: Duration) -> io::Result<Option<Option<Death>>> {
        let is_silent = self.is_silent(watchdog);
        let name = self.peer.name();
        let Some(child) = &mut self.child else { return Ok(None) };
        if let Some(status) = child.poll()? {
            let fault = child.fault();
            // Its last health; without it its counts are slightly older.
            drop(self.listen());
            self.note_end();
            // Only capture ends without being stopped: with its source.
            let is_end = status.success() && name == CAPTURE_HEALTH.owner;
            return Ok(Some((!is_end).then(|| death(name, status, fault))));
        }
        if !is_silent {
            return Ok(None);
        }
        let liveness = Liveness::of(child.id());
        child.kill();
        self.note_end();
        let cause = hang(name, liveness);
        Ok(Some(Some(Death { cause, is_fault: false, is_bus_error: false, is_kill: false })))
    }

    /// Notes its end: its life counts for the pause before the next start.
    fn note_end(&mut self) {
        // A process that never became ready died of its start, however long that took.
        if self.was_ready && self.child.as_ref().is_some_and(|child| child.age() > HEALTHY_LIFE) {
            (self.hasty_restarts, self.kills) = (0, 0);
        }
        self.child = None;
    }

    /// Whether it is restarted after this death: a process that reports a fault of its own would meet it again, unless
    /// it has just replaced another and found the place not yet cleared, or another was killed at that time
    /// (`is_after_kill`), whose half-made ports it met.
    pub fn may_restart(&self, death: &Death, is_after_kill: bool, max_restarts: u32) -> bool {
        let is_own = death.is_fault && (self.was_ready || self.restarts() == 0);
        (is_after_kill || !is_own)
            && (self.is_external_kill(death) || self.hasty_restarts < max_restarts)
    }

    /// Whether this death shows nothing about the process: it was ready, and was killed from outside.
    fn is_external_kill(&self, death: &Death) -> bool {
        death.is_kill && self.was_ready && self.kills < KILLS_AT_ONCE
    }

    /// Plans the next start: at once for a process that had lived, with growing pauses for one that dies of its start.
    pub fn plan_restart(&mut self, death: Death) {
        if self.is_external_kill(&death) {
            self.due = Some(Instant::now());
            self.kills += 1;
        } else {
            self.due = Some(Instant::now() + back_off(self.hasty_restarts));
            self.hasty_restarts += 1;
        }
        match self.causes.iter_mut().find(|(cause, _)| *cause == death.cause) {
            Some((_, count)) => *count += 1,
            None => self.causes.push((death.cause, 1)),
        }
    }

    /// Number of restarts.
    pub fn restarts(&self) -> u64 {
        self.causes.iter().map(|(_, count)| count).sum()
    }

    /// Causes of the restarts, each with its count.
    pub fn restart_causes(&self) -> impl Iterator<Item = RestartCause> {
        let process = self.name();
        self.causes.iter().map(move |(cause, count)| RestartCause {
            process: process.to_owned(),
            cause: cause.clone(),
            count: *count,
        })
    }
}

fn back_off(hasty_restarts: u32) -> Duration {
    match hasty_restarts {
        0 => Duration::ZERO,
        n => (FIRST_BACK_OFF * 2_u32.saturating_pow((n - 1).min(8))).min(LONGEST_BACK_OFF),
    }
}

fn death(name: &str, status: ExitStatus, fault: Option<String>) -> Death {
    let is_bus_error = status.signal() == Some(Signal::BUS.as_raw());
    let is_fault = fault.is_some();
    let cause = match (fault, status.signal()) {
        (Some(fault), _) => fault,
        (None, Some(_)) if is_bus_error => bus_error(name, free_shared_memory().ok()),
        (None, Some(signal)) => format!("{name} was killed by {}", signal_name(signal)),
        (None, None) => format!("{name} ended with {status} in the middle of the run"),
    };
    let is_kill = status.signal() == Some(Signal::KILL.as_raw());
    Death { cause, is_fault, is_bus_error, is_kill }
}

/// The meaning of a SIGBUS: a page that was promised is missing.
fn bus_error(name: &str, free_bytes: Option<u64>) -> String {
    match free_bytes {
        Some(free) if free < NEARLY_FULL_BYTES => format!(
            "{name} was killed by SIGBUS: {SHARED_MEMORY} is full ({} kB free); remove what other programs left there, or enlarge it (mount -o remount,size=…)",
            free >> 10
        ),
        _ => format!(
            "{name} was killed by SIGBUS: a page it had mapped was not available; check the free space of {SHARED_MEMORY} and of the disk of the recording"
        ),
    }
}

/// Without the time, so that equal causes are one line of the summary, with their count.
fn hang(name: &str, liveness: Liveness) -> String {
    match liveness {
        Liveness::Stopped => format!(
            "{name} was stopped (SIGSTOP or a debugger) and gave no sign of life for longer than supervisor.watchdog_s; it was killed"
        ),
        _ => format!(
            "{name} hung: no sign of life for longer than supervisor.watchdog_s; it was killed"
        ),
    }
}

fn signal_name(signal: i32) -> String {
    match Signal::from_named_raw(signal) {
        Some(Signal::KILL) => {
            "SIGKILL (by hand, or by the kernel because memory ran out)".to_owned()
        }
        Some(Signal::SEGV) => "SIGSEGV".to_owned(),
        Some(Signal::ABORT) => "SIGABRT".to_owned(),
        Some(Signal::TERM) => "SIGTERM".to_owned(),
        Some(Signal::INT) => "SIGINT".to_owned(),
        _ => format!("signal {signal}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::place::Place;
    use crate::wire::port::{Access, Hub};

    #[test]
    fn the_first_restart_is_immediate_and_pauses_grow_to_a_bound() {
        assert_eq!(back_off(0), Duration::ZERO);
        assert_eq!(back_off(1), FIRST_BACK_OFF);
        assert_eq!(back_off(2), 2 * FIRST_BACK_OFF);
        assert!((3..40).all(|n| back_off(n) > back_off(2) && back_off(n) <= LONGEST_BACK_OFF));
        assert_eq!(back_off(u32::MAX), LONGEST_BACK_OFF);
    }

    #[test]
    fn a_fault_of_its_own_forbids_a_restart_and_one_after_a_kill_does_not() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let hub = Hub::join(&place, "supervisor", Access::Member).unwrap();
        let mut process = Supervised::new(Peer::open(&hub, &CAPTURE_HEALTH).unwrap());
        let fault = death("capture", ExitStatus::from_raw(1 << 8), Some("no port".to_owned()));
        let kill = death("capture", ExitStatus::from_raw(9), None);
        let may = |process: &Supervised, death, is_after_kill| {
            process.may_restart(death, is_after_kill, 2)
        };
        assert!(!may(&process, &fault, false), "its first start");
        assert!(may(&process, &fault, true) && may(&process, &kill, false));
        process.plan_restart(fault.clone());
        assert!(may(&process, &fault, false), "it came into the place of another");
        process.was_ready = true;
        assert!(!may(&process, &fault, false) && may(&process, &fault, true));
        process.plan_restart(fault.clone());
        assert!(!may(&process, &fault, true), "too often");
        // Kills of a ready process show nothing about it, until there are many.
        for _ in 0..KILLS_AT_ONCE {
            assert!(may(&process, &kill, false));
            process.plan_restart(kill.clone());
            assert!(process.due.is_some_and(|due| due <= Instant::now()), "at once");
        }
        assert!(!may(&process, &kill, false), "too many");
        process.kills = 0;
        process.was_ready = false;
        assert!(!may(&process, &kill, false), "of its start");
        drop((process, hub));
        place.tidy();
    }

    #[test]
    fn a_death_names_its_cause() {
        let of = |raw: i32| death("mapper", ExitStatus::from_raw(raw), None);
        let killed = of(9);
        assert!(killed.cause.starts_with("mapper was killed by SIGKILL"), "{killed:?}");
        assert!(!killed.is_bus_error && !killed.is_fault);
        assert!(of(7).is_bus_error && of(7).cause.contains("SIGBUS"), "{:?}", of(7));
        assert_eq!(of(3 << 8).cause, "mapper ended with exit status: 3 in the middle of the run");
        let fault = death("mapper", ExitStatus::from_raw(1 << 8), Some("no disk".to_owned()));
        assert_eq!((fault.cause.as_str(), fault.is_fault), ("no disk", true));
        assert!(bus_error("mapper", Some(4096)).contains("/dev/shm is full (4 kB free)"));
        assert!(!bus_error("mapper", Some(1 << 30)).contains("is full"));
    }
}
