//! The thread for joint estimation of keyframes.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::event::{EventfdFlags, eventfd};
use rustix::time::{ClockId, clock_gettime};

use crate::service::schedule::{Background, apply_background};
use crate::slam::window::{Adjustment, Window};

/// Longest wait for the estimate in flight when the process ends: a process told to stop must end at once, and the
/// thread holds nothing but memory, which ends with the process.
const JOIN_TIMEOUT: Duration = Duration::from_millis(20);

/// Estimates a window: [`Window::optimise`], or a test's replacement.
pub(super) type Optimise = Box<dyn FnMut(&mut Window) -> Option<Adjustment> + Send>;

/// A window that has come back.
pub(super) struct Finished {
    pub window: Box<Window>,
    /// `None` where there was too little to estimate.
    pub adjustment: Option<Adjustment>,
    /// CPU time it took.
    pub nanos: u64,
}

/// Sends one window at a time to the thread and receives it back.
pub(super) struct AdjustmentThread {
    windows: Option<SyncSender<Box<Window>>>,
    finished: Receiver<Finished>,
    /// Readable when a window has come back.
    wake: OwnedFd,
    thread: Option<JoinHandle<()>>,
}

impl AdjustmentThread {
    pub fn start(background: Background, mut optimise: Optimise) -> io::Result<Self> {
        let (windows, theirs) = sync_channel::<Box<Window>>(1);
        let (back, finished) = sync_channel(1);
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        let waker = wake.try_clone()?;
        let run = move || {
            if let Err(error) = apply_background(background) {
                tracing::warn!("joint estimation: {error}");
            }
            while let Ok(mut window) = theirs.recv() {
                let begin = cpu_nanos();
                let adjustment = optimise(&mut window);
                let nanos = cpu_nanos().saturating_sub(begin);
                if back.send(Finished { window, adjustment, nanos }).is_err() {
                    return;
                }
                // Full only after 2⁶⁴ windows that were never fetched.
                let _ = rustix::io::write(&waker, &1_u64.to_ne_bytes());
            }
        };
        let thread = std::thread::Builder::new().name("semidense-joint".to_owned()).spawn(run)?;
        Ok(Self { windows: Some(windows), finished, wake, thread: Some(thread) })
    }

    /// Hands a window over; the previous one must have come back.
    pub fn hand_over(&self, window: Box<Window>) {
        if let Some(windows) = &self.windows {
            // A thread that has ended is noticed when the window is waited for.
            drop(windows.try_send(window));
        }
    }

    /// Waits up to `timeout` for the window that was handed over; disconnected where the thread has panicked.
    pub fn wait_at_most(&self, timeout: Duration) -> Result<Finished, RecvTimeoutError> {
        let mut counted = [0; size_of::<u64>()];
        let _ = rustix::io::read(&self.wake, &mut counted);
        self.finished.recv_timeout(timeout)
    }

    /// Readable when a window has come back and has not been waited for since.
    pub fn descriptor(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }

    /// The thread's panic message; empty where it did not panic.
    pub fn panic_message(mut self) -> String {
        let Some(Err(cause)) = self.thread.take().map(JoinHandle::join) else {
            return String::new();
        };
        let text = cause.downcast_ref::<&str>().map(|text| (*text).to_owned());
        text.or_else(|| cause.downcast_ref::<String>().cloned()).unwrap_or_default()
    }
}

impl Drop for AdjustmentThread {
    fn drop(&mut self) {
        self.windows = None;
        let Some(thread) = self.thread.take() else { return };
        // The window in flight comes back, then the channel closes with the thread.
        while self.finished.recv_timeout(JOIN_TIMEOUT).is_ok() {}
        if matches!(self.finished.try_recv(), Err(TryRecvError::Disconnected)) {
            // A panic has been reported where it happened.
            drop(thread.join());
        }
    }
}

/// CPU time of the calling thread.
fn cpu_nanos() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    let (secs, nanos) = (u64::try_from(time.tv_sec), u64::try_from(time.tv_nsec));
    secs.unwrap_or(0).saturating_mul(1_000_000_000).saturating_add(nanos.unwrap_or(0))
}
