//! The live page as seen by a browser, a scraper and an intruder, and its absence of effect on the run.

mod support;

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use support::{Process, Rig, ask, finish, get, has_tool, semidense, succeed, tools, until};

/// A live run that continues until it is ended: forty frames of the simulated camera back and forth.
const LONG: &[&str] = &["--live", "--source", "loop:20000:10:sim"];
const LONG_FRAMES: usize = 40;

/// Folder in which screenshots are kept for inspection.
fn pictures() -> PathBuf {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/live-page");
    fs::create_dir_all(&folder).unwrap();
    folder
}

/// A script of `tests/browser` with its arguments; `None` if there is no browser.
fn browser(script: &str, arguments: &[&str]) -> Option<Command> {
    let chromium =
        std::env::var_os("CHROMIUM").map_or(PathBuf::from("/usr/bin/chromium"), PathBuf::from);
    if !has_tool(&chromium) || !has_tool(&tools().join("node_modules/playwright-core")) {
        return None;
    }
    let mut command = Command::new("node");
    command
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser").join(script))
        .args([tools(), pictures()])
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    Some(command)
}

/// A browser script driven step by step.
struct Led {
    child: Child,
    output: BufReader<std::process::ChildStdout>,
}

impl Led {
    fn start(mut command: Command) -> Self {
        let mut child = command.stdin(Stdio::piped()).stderr(Stdio::inherit()).spawn().unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        Self { child, output }
    }

    /// Reads until it has reached a step; returns its output up to there.
    fn comes_to(&mut self, step: &str) -> String {
        let mut said = String::new();
        loop {
            let mut line = String::new();
            assert!(
                self.output.read_line(&mut line).unwrap() > 0,
                "the browser ended before {step:?}; it said {said:?}"
            );
            if line.trim_end() == step {
                return said;
            }
            said += &line;
        }
    }

    fn go_on(&mut self) {
        self.child.stdin.as_mut().unwrap().write_all(b"go on\n").unwrap();
    }
}

impl Drop for Led {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_browser_shows_a_run_from_before_its_start_to_the_next_run() {
    let rig = Rig::new();
    let (view, address) = rig.view(&["--maps", "maps"]);
    let Some(command) = browser("live.mjs", &[&address]) else { return };
    let mut led = Led::start(command);
    led.comes_to("waiting");
    let run = Process::start(rig.run(LONG_FRAMES, LONG));
    led.go_on();
    let said = led.comes_to("seen");
    let folder = said.lines().find_map(|line| line.strip_prefix("saved in ")).unwrap();
    let mut info = Command::new(semidense());
    info.args(["map", "info", folder]).stdout(Stdio::piped()).stderr(Stdio::piped());
    assert!(succeed(info).contains("keyframes"), "what was saved is a map");
    run.signal("-INT");
    led.go_on();
    led.comes_to("ended");
    drop(run);
    let next = Process::start(rig.run(LONG_FRAMES, LONG));
    led.go_on();
    led.comes_to("again");
    let port = address.trim_end_matches('/').rsplit(':').next().unwrap().to_owned();
    drop(view);
    led.go_on();
    led.comes_to("gone");
    let _view = Process::start(rig.bridge(&["view", "--listen", &format!("127.0.0.1:{port}")]));
    led.go_on();
    led.comes_to("back");
    drop(next);
}

#[test]
fn a_browser_shows_a_finished_run_and_its_report() {
    let rig = Rig::new();
    succeed(rig.run(60, &[]));
    let (_view, address) = rig.view(&[rig.output().to_str().unwrap()]);
    let report = format!("file://{}", rig.output().join("report.html").display());
    let size = fs::metadata(rig.output().join("report.html")).unwrap().len();
    assert!(size < 16 << 20, "{size} bytes");
    let Some(command) = browser("finished.mjs", &[&address, &report]) else { return };
    succeed(command);
}

#[test]
fn a_folder_without_a_run_is_refused_with_advice() {
    let rig = Rig::new();
    let output = finish(rig.bridge(&["view", "nowhere", "--listen", "127.0.0.1:0"]));
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && error.lines().count() == 1, "{error}");
    assert!(error.contains("nowhere/keyframes.txt") && error.contains("output/latest"), "{error}");
}

