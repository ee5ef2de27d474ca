//! Programs on several machines: a runtime folder for each, and their output so far.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub};

use super::until;

/// A folder for an instance, removed together with its remains in shared memory.
pub struct Root {
    folder: tempfile::TempDir,
    instance: String,
}

impl Root {
    pub fn new(instance: &str) -> Self {
        // In /tmp: the path of a runtime folder is limited in length.
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        Self { folder, instance: instance.to_owned() }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    pub fn place(&self) -> Place {
        Place::new(&self.instance, self.path().to_str().unwrap()).unwrap()
    }

    /// Joins as an observer as soon as something runs.
    pub fn observe(&self) -> Hub {
        until("somebody to observe", || Hub::join(&self.place(), "probe", Access::Observer).ok())
    }
}

impl Drop for Root {
    fn drop(&mut self) {
        self.place().tidy();
    }
}

/// A running program, with its standard error so far. Killed when dropped.
pub struct Running {
    child: Child,
    stderr: Arc<Mutex<String>>,
}

impl Running {
    /// Starts the program with the runtime folder `root`.
    pub fn start(mut command: Command, root: &Path) -> Self {
        command.env("SEMIDENSE_ROOT", root).stdin(Stdio::null()).stdout(Stdio::null());
        let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
        let stderr = Arc::new(Mutex::new(String::new()));
        let (pipe, lines) = (child.stderr.take().unwrap(), Arc::clone(&stderr));
        std::thread::spawn(move || {
            for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                let mut lines = lines.lock().unwrap();
                lines.push_str(&line);
                lines.push('\n');
            }
        });
        Self { child, stderr }
    }

    /// Its standard error so far.
    pub fn said(&self) -> String {
        self.stderr.lock().unwrap().clone()
    }

    /// Waits until it has printed `text`.
    pub fn wait_for(&self, text: &str) {
        until(&format!("`{text}`; it said: {}", self.said()), || {
            self.said().contains(text).then_some(())
        });
    }

    /// Sends a signal by name.
    pub fn signal(&self, name: &str) {
        let id = self.child.id().to_string();
        let status = Command::new("kill").args(["-s", name, &id]).status().unwrap();
        assert!(status.success());
    }

    /// Waits for its end; returns whether it succeeded.
    pub fn end(&mut self) -> bool {
        until("the end of a program", || self.child.try_wait().unwrap()).success()
    }

    /// Interrupts it as Ctrl-C does, and waits for its end.
    pub fn interrupt(&mut self) -> bool {
        self.signal("INT");
        self.end()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The bridge.
pub fn bridge() -> &'static str {
    env!("CARGO_BIN_EXE_semidense-bridge")
}

/// The median and the 99th percentile, milliseconds.
pub fn percentiles_ms(nanos: &mut [i64]) -> [f64; 2] {
    nanos.sort_unstable();
    let at = |share: f64| {
        let index = ((nanos.len() as f64 * share) as usize).min(nanos.len().saturating_sub(1));
        nanos.get(index).map_or(f64::NAN, |nanos| *nanos as f64 * 1e-6)
    };
    [at(0.5), at(0.99)]
}
