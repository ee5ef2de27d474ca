//! Shared parts of the tests of the real binary: a separate instance for each test, and watch-dogs.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Once};
use std::time::{Duration, Instant};

use semidense::service::journal::recovered::Recovered;
use semidense::service::shutdown::is_ignored;
use semidense::wire::folders::SHARED_MEMORY;
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub};
use signal_hook::consts::SIGHUP;

/// Far above any expected duration: it ends a test that hangs, it measures nothing.
pub const WATCH_DOG: Duration = Duration::from_secs(240);

/// A separate instance: folder, prefix of shared memory, output.
pub struct Rig {
    folder: tempfile::TempDir,
}

/// The simulated camera of the tests, as keys below `simulator`.
pub fn small_camera(frames: usize) -> [String; 4] {
    let fixed = |setting: &str| setting.to_owned();
    [format!("frames={frames}"), fixed("width=160"), fixed("height=120"), fixed("focal_px=131.0")]
}

/// Result of a finished command.
pub struct Ended {
    pub status: ExitStatus,
    pub stdout: String,
    pub stderr: String,
}

impl Rig {
    pub fn new() -> Self {
        hear_hang_ups();
        Self { folder: tempfile::tempdir().unwrap() }
    }

    pub fn root(&self) -> PathBuf {
        self.folder.path().join("root")
    }

    pub fn output(&self) -> PathBuf {
        self.folder.path().join("output")
    }

    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    pub fn place(&self) -> Place {
        Place::new("semidense", self.root().to_str().unwrap()).unwrap()
    }

    /// The real binary with these arguments.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_semidense"));
        command
            .args(arguments)
            .env("SEMIDENSE_ROOT", self.root())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    /// `run` on a small simulated camera, with more arguments.
    pub fn run(&self, frames: usize, arguments: &[&str]) -> Command {
        let mut command = self.command(&["run", "--output", self.output().to_str().unwrap()]);
        for setting in small_camera(frames) {
            command.args(["--set", &format!("simulator.{setting}")]);
        }
        command.args(arguments);
        command
    }

    /// Joins as an observer as soon as something runs.
    pub fn observe(&self) -> Hub {
        until("somebody to observe", || Hub::join(&self.place(), "observer", Access::Observer).ok())
    }

    /// The remains of this instance in shared memory and in its folder.
    pub fn leftovers(&self) -> Vec<String> {
        let names = |folder: &Path| {
            let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
            entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect::<Vec<_>>()
        };
        let mut left = names(&self.root());
        let prefix = self.place().prefix;
        left.extend(names(Path::new(SHARED_MEMORY)).into_iter().filter(|n| n.starts_with(&prefix)));
        left
    }
}

/// Lets children hear SIGHUP even if the tests were started with `nohup`: a signal that is handled here has its default
/// effect there.
fn hear_hang_ups() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        if is_ignored(SIGHUP) {
            signal_hook::flag::register(SIGHUP, Arc::default()).unwrap();
        }
    });
}

/// Calls `ask` repeatedly until there is an answer.
pub fn until<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(start.elapsed() < WATCH_DOG, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The journal of the run that writes to `folder`, once it contains `poses` poses, including lost ones.
pub fn journal_of(folder: &Path, poses: usize) -> PathBuf {
    until("a journal", || {
        let mut entries = fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
        let journal = entries.find(|path| path.to_string_lossy().contains(".semidense-journal"))?;
        (Recovered::read(&journal).ok()?.recording.num_poses() >= poses).then_some(journal)
    })
}

/// Waits for the end of a child; one that hangs is killed and fails the test. Its output is read meanwhile, so that a
/// full pipe does not block it.
pub fn end(mut child: Child) -> Ended {
    let stdout = child.stdout.take().map(read_all);
    let stderr = child.stderr.take().map(read_all);
    let start = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break Some(status);
        }
        if start.elapsed() > WATCH_DOG {
            child.kill().unwrap();
            child.wait().unwrap();
            break None;
        }
        std::thread::sleep(Duration::from_millis(10));
    };
    let text = |read: Option<Receiver<String>>| {
        let said = |read: Receiver<String>| read.recv_timeout(WATCH_DOG);
        read.map_or(Ok(String::new()), said).expect("somebody else holds its standard error")
    };
    let (stdout, stderr) = (text(stdout), text(stderr));
    let Some(status) = status else { panic!("it hangs; it said: {stderr}") };
    Ended { status, stdout, stderr }
}

/// Reads to the end on a separate thread.
fn read_all(mut pipe: impl Read + Send + 'static) -> Receiver<String> {
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        pipe.read_to_end(&mut bytes).unwrap();
        // The receiver is gone if its wait timed out.
        let _ = sender.send(String::from_utf8_lossy(&bytes).into_owned());
    });
    receiver
}

/// Set where tests that need their own mounts cannot run and are to be skipped.
const WITHOUT_MOUNTS: &str = "SEMIDENSE_TEST_WITHOUT_MOUNTS";

/// Runs `script` in a shell with its own mounts, after `mount`, with the binary in $SEMIDENSE; as root, or as root of
/// a user namespace. If neither is allowed the test fails, or with [`WITHOUT_MOUNTS`] there is no result.
pub fn with_mount(rig: &Rig, mount: &str, script: &str) -> Option<Ended> {
    let shell = |options: &[&str], script: &str| {
        let binary = rig.command(&[]).get_program().to_owned();
        let mut command = Command::new("unshare");
        command.args(options).args(["--mount", "sh", "-c", script]).env("SEMIDENSE", binary);
        command.env("SEMIDENSE_ROOT", rig.root()).env("OUTPUT", rig.output());
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    };
    let ways: [&[&str]; 2] = [&[], &["--user", "--map-root-user"]];
    let may =
        |way: &&&[&str]| shell(way, mount).output().is_ok_and(|output| output.status.success());
    match ways.iter().find(may) {
        Some(way) => Some(finish(shell(way, &format!("{mount} && {script}")))),
        None if std::env::var_os(WITHOUT_MOUNTS).is_some() => None,
        None => panic!(
            "this user may not mount (unshare --mount, unshare --user): run the test as root, or leave it out with {WITHOUT_MOUNTS}=1"
        ),
    }
}

/// Starts a command and waits for its end.
pub fn finish(mut command: Command) -> Ended {
    end(command.spawn().unwrap())
}

/// Sends a signal to a child.
pub fn signal(child: &Child, signal: rustix::process::Signal) {
    rustix::process::kill_process(rustix::process::Pid::from_child(child), signal).unwrap();
}
