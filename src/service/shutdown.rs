//! Shutdown as a value: SIGINT, SIGTERM and SIGHUP set it, every wait wakes on it, every loop checks it.

use std::io::{self, Read};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

/// Whether the process should end, and a descriptor that is readable from then on.
#[derive(Debug)]
pub struct Shutdown {
    requested: Arc<AtomicBool>,
    readable: UnixStream,
    /// One byte per SIGINT.
    interrupts: UnixStream,
    num_interrupts: AtomicUsize,
}

impl Shutdown {
    /// Takes over SIGINT (Ctrl-C), SIGTERM and, unless it is ignored (`nohup`), SIGHUP (the terminal is closed).
    pub fn install() -> io::Result<Self> {
        Self::with(None)
    }

    /// The same, and a Ctrl-C after any of these signals ends the process at once with the exit code `code`.
    pub fn install_final(code: u8) -> io::Result<Self> {
        Self::with(Some(code))
    }

    fn with(final_code: Option<u8>) -> io::Result<Self> {
        let requested = Arc::new(AtomicBool::new(false));
        let (readable, writable) = UnixStream::pair()?;
        let (interrupts, interrupted) = UnixStream::pair()?;
        interrupts.set_nonblocking(true)?;
        signal_hook::low_level::pipe::register(SIGINT, interrupted)?;
        if let Some(code) = final_code {
            // Before the flag is: the first signal must find it unset.
            let requested = Arc::clone(&requested);
            signal_hook::flag::register_conditional_shutdown(SIGINT, code.into(), requested)?;
        }
        let hang_up = (!is_ignored(SIGHUP)).then_some(SIGHUP);
        for signal in [SIGINT, SIGTERM].into_iter().chain(hang_up) {
            // The flag first: a thread woken by the descriptor must find it set.
            signal_hook::flag::register(signal, Arc::clone(&requested))?;
            signal_hook::low_level::pipe::register(signal, writable.try_clone()?)?;
        }
        Ok(Self { requested, readable, interrupts, num_interrupts: AtomicUsize::new(0) })
    }

    /// Whether the process should end.
    pub fn is_requested(&self) -> bool {
        self.requested.load(Ordering::Acquire)
    }

    /// Whether Ctrl-C was pressed twice: remaining waits are to be abandoned.
    pub fn is_urgent(&self) -> bool {
        const ENOUGH: usize = 2;
        let mut bytes = [0; ENOUGH];
        let new = (&self.interrupts).read(&mut bytes).unwrap_or(0);
        self.num_interrupts.fetch_add(new, Ordering::Relaxed) + new >= ENOUGH
    }

    /// Readable once the process should end.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.readable.as_fd()
    }
}

/// Whether this process was started with `signal` ignored.
pub fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    // Signals count from 1.
    mask >> (signal - 1) & 1 == 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::port::wait;
    use std::time::{Duration, Instant};

    #[test]
    fn a_signal_ends_every_wait() {
        // Under `nohup` a closed terminal ends nothing.
        for signal in [SIGTERM, SIGHUP, SIGINT].into_iter().filter(|&signal| !is_ignored(signal)) {
            let shutdown = Shutdown::install().unwrap();
            assert!(!shutdown.is_requested());
            signal_hook::low_level::raise(signal).unwrap();
            let start = Instant::now();
            wait(&[], Some(shutdown.descriptor()), Duration::from_secs(600)).unwrap();
            assert!(shutdown.is_requested() && !shutdown.is_urgent());
            assert!(start.elapsed() < Duration::from_secs(300), "it waited for the timeout");
        }
        let shutdown = Shutdown::install().unwrap();
        signal_hook::low_level::raise(SIGINT).unwrap();
        assert!(!shutdown.is_urgent());
        signal_hook::low_level::raise(SIGINT).unwrap();
        assert!(shutdown.is_urgent() && shutdown.is_urgent());
    }
}
