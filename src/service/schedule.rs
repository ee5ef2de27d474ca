//! Requests of a process to the kernel: policy and priority, CPUs, locked and touched memory, timer slack. A refusal is
//! a warning that names the limit to raise; the process continues without.

use std::mem::MaybeUninit;
use std::num::NonZeroU64;

use rustix::mm::MlockAllFlags;
use rustix::thread::CpuSet;
use serde::{Deserialize, Serialize};

use crate::slam::parameter::{ParameterError, check_range};

/// How the kernel schedules the frame loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Policy {
    /// As set for the process when it was started: by a unit, by chrt, or not at all.
    #[default]
    Inherit,
    /// Shared with every other process (SCHED_OTHER).
    Other,
    /// Ahead of everything of lower priority (SCHED_FIFO).
    Fifo,
    /// A guaranteed share of every period (SCHED_DEADLINE).
    Deadline,
}

/// How the kernel schedules a thread that no frame waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// Only when a CPU has nothing else to do (SCHED_IDLE): any other thread takes the CPU from it at once.
    #[default]
    Idle,
    /// Like the other threads of its process.
    Other,
}

/// Requests of a process to the kernel for its frame loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SchedulingParams {
    /// inherit, other, fifo or deadline. Inherit leaves what the systemd unit or chrt has set.
    pub policy: Policy,
    /// Priority of fifo, 1 to 99. Above the kernel's threaded interrupts (50) nothing else waits; capture
    /// comes before the tracker, or its frames would be late.
    pub priority: u32,
    /// Deadline: computing time within each period, milliseconds.
    pub runtime_ms: f64,
    /// Deadline: period, milliseconds; at most the time between two frames.
    pub period_ms: f64,
    /// CPUs that the frame loop may use, from 0; empty leaves all. Deadline accepts no CPUs.
    pub cpus: Vec<usize>,
    /// Whether all memory, present and future, stays in RAM (mlockall): no page fault in the loop.
    pub lock_memory: bool,
    /// How late the kernel may wake from a timed sleep, microseconds; 0 leaves the usual 50.
    pub timer_slack_us: u64,
}

impl Default for SchedulingParams {
    fn default() -> Self {
        Self {
            policy: Policy::Inherit,
            priority: 70,
            runtime_ms: 10.0,
            period_ms: 33.0,
            cpus: Vec::new(),
            lock_memory: false,
            timer_slack_us: 0,
        }
    }
}

/// Number of CPUs in the kernel's CPU set.
const MAX_CPU: usize = CpuSet::MAX_CPU;

impl SchedulingParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("priority", self.priority, 1..=99)?;
        check_range("runtime_ms", self.runtime_ms, 0.1..=1000.0)?;
        check_range("period_ms", self.period_ms, self.runtime_ms..=1000.0)?;
        for &cpu in &self.cpus {
            check_range("cpus", cpu, 0..=MAX_CPU - 1)?;
        }
        check_range("timer_slack_us", self.timer_slack_us, 0..=1_000_000)
    }
}

/// A request that the kernel refused, with the limit to raise.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum Refusal {
    /// The real-time policy, or its priority.
    #[error(
        "{0} scheduling refused ({2}): raise RLIMIT_RTPRIO to {1} (LimitRTPRIO= in the unit, rtprio in /etc/security/limits.conf)"
    )]
    RealTime(&'static str, u32, String),
    /// The deadline policy.
    #[error(
        "deadline scheduling refused ({0}): it needs CAP_SYS_NICE (AmbientCapabilities= in the unit), no CPU list, and a free share of the CPUs"
    )]
    Deadline(String),
    /// The idle policy.
    #[error(
        "idle scheduling refused ({0}): allow sched_setattr, or set mapper.background = \"other\""
    )]
    Background(String),
    /// The CPUs.
    #[error(
        "CPUs {0:?} refused ({1}): name CPUs that exist and that the unit's CPUAffinity= allows"
    )]
    Cpus(Vec<usize>, String),
    /// Locking memory.
    #[error(
        "locking memory refused ({0}): raise RLIMIT_MEMLOCK (LimitMEMLOCK=infinity in the unit, memlock in /etc/security/limits.conf)"
    )]
    Memory(String),
    /// The timer slack.
    #[error("timer slack refused ({0}): leave timer_slack_us at 0")]
    TimerSlack(String),
}

/// The scheduling in effect, as the kernel reports it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ActiveScheduling {
    /// Policy of the calling thread; `None` for an unknown one.
    pub policy: Option<Policy>,
    /// Priority of FIFO, else 0.
    pub priority: u32,
    /// Whether some memory of the process is locked.
    pub memory_locked: bool,
}

/// Policy numbers of the kernel (linux/sched.h).
const SCHED_OTHER: u32 = 0;
const SCHED_FIFO: u32 = 1;
const SCHED_IDLE: u32 = 5;
const SCHED_DEADLINE: u32 = 6;
/// Threads made later do not inherit the policy (linux/sched.h).
const SCHED_FLAG_RESET_ON_FORK: u64 = 1;
const NO_FLAGS: libc::c_uint = 0;
const THIS_THREAD: libc::pid_t = 0;