#[test]
fn prometheus_reads_the_metrics() {
    let rig = Rig::new();
    let python = tools().join("venv/bin/python");
    let (_view, address) = rig.view(&[]);
    let run = Process::start(rig.run(LONG_FRAMES, LONG));
    let of_all = |text: &str| {
        ["capture", "tracker", "mapper"]
            .iter()
            .all(|p| text.contains(&format!("semidense_frames_total{{process=\"{p}\"}}")))
    };
    // Poses are counted as they arrive, the rest is from the last report of a process: either may be ahead.
    let counted = |text: &str, figure: &str| {
        text.contains(&format!("{figure} ")) && !text.contains(&format!("{figure} 0\n"))
    };
    let tracked = |text: &str| {
        counted(text, "semidense_poses_total{state=\"tracking\"}")
            && counted(text, "semidense_latency_seconds_count{process=\"tracker\"}")
    };
    let text = until("figures of all three", || {
        Some(get(&address, "/metrics", "")).filter(|text| tracked(text) && of_all(text))
    });
    drop(run);
    if !has_tool(&python) {
        return;
    }
    let body = text.split_once("\r\n\r\n").unwrap().1;
    let file = rig.folder().join("metrics.txt");
    fs::write(&file, body).unwrap();
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser/metrics.py")).arg(&file);
    succeed({
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    });
}

