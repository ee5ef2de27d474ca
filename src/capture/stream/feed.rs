//! Origin of a stream's sender: a socket that any program may connect to, or a program that is started.

use std::io::ErrorKind;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use rustix::event::{PollFd, PollFlags};

use crate::capture::source::Absence;
use crate::capture::stream::INSTALL_BRIDGE;
use crate::capture::v4l::device::poll;

/// Pause before starting a sender, or opening a socket, again; doubled each time.
const FIRST_PAUSE_NANOS: i64 = 200_000_000;
/// The longest such pause.
const LONGEST_PAUSE_NANOS: i64 = 5_000_000_000;
/// A program that ran this long did not fail at its start.
const HEALTHY_NANOS: i64 = 10_000_000_000;
/// How long a program may take to end once its stream is closed: it says goodbye to its peers.
const GOODBYE_MILLIS: u32 = 1000;
/// Exit code of a program that does not understand its command line: starting it again does not help.
const WRONG_USAGE: i32 = 2;

/// Origin of the sender.
#[derive(Debug)]
pub enum Feed {
    /// It connects to a socket.
    Socket(Listener),
    /// It is a program that is started.
    Program(Program),
}

impl Feed {
    /// Returns the stream of a newly connected sender, once. `now` is CLOCK_MONOTONIC, nanoseconds.
    pub fn connect(&mut self, now: i64) -> Result<Option<UnixStream>, Absence> {
        let stream = match self {
            Self::Socket(listener) => listener.connect(now)?,
            Self::Program(program) => program.connect(now)?,
        };
        if let Some(stream) = &stream {
            let refused = |error| Absence::transient(format!("its stream was refused ({error})"));
            stream.set_nonblocking(true).map_err(refused)?;
        }
        Ok(stream)
    }

    /// Descriptor that becomes readable when a sender connects.
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        match self {
            Self::Socket(listener) => listener.listener.as_ref().map(AsFd::as_fd),
            Self::Program(_) => None,
        }
    }

    /// When to try again, CLOCK_MONOTONIC, if no descriptor signals it.
    pub fn retry_nanos(&self) -> Option<i64> {
        match self {
            Self::Socket(Listener { listener: Some(_), .. }) => None,
            Self::Socket(listener) => Some(listener.pause.retry_nanos),
            Self::Program(program) => Some(program.pause.retry_nanos),
        }
    }

    /// Why there is no sender.
    pub fn absence(&self) -> String {
        match self {
            Self::Socket(listener) => format!(
                "no program sends frames to {}; start the program that does",
                listener.path.display()
            ),
            Self::Program(program) => program.last.clone(),
        }
    }

    /// Records that the stream has ended.
    pub fn disconnected(&mut self, now: i64) {
        if let Self::Program(program) = self {
            program.ended(now);
        }
    }
}

/// Pauses that grow with every failure.
#[derive(Debug, Default)]
struct Pause {
    next_nanos: i64,
    retry_nanos: i64,
}

impl Pause {
    fn begin(&mut self, now: i64) {
        self.next_nanos = (2 * self.next_nanos).clamp(FIRST_PAUSE_NANOS, LONGEST_PAUSE_NANOS);
        self.retry_nanos = now.saturating_add(self.next_nanos);
    }
}

/// A socket that senders connect to, one at a time.
#[derive(Debug)]
pub struct Listener {
    path: PathBuf,
    listener: Option<UnixListener>,
    pause: Pause,
    last: String,
}

impl Listener {
    /// Creates a listener that will listen at `path`.
    pub fn new(path: PathBuf) -> Self {
        Self { path, listener: None, pause: Pause::default(), last: String::new() }
    }