/// `struct sched_attr` of sched_setattr(2), its first version.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
struct SchedAttr {
    size: u32,
    policy: u32,
    flags: u64,
    nice: i32,
    priority: u32,
    runtime: u64,
    deadline: u64,
    period: u64,
}

/// Applies `params` to the calling thread (memory: to the process) and returns the refusals. Threads made later run as
/// SCHED_OTHER on the same CPUs.
pub fn apply(params: &SchedulingParams) -> Vec<Refusal> {
    let mut refusals = Vec::new();
    // Memory first: under FIFO, touching new pages would hold up everything else.
    if params.lock_memory {
        let flags = MlockAllFlags::CURRENT | MlockAllFlags::FUTURE;
        match rustix::mm::mlockall(flags) {
            Ok(()) => touch_stack(),
            Err(error) => refusals.push(Refusal::Memory(error.to_string())),
        }
    }
    if let Some(slack) = NonZeroU64::new(params.timer_slack_us.saturating_mul(1000))
        && let Err(error) = rustix::thread::set_current_timer_slack(Some(slack))
    {
        refusals.push(Refusal::TimerSlack(error.to_string()));
    }
    if !params.cpus.is_empty() {
        let mut set = CpuSet::new();
        params.cpus.iter().filter(|&&cpu| cpu < MAX_CPU).for_each(|&cpu| set.set(cpu));
        if let Err(error) = rustix::thread::sched_setaffinity(None, &set) {
            refusals.push(Refusal::Cpus(params.cpus.clone(), error.to_string()));
        }
    }
    refusals.extend(apply_policy(params).err());
    refusals
}

/// Makes the calling thread one that no frame waits for. The kernel never refuses this, a sandbox may.
pub fn apply_background(background: Background) -> Result<(), Refusal> {
    if background == Background::Other {
        return Ok(());
    }
    set_attributes(SchedAttr { policy: SCHED_IDLE, ..SchedAttr::default() })
        .map_err(|error| Refusal::Background(error.to_string()))
}

fn apply_policy(params: &SchedulingParams) -> Result<(), Refusal> {
    let nanos = |millis: f64| (millis * 1e6) as u64;
    let attributes = match params.policy {
        Policy::Inherit => return Ok(()),
        Policy::Other => SchedAttr { policy: SCHED_OTHER, ..SchedAttr::default() },
        Policy::Fifo => SchedAttr {
            policy: SCHED_FIFO,
            flags: SCHED_FLAG_RESET_ON_FORK,
            priority: params.priority,
            ..SchedAttr::default()
        },
        Policy::Deadline => SchedAttr {
            policy: SCHED_DEADLINE,
            flags: SCHED_FLAG_RESET_ON_FORK,
            runtime: nanos(params.runtime_ms),
            deadline: nanos(params.period_ms),
            period: nanos(params.period_ms),
            ..SchedAttr::default()
        },
    };
    let (name, priority) = match params.policy {
        Policy::Other => ("other", 0),
        _ => ("FIFO", params.priority),
    };
    set_attributes(attributes).map_err(|error| match params.policy {
        Policy::Deadline => Refusal::Deadline(error.to_string()),
        _ => Refusal::RealTime(name, priority, error.to_string()),
    })
}

fn set_attributes(attributes: SchedAttr) -> std::io::Result<()> {
    let attributes = SchedAttr { size: size_of::<SchedAttr>() as u32, ..attributes };
    // SAFETY: the kernel reads `size` bytes from a struct that is `#[repr(C)]` and of that size.
    let result = unsafe {
        libc::syscall(
            libc::SYS_sched_setattr,
            THIS_THREAD,
            std::ptr::from_ref(&attributes),
            NO_FLAGS,
        )
    };
    if result == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
}

/// The scheduling of the calling thread, as the kernel reports it.
pub fn active_scheduling() -> ActiveScheduling {
    let mut attributes = SchedAttr::default();
    let size = size_of::<SchedAttr>() as libc::c_uint;
    // SAFETY: the kernel writes at most `size` bytes to a struct of that size whose every bit pattern is
    // valid.
    let result = unsafe {
        libc::syscall(
            libc::SYS_sched_getattr,
            THIS_THREAD,
            std::ptr::from_mut(&mut attributes),
            size,
            NO_FLAGS,
        )
    };
    let policy = match attributes.policy {
        _ if result != 0 => None,
        SCHED_OTHER => Some(Policy::Other),
        SCHED_FIFO => Some(Policy::Fifo),
        SCHED_DEADLINE => Some(Policy::Deadline),
        _ => None,
    };
    let priority = if policy == Some(Policy::Fifo) { attributes.priority } else { 0 };
    ActiveScheduling {
        policy,
        priority,
        memory_locked: locked_kilobytes().is_some_and(|kb| kb > 0),
    }
}

