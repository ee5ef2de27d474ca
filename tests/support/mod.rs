//! What the tests of the real binary share: an instance of its own for each test, and watch-dogs.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use semidense::wire::place::{Place, SHARED_MEMORY};
use semidense::wire::port::{Access, Hub};

/// Far above anything that is expected: it ends a test that hangs, it measures nothing.
pub const WATCH_DOG: Duration = Duration::from_secs(240);

/// An instance of its own: folder, prefix of shared memory, output.
pub struct Rig {
    folder: tempfile::TempDir,
}

/// The simulated camera of the tests, as keys below `simulator`.
pub fn small_camera(frames: usize) -> [String; 4] {
    let fixed = |setting: &str| setting.to_owned();
    [format!("frames={frames}"), fixed("width=160"), fixed("height=120"), fixed("focal_px=131.0")]
}

/// How a command ended.
pub struct Ended {
    pub status: ExitStatus,
    pub stdout: String,
    pub stderr: String,
}

impl Rig {
    pub fn new() -> Self {
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

    /// What is left of this instance in shared memory and in its folder.
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

/// Asks again and again until there is an answer.
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

/// Waits for the end of a child; one that hangs is killed and fails the test.
pub fn end(mut child: Child) -> Ended {
    let start = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if start.elapsed() > WATCH_DOG {
            child.kill().unwrap();
            let output = child.wait_with_output().unwrap();
            panic!("it hangs; it said: {}", String::from_utf8_lossy(&output.stderr));
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let output = child.wait_with_output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Ended { status: output.status, stdout: text(&output.stdout), stderr: text(&output.stderr) }
}

/// Starts a command and waits for its end.
pub fn finish(mut command: Command) -> Ended {
    end(command.spawn().unwrap())
}

/// Sends a signal to a child.
pub fn signal(child: &Child, signal: rustix::process::Signal) {
    rustix::process::kill_process(rustix::process::Pid::from_child(child), signal).unwrap();
}