#[test]
fn intruders_are_refused() {
    let rig = Rig::new();
    let (mut view, address) = rig.view(&[]);
    let status = |answer: String| answer.split_whitespace().nth(1).unwrap_or("none").to_owned();
    assert_eq!(status(get(&address, "/", "")), "200");
    assert_eq!(status(get(&address, "/nowhere", "")), "404");
    assert_eq!(status(get(&address, "/", "Origin: http://evil.example\r\n")), "403");
    assert_eq!(status(ask(&address, b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n")), "421");
    assert_eq!(status(ask(&address, b"DELETE / HTTP/1.1\r\nHost: localhost\r\n\r\n")), "405");
    assert_eq!(
        status(ask(
            &address,
            b"POST /api/save HTTP/1.1\r\nHost: localhost\r\nOrigin: http://evil.example\r\n\r\n"
        )),
        "403"
    );
    assert_eq!(status(ask(&address, &[b'x'; 20_000])), "431");
    assert_eq!(status(ask(&address, b"\x00\x01 no request\r\n\r\n")), "400");
    let long = format!("GET / HTTP/1.1\r\nA: {}\r\n\r\n", "x".repeat(20_000));
    assert_eq!(status(ask(&address, long.as_bytes())), "431");
    let upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n";
    assert_eq!(status(get(&address, "/stream", upgrade)), "400", "without a key");
    let foreign = format!(
        "{upgrade}Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nOrigin: http://evil.example\r\n"
    );
    assert_eq!(status(get(&address, "/stream", &foreign)), "403");
    assert!(get(&address, "/", "").contains("default-src 'self'"));
    assert!(view.is_running());
}

#[test]
fn a_server_open_to_other_machines_gets_a_token() {
    let rig = Rig::new();
    let mut view = Process::start(rig.bridge(&["view", "--listen", "0.0.0.0:0"]));
    let address = view.line();
    let token = address.split_once("/?token=").unwrap().1.to_owned();
    let port = address.split('/').nth(2).unwrap().rsplit(':').next().unwrap();
    let local = format!("http://127.0.0.1:{port}/");
    assert!(get(&local, "/", "").starts_with("HTTP/1.1 401"));
    assert!(get(&local, "/metrics", "").starts_with("HTTP/1.1 401"));
    let page = get(&local, &format!("/?token={token}"), "");
    assert!(
        page.starts_with("HTTP/1.1 200")
            && page
                .contains(&format!("Set-Cookie: semidense_token_{port}={token}; Path=/; HttpOnly"))
    );
    assert!(
        get(&local, "/page.js", &format!("Cookie: semidense_token_{port}={token}\r\n"))
            .starts_with("HTTP/1.1 200")
    );
    assert!(
        get(&local, "/metrics", &format!("Authorization: Bearer {token}\r\n"))
            .starts_with("HTTP/1.1 200")
    );
    drop(view);
    let mut open = rig.bridge(&["view", "--listen", "0.0.0.0:0", "--no-token"]);
    let mut child = open.spawn().unwrap();
    let mut warning = String::new();
    BufReader::new(child.stderr.take().unwrap()).read_line(&mut warning).unwrap();
    let _ = child.kill();
    let _ = child.wait();
    assert!(warning.starts_with("warning: anyone who can reach"), "{warning}");
}

/// The results of a run.
fn trajectories(rig: &Rig) -> [Vec<u8>; 3] {
    ["trajectory.txt", "trajectory_online.txt", "keyframes.txt"]
        .map(|name| fs::read(rig.output().join(name)).unwrap())
}

#[test]
fn a_stopped_or_killed_page_changes_no_result() {
    /// Rendered while the page joins; the run starts with the first sixty.
    const FRAMES: usize = 1500;
    let arguments = ["--lockstep", "--source", "loop:60:30:sim"];
    let alone = Rig::new();
    succeed(alone.run(FRAMES, &arguments));
    for signal in ["-STOP", "-KILL"] {
        let rig = Rig::new();
        let (view, address) = rig.view(&[]);
        let run = rig.run(FRAMES, &arguments).spawn().unwrap();
        until("the page to have joined", || {
            get(&address, "/metrics", "").contains("semidense_up 1").then_some(())
        });
        view.signal(signal);
        let output = run.wait_with_output().unwrap();
        assert!(output.status.success(), "{signal}: {}", String::from_utf8_lossy(&output.stderr));
        assert!(trajectories(&rig) == trajectories(&alone), "{signal} has changed a result");
    }
}

#[test]
fn a_run_serves_its_page_and_outlives_it() {
    let rig = Rig::new();
    let mut run =
        rig.run(LONG_FRAMES, &["--live", "--view=127.0.0.1:0", "--source", "loop:200:10:sim"]);
    let mut run = run.stderr(Stdio::piped()).spawn().unwrap();
    let mut stderr = BufReader::new(run.stderr.take().unwrap());
    let address = until("the address", || {
        let mut line = String::new();
        assert!(stderr.read_line(&mut line).unwrap() > 0, "the run has ended");
        line.trim_end().strip_prefix("live page: ").map(str::to_owned)
    });
    assert!(get(&address, "/", "").starts_with("HTTP/1.1 200"));
    let view = until("the page's process", || child_of(run.id(), "view"));
    assert!(Command::new("kill").args(["-KILL", &view.to_string()]).status().unwrap().success());
    let rest = std::thread::spawn(move || {
        stderr.lines().map_while(Result::ok).collect::<Vec<_>>().join("\n")
    });
    let status = run.wait().unwrap();
    let rest = rest.join().unwrap();
    assert!(status.success(), "{rest}");
    assert!(rest.contains("the live page exited"), "{rest}");
    assert_eq!(child_of(run.id(), "view"), None);
}

/// The child of a process whose command line contains a word.
fn child_of(parent: u32, word: &str) -> Option<u32> {
    let processes = fs::read_dir("/proc").unwrap().flatten();
    let ids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    ids.into_iter().find(|id| {
        let read =
            |name: &str| fs::read_to_string(format!("/proc/{id}/{name}")).unwrap_or_default();
        let is_child = read("status")
            .lines()
            .any(|line| line.split_whitespace().eq(["PPid:", &parent.to_string()]));
        is_child && read("cmdline").split('\0').any(|of| of == word)
    })
}