/// Locked memory of this process according to the kernel.
fn locked_kilobytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmLck:"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Touches the stack that the frame loop will use, so that its pages are present.
fn touch_stack() {
    /// More than the deepest call of a frame uses, far less than the 8 MB of a main thread.
    const STACK_BYTES: usize = 256 << 10;
    let stack = [MaybeUninit::<u8>::zeroed(); STACK_BYTES];
    std::hint::black_box(&stack);
}

/// Page faults of the calling thread so far, with and without I/O. One system call, no allocation.
pub fn thread_page_faults() -> u64 {
    let count = |value: libc::c_long| u64::try_from(value).unwrap_or(0);
    usage(libc::RUSAGE_THREAD).map_or(0, |of| count(of.ru_minflt) + count(of.ru_majflt))
}

/// Largest resident memory of this process so far; `None` where the kernel does not report it. One system call, no
/// allocation.
pub fn peak_rss_bytes() -> Option<u64> {
    const BYTES_PER_KB: u64 = 1024;
    u64::try_from(usage(libc::RUSAGE_SELF)?.ru_maxrss).ok()?.checked_mul(BYTES_PER_KB)
}

/// Makes the allocator map every large block separately and unmap it when freed. Otherwise glibc raises its threshold
/// with the first one freed and keeps the gaps between remaining blocks: an eighth of a replay's memory, a quarter with
/// its results.
pub fn give_back_large_blocks() {
    #[cfg(target_env = "gnu")]
    {
        /// glibc's initial threshold; an image of 640×480 is larger.
        const LARGE_BYTES: libc::c_int = 128 << 10;
        // SAFETY: it sets a number of the allocator, which takes its own lock.
        unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BYTES) };
    }
}

fn usage(who: libc::c_int) -> Option<libc::rusage> {
    let mut usage = MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: the kernel fills the struct it is given; all its fields are integers, so that zeros are
    // valid already.
    unsafe { (libc::getrusage(who, usage.as_mut_ptr()) == 0).then(|| usage.assume_init()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs in a separate thread: other threads of the test runner keep their scheduling.
    fn in_thread<T: Send + 'static>(run: impl FnOnce() -> T + Send + 'static) -> T {
        std::thread::spawn(run).join().unwrap()
    }

    #[test]
    fn a_request_is_in_force_or_refused_with_its_limit() {
        let asked = SchedulingParams { policy: Policy::Fifo, priority: 42, ..Default::default() };
        let (refusals, found) = in_thread(move || (apply(&asked), active_scheduling()));
        match refusals.first() {
            None => assert_eq!((found.policy, found.priority), (Some(Policy::Fifo), 42)),
            Some(refusal) => {
                assert!(refusal.to_string().contains("LimitRTPRIO"), "{refusal}");
                assert_eq!(found.policy, Some(Policy::Other));
            }
        }
    }

    #[test]
    fn threads_of_a_real_time_thread_are_ordinary() {
        let asked = SchedulingParams { policy: Policy::Fifo, ..Default::default() };
        let found = in_thread(move || {
            apply(&asked);
            in_thread(active_scheduling)
        });
        assert_eq!(found.policy, Some(Policy::Other));
    }

    #[test]
    fn cpus_are_chosen_or_refused() {
        let asked = SchedulingParams { cpus: vec![0], ..Default::default() };
        let (refusals, cpu) = in_thread(move || (apply(&asked), rustix::thread::sched_getcpu()));
        assert!(!refusals.is_empty() || cpu == 0, "runs on {cpu}");
        let absent = SchedulingParams { cpus: vec![MAX_CPU - 1], ..Default::default() };
        let refusals = in_thread(move || apply(&absent));
        assert!(refusals[0].to_string().contains("CPUAffinity"), "{refusals:?}");
    }

    #[test]
    fn nothing_changes_unless_requested() {
        let (before, refusals, after) = in_thread(|| {
            (active_scheduling(), apply(&SchedulingParams::default()), active_scheduling())
        });
        assert_eq!((refusals, before), (Vec::new(), after));
    }

    #[test]
    fn page_faults_are_counted() {
        let (before, after) = in_thread(|| {
            let before = thread_page_faults();
            // More than the allocator ever keeps for reuse.
            std::hint::black_box(vec![1_u8; 64 << 20]);
            (before, thread_page_faults())
        });
        assert!(after > before, "{before} {after}");
        assert!(peak_rss_bytes().unwrap() > 1 << 20);
    }

    #[test]
    fn parameters_are_checked() {
        assert!(SchedulingParams::default().validate().is_ok());
        let wrong = |params: SchedulingParams| params.validate().unwrap_err().to_string();
        assert!(
            wrong(SchedulingParams { priority: 100, ..Default::default() }).contains("1 to 99")
        );
        assert!(
            wrong(SchedulingParams { period_ms: 5.0, ..Default::default() }).contains("period")
        );
        let far = SchedulingParams { cpus: vec![9999], ..Default::default() };
        assert!(wrong(far).contains("cpus"));
    }
}
