//! Shared parts of the bridge's tests: a separate instance for each test, runs of the real binaries alongside
//! each other, and other projects' tools that check the output.

#![allow(dead_code, reason = "every test uses its part of what they share")]

#[cfg(any(feature = "ros2", feature = "zenoh"))]
pub mod machines;
#[cfg(any(feature = "ros2", feature = "zenoh"))]
pub mod network;
#[cfg(any(feature = "ros2", feature = "zenoh"))]
pub mod robot;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Far above any expected duration: it ends a test that hangs, it measures nothing.
pub const WATCH_DOG: Duration = Duration::from_secs(240);

/// A separate instance: its folder and its output.
pub struct Rig {
    folder: tempfile::TempDir,
}

impl Rig {
    /// In a folder with a short name: it contains sockets.
    pub fn new() -> Self {
        Self { folder: tempfile::tempdir_in("/tmp").unwrap() }
    }

    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    pub fn output(&self) -> PathBuf {
        self.folder().join("output")
    }

    fn command(&self, program: &Path) -> Command {
        let mut command = Command::new(program);
        // `semidense` finds the bridge there, wherever it is itself.
        let bridge = Path::new(env!("CARGO_BIN_EXE_semidense-bridge")).parent().unwrap();
        let path = std::env::var("PATH").unwrap_or_default();
        command
            .env("PATH", format!("{}:{path}", bridge.display()))
            .env("SEMIDENSE_ROOT", self.folder().join("root"))
            .current_dir(self.folder())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    /// `semidense-bridge` with these arguments.
    pub fn bridge(&self, arguments: &[&str]) -> Command {
        let mut command = self.command(Path::new(env!("CARGO_BIN_EXE_semidense-bridge")));
        command.args(arguments);
        command
    }

    /// `semidense run` on a small simulated camera, with more arguments.
    pub fn run(&self, frames: usize, arguments: &[&str]) -> Command {
        let mut command = self.command(&semidense());
        command.args(["run", "--output", self.output().to_str().unwrap()]);
        let camera = [
            format!("frames={frames}"),
            "width=160".into(),
            "height=120".into(),
            "focal_px=131.0".into(),
        ];
        for setting in camera {
            command.args(["--set", &format!("simulator.{setting}")]);
        }
        command.args(arguments);
        command
    }

    /// A live page on a free port, and its printed address.
    pub fn view(&self, arguments: &[&str]) -> (Process, String) {
        let arguments = [&["view", "--listen", "127.0.0.1:0"], arguments].concat();
        let mut process = Process::start(self.bridge(&arguments));
        let address = process.line();
        (process, address)
    }
}

/// The program `semidense`, which is built next to `semidense-bridge`.
pub fn semidense() -> PathBuf {
    let named = std::env::var_os("SEMIDENSE").map(PathBuf::from);
    let beside = Path::new(env!("CARGO_BIN_EXE_semidense-bridge")).with_file_name("semidense");
    let program = named.unwrap_or(beside);
    assert!(
        program.exists(),
        "{} is not there: build it with `cargo build --bin semidense`, with --release where the test has it",
        program.display()
    );
    program
}

/// A process that is killed when dropped.
pub struct Process {
    child: Child,
    stdout: BufReader<ChildStdout>,
}

impl Process {
    pub fn start(mut command: Command) -> Self {
        // Its errors are shown where the test fails; an unread pipe would block it.
        let mut child = command.stderr(Stdio::inherit()).spawn().unwrap();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        Self { child, stdout }
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The next line of its output.
    pub fn line(&mut self) -> String {
        let mut line = String::new();
        self.stdout.read_line(&mut line).unwrap();
        assert!(!line.is_empty(), "it ended without a word");
        line.trim_end().to_owned()
    }

    pub fn signal(&self, signal: &str) {
        assert!(
            Command::new("kill").args([signal, &self.id().to_string()]).status().unwrap().success()
        );
    }

    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Runs a command to its end; one that hangs is killed and fails the test.
pub fn finish(mut command: Command) -> Output {
    let child = command.spawn().unwrap();
    let id = child.id();
    let (sender, over) = std::sync::mpsc::channel::<()>();
    let dog = std::thread::spawn(move || {
        if over.recv_timeout(WATCH_DOG) == Err(std::sync::mpsc::RecvTimeoutError::Timeout) {
            let _ = Command::new("kill").args(["-KILL", &id.to_string()]).status();
        }
    });
    let output = child.wait_with_output().unwrap();
    drop(sender);
    dog.join().unwrap();
    output
}

/// The same for a command that must succeed; returns its output.
pub fn succeed(command: Command) -> String {
    let output = finish(command);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{}\n{}", text(&output.stdout), text(&output.stderr));
    text(&output.stdout)
}

/// Calls `ask` repeatedly until there is an answer.
pub fn until<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(start.elapsed() < WATCH_DOG, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Folder of other projects' tools, as installed by `bridge/tests/tools`.
pub fn tools() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/test-tools")
}

/// Whether a tool is installed. In CI it must be; elsewhere the test reports that it is skipped.
pub fn has_tool(path: &Path) -> bool {
    let is_there = path.exists();
    assert!(
        is_there || std::env::var_os("SEMIDENSE_CI").is_none(),
        "{} is missing",
        path.display()
    );
    if !is_there {
        eprintln!("left out: {} is missing; bridge/tests/tools installs it", path.display());
    }
    is_there
}

/// Sends bytes to an address `http://HOST:PORT/…` and returns the whole answer.
pub fn ask(address: &str, request: &[u8]) -> String {
    let host = address.strip_prefix("http://").unwrap().split('/').next().unwrap();
    let mut stream = TcpStream::connect(host.parse::<SocketAddr>().unwrap()).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    stream.write_all(request).unwrap();
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).into_owned()
}

/// Requests a path with the usual head and further lines.
pub fn get(address: &str, path: &str, lines: &str) -> String {
    let host = address.strip_prefix("http://").unwrap().split('/').next().unwrap();
    ask(address, format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n{lines}\r\n").as_bytes())
}
