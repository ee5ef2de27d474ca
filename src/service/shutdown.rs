//! Shutdown as a value: SIGINT and SIGTERM set it, every wait wakes by it, every loop looks at it.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};

/// Whether the process shall end, and a descriptor that is readable from then on.
#[derive(Debug)]
pub struct Shutdown {
    requested: Arc<AtomicBool>,
    readable: UnixStream,
}

impl Shutdown {
    /// Takes over SIGINT and SIGTERM.
    pub fn install() -> io::Result<Self> {
        let requested = Arc::new(AtomicBool::new(false));
        let (readable, writable) = UnixStream::pair()?;
        for signal in [SIGINT, SIGTERM] {
            // The flag first: whoever is woken by the descriptor must find it set.
            signal_hook::flag::register(signal, Arc::clone(&requested))?;
            signal_hook::low_level::pipe::register(signal, writable.try_clone()?)?;
        }
        Ok(Self { requested, readable })
    }

    /// Whether the process shall end.
    pub fn is_requested(&self) -> bool {
        self.requested.load(Ordering::Acquire)
    }

    /// Readable once the process shall end.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.readable.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::port::wait;
    use std::time::{Duration, Instant};

    #[test]
    fn a_signal_ends_every_wait() {
        let shutdown = Shutdown::install().unwrap();
        assert!(!shutdown.is_requested());
        signal_hook::low_level::raise(SIGTERM).unwrap();
        let start = Instant::now();
        wait(&[], Some(shutdown.descriptor()), Duration::from_secs(600)).unwrap();
        assert!(shutdown.is_requested());
        assert!(start.elapsed() < Duration::from_secs(300), "it waited for the timeout");
    }
}