    fn connect(&mut self, now: i64) -> Result<Option<UnixStream>, Absence> {
        let Some(listener) = &self.listener else {
            if now < self.pause.retry_nanos {
                return Err(Absence::transient(self.last.clone()));
            }
            let bound = bind(&self.path).inspect_err(|absence| {
                self.pause.begin(now);
                self.last.clone_from(&absence.reason);
            });
            self.listener = Some(bound?);
            return Ok(None);
        };
        match listener.accept() {
            Ok((stream, _)) => Ok(Some(stream)),
            Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(None),
            Err(error) => {
                let reason = format!("{}: no sender can connect ({error})", self.path.display());
                Err(Absence::transient(reason))
            }
        }
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        if self.listener.is_some() {
            // Otherwise the next process finds a socket without a listener, which it removes as well.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Listens at `path`, for processes of this user. A stale socket there is removed.
fn bind(path: &Path) -> Result<UnixListener, Absence> {
    let at = |reason: String| format!("{}: {reason}", path.display());
    let is_socket =
        || std::fs::symlink_metadata(path).is_ok_and(|entry| entry.file_type().is_socket());
    let listener = match UnixListener::bind(path) {
        Err(error) if error.kind() == ErrorKind::AddrInUse && is_socket() => {
            if UnixStream::connect(path).is_ok() {
                let reason = "another process receives frames there; stop it or name another path";
                return Err(Absence::transient(at(reason.to_owned())));
            }
            std::fs::remove_file(path).and_then(|()| UnixListener::bind(path))
        }
        Err(error) if error.kind() == ErrorKind::AddrInUse => {
            let reason = at("is a file; name a path where a socket can be created".to_owned());
            return Err(Absence { reason, passes: false });
        }
        outcome => outcome,
    };
    let open = || {
        let listener = listener?;
        // Any process that may write to the socket may send: restricted to this user's before the first is accepted.
        std::fs::set_permissions(path, PermissionsExt::from_mode(0o600))?;
        listener.set_nonblocking(true)?;
        Ok(listener)
    };
    open().map_err(|error: std::io::Error| Absence {
        reason: at(format!("a socket cannot be created there ({error}); name a path in a folder of this user, shorter than 108 bytes")),
        passes: false,
    })
}

/// A program that writes frames to its standard output, and ends when that is closed.
#[derive(Debug)]
pub struct Program {
    program: PathBuf,
    arguments: Vec<String>,
    child: Option<Child>,
    started_nanos: i64,
    pause: Pause,
    last: String,
    /// It does not understand its command line: starting it again is useless.
    is_misused: bool,
}

impl Program {
    /// Creates a feed that will start `program` with `arguments`.
    pub fn new(program: PathBuf, arguments: Vec<String>) -> Self {
        let last = format!("{} has not been started yet", program.display());
        let pause = Pause::default();
        Self { program, arguments, child: None, started_nanos: 0, pause, last, is_misused: false }
    }

    fn connect(&mut self, now: i64) -> Result<Option<UnixStream>, Absence> {
        if self.child.is_some() {
            return Ok(None);
        }
        if now < self.pause.retry_nanos || self.is_misused {
            return Err(Absence { reason: self.last.clone(), passes: !self.is_misused });
        }
        match self.start() {
            Ok(stream) => {
                self.started_nanos = now;
                Ok(Some(stream))
            }
            Err(error) => {
                let program = self.program.display();
                let is_missing = error.kind() == ErrorKind::NotFound;
                self.last = match is_missing {
                    true => format!("{program} is not installed: {INSTALL_BRIDGE}"),
                    false => format!("{program} cannot be started ({error})"),
                };
                self.pause.begin(now);
                Err(Absence { reason: self.last.clone(), passes: !is_missing })
            }
        }
    }

    fn start(&mut self) -> std::io::Result<UnixStream> {
        let (ours, theirs) = UnixStream::pair()?;
        let child = Command::new(&self.program)
            .args(&self.arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::from(OwnedFd::from(theirs)))
            .spawn()?;
        self.child = Some(child);
        Ok(ours)
    }

    /// Waits for the end of the program after its stream was closed, and kills it if necessary.
    fn ended(&mut self, now: i64) {
        let Some(mut child) = self.child.take() else { return };
        let program = self.program.display();
        let status = wait_or_kill(&mut child);
        self.last = match status {
            Some(status) => format!("{program} exited ({status}); restarting"),
            None => format!("{program} was stopped; restarting"),
        };
        if status.and_then(|status| status.code()) == Some(WRONG_USAGE) {
            self.last = format!("{program} does not understand `{}`", self.arguments.join(" "));
            self.is_misused = true;
        }
        if now.saturating_sub(self.started_nanos) >= HEALTHY_NANOS {
            self.pause = Pause::default();
        }
        self.pause.begin(now);
    }
}

/// Waits for a program that has been told to end; kills it and returns `None` if it does not.
fn wait_or_kill(child: &mut Child) -> Option<std::process::ExitStatus> {
    const STEP_MILLIS: u32 = 5;
    for _ in 0..GOODBYE_MILLIS / STEP_MILLIS {
        if let Ok(Some(status)) = child.try_wait() {
            return Some(status);
        }
        // Without a descriptor this is a sleep.
        let _ = poll(&mut [], STEP_MILLIS);
    }
    // A program that cannot be killed has already ended.
    let _ = child.kill();
    let _ = child.wait();
    None
}

/// Waits up to `millis` until one of `descriptors` can be read.
pub fn await_readable<'a>(descriptors: impl Iterator<Item = BorrowedFd<'a>>, millis: u32) {
    let mut polled: Vec<PollFd<'_>> =
        descriptors.map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN)).collect();
    // A signal ends the wait early; the caller checks everything anyway.
    let _ = poll(&mut polled, millis);
}

impl Drop for Program {
    fn drop(&mut self) {
        // Its stream is closed by now.
        if let Some(mut child) = self.child.take() {
            wait_or_kill(&mut child);
        }
    }
}
