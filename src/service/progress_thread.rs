//! Hands the progress of a run to a thread that shows it, so that the run never waits for a stopped terminal or for a
//! pipe without a reader.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;

use crate::service::clock::wait_at_most;
use crate::service::run_progress::RunProgress;

/// Longest wait for the thread at the end.
const LONGEST_FINISH: Duration = Duration::from_secs(1);

/// The thread and its input.
#[derive(Debug)]
pub struct ProgressThread {
    thread: JoinHandle<()>,
    handed: Arc<PendingProgress>,
}

/// The newest progress replaces one that was not shown yet.
#[derive(Debug)]
struct PendingProgress {
    newest: ArrayQueue<RunProgress>,
    is_over: AtomicBool,
}

impl ProgressThread {
    /// Starts it with a function that shows progress; `None` is the end.
    pub fn start(mut show: impl FnMut(Option<&RunProgress>) + Send + 'static) -> io::Result<Self> {
        let newest = ArrayQueue::new(1);
        let handed = Arc::new(PendingProgress { newest, is_over: AtomicBool::new(false) });
        let taken = Arc::clone(&handed);
        let thread = std::thread::Builder::new().name("semidense-display".to_owned());
        let thread = thread.spawn(move || {
            while !taken.is_over.load(Ordering::Acquire) {
                match taken.newest.pop() {
                    Some(progress) => show(Some(&progress)),
                    None => std::thread::park(),
                }
            }
            show(None);
        })?;
        Ok(Self { thread, handed })
    }

    /// Hands over the progress, without waiting.
    pub fn show(&self, progress: &RunProgress) {
        self.handed.newest.force_push(progress.clone());
        self.thread.thread().unpark();
    }

    /// Ends it; waits at most a second for a thread that cannot write.
    pub fn finish(self) {
        self.handed.is_over.store(true, Ordering::Release);
        self.thread.thread().unpark();
        wait_at_most(LONGEST_FINISH, || self.thread.is_finished());
    }
}
