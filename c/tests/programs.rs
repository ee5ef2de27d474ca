//! C and C++ programs that use the library with a running pipeline.
//!
//! They are compiled with all warnings as errors and, if the compiler has them, with the address and
//! undefined-behaviour sanitizers.

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;
use semidense::wire::place::Place;
use semidense::wire::topic::WIRE_VERSION;
use tempfile::TempDir;

/// Far above any expected duration: it ends a test that hangs.
const WATCH_DOG: Duration = Duration::from_secs(120);

const C: &[&str] = &["cc", "-std=c11"];
const CPP: &[&str] = &["c++", "-std=c++17"];
const STRICT: &[&str] = &["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-g", "-D_DEFAULT_SOURCE"];
const SANITIZERS: &str = "-fsanitize=address,undefined";

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Folder of the libraries and programs of this profile.
fn built() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    test.ancestors().nth(2).unwrap().to_owned()
}

/// Builds what `cargo test` does not: a library that Rust cannot link to, and the pipeline's program unless
/// `SEMIDENSE_BIN` names it.
fn build() {
    static BUILT: OnceLock<()> = OnceLock::new();
    BUILT.get_or_init(|| {
        // CI has built them, with the features of its tests.
        if std::env::var_os("SEMIDENSE_CI").is_some() {
            return;
        }
        let mut command = Command::new(env!("CARGO"));
        command.args(["build", "--quiet", "--locked", "--package", "semidense-c", "--lib"]);
        if std::env::var_os("SEMIDENSE_BIN").is_none() {
            command.args(["--package", "semidense", "--bin", "semidense"]);
        }
        if !cfg!(debug_assertions) {
            command.arg("--release");
        }
        assert!(command.current_dir(root()).status().unwrap().success(), "cargo build");
    });
}

/// Path of the library under cargo's name.
fn library() -> PathBuf {
    built().join("libsemidense_c.so")
}

/// The pipeline's program: `SEMIDENSE_BIN`, else that of this profile.
fn semidense() -> PathBuf {
    let named = std::env::var_os("SEMIDENSE_BIN").map(PathBuf::from);
    named.unwrap_or_else(|| built().join("semidense"))
}

/// A separate instance, with a folder for programs and the library under its shared name.
struct Rig {
    folder: TempDir,
    pipeline: Option<Child>,
}

impl Rig {
    fn new() -> Self {
        build();
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        for name in ["libsemidense.so", "libsemidense.so.0"] {
            symlink(library(), folder.path().join(name)).unwrap();
        }
        Self { folder, pipeline: None }
    }

    /// A rig with a live run that lasts longer than any test.
    fn running() -> Self {
        let mut rig = Self::new();
        let mut command = rig.command(&semidense());
        command.args(["run", "--live", "--source", "loop:1000000:30:sim", "--output"]);
        command.arg(rig.folder.path().join("output"));
        for setting in ["frames=60", "width=160", "height=120", "focal_px=131.0"] {
            command.args(["--set", &format!("simulator.{setting}")]);
        }
        rig.pipeline = Some(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
        rig
    }

    fn place(&self) -> Place {
        Place::new("semidense", self.folder.path().join("root").to_str().unwrap()).unwrap()
    }

    fn command(&self, program: &Path) -> Command {
        let mut command = Command::new(program);
        command.env("SEMIDENSE_ROOT", &self.place().root).stdin(Stdio::null());
        command
    }

    /// Compiles a program and returns its path.
    fn compile(&self, compiler: &[&str], source: &str, sanitize: bool) -> PathBuf {
        let program = self.folder.path().join(Path::new(source).file_stem().unwrap());
        let mut command = Command::new(compiler[0]);
        command.args(&compiler[1..]).args(STRICT).arg(root().join(source));
        command.arg("-I").arg(root().join("include")).arg("-o").arg(&program);
        command.arg("-L").arg(self.folder.path()).arg("-lsemidense").arg("-pthread");
        command.arg(format!("-Wl,-rpath,{}", self.folder.path().display()));
        if sanitize && has_sanitizers() {
            command.arg(SANITIZERS).arg("-fno-sanitize-recover=all");
        }
        let done = command.output().unwrap_or_else(|error| panic!("{}: {error}", compiler[0]));
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        program
    }

    fn run(&self, program: &Path, arguments: &[&str]) -> Output {
        let child = self
            .command(program)
            .args(arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        end(child)
    }

    /// Ends the pipeline as Ctrl-C does.
    fn stop(&mut self) {
        if let Some(mut pipeline) = self.pipeline.take() {
            let id = pipeline.id().to_string();
            Command::new("kill").args(["-INT", &id]).status().unwrap();
            pipeline.wait().unwrap();
        }
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Waits for the end of a program; one that hangs is killed and fails the test.
fn end(mut child: Child) -> Output {
    let begun = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if begun.elapsed() > WATCH_DOG {
            child.kill().unwrap();
            panic!("it hangs: {:?}", child.wait_with_output());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    child.wait_with_output().unwrap()
}

/// Whether the compiler has the sanitizers and their libraries.
fn has_sanitizers() -> bool {
    static FOUND: OnceLock<bool> = OnceLock::new();
    *FOUND.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let (source, program) = (folder.path().join("x.c"), folder.path().join("x"));
        fs::write(&source, "int main(void) { return 0; }").unwrap();
        let compiled =
            Command::new("cc").arg(SANITIZERS).arg(&source).arg("-o").arg(&program).output();
        let has = compiled.is_ok_and(|done| done.status.success())
            && Command::new(&program).status().is_ok_and(|status| status.success());
        if !has {
            eprintln!("no sanitizers here: the programs run without");
        }
        has
    })
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn a_c_program_reads_poses_and_ends_with_the_run() {
    let mut rig = Rig::running();
    let program = rig.compile(C, "examples/poses.c", true);
    let first = rig.run(&program, &["semidense", "3"]);
    assert!(first.status.success(), "{}", text(&first.stderr));
    assert_eq!(text(&first.stdout).lines().count(), 3);
    let mut child =
        rig.command(&program).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map(Result::unwrap);
    let mut rows = Vec::new();
    // A busy machine may take long to start a map; if the pipeline dies, the lines end.
    while rows.len() < 30 || !rows.iter().any(|row: &Vec<String>| row[1] == "tracking") {
        let line = lines.next().expect("poses of a run that continues");
        rows.push(line.split(' ').map(str::to_owned).collect());
    }
    rig.stop();
    rows.extend(lines.map(|line| line.split(' ').map(str::to_owned).collect()));
    let done = end(child);
    assert!(done.status.success() && done.stderr.is_empty(), "{}", text(&done.stderr));
    let sequences: Vec<u64> = rows.iter().map(|row| row[0].parse().unwrap()).collect();
    assert!(sequences.is_sorted_by(|a, b| a < b), "{sequences:?}");
    for row in &rows {
        let unit: f64 = row[5..9].iter().map(|q| q.parse::<f64>().unwrap().powi(2)).sum();
        assert!((unit - 1.0).abs() < 1e-4, "{row:?}");
    }
}

#[test]
fn a_cpp_program_reads_keyframes_frames_and_the_graph() {
    let rig = Rig::running();
    let program = rig.compile(CPP, "examples/keyframes.cpp", true);
    let done = rig.run(&program, &["semidense", "3"]);
    let out = text(&done.stdout);
    assert!(done.status.success() && done.stderr.is_empty(), "{}", text(&done.stderr));
    let keyframes: Vec<&str> = out.lines().filter(|line| line.starts_with("keyframe")).collect();
    assert_eq!(keyframes.len(), 3, "{out}");
    assert!(out.lines().any(|line| line.starts_with("map revision")), "{out}");
    assert!(
        keyframes.iter().all(|line| line.contains("median depth") && !line.contains("nan")),
        "{out}"
    );
}

#[test]
fn the_examples_print_their_usage_instead_of_waiting() {
    let rig = Rig::new();
    for (compiler, source) in [(C, "examples/poses.c"), (CPP, "examples/keyframes.cpp")] {
        let program = rig.compile(compiler, source, true);
        let help = rig.run(&program, &["--help"]);
        assert!(help.status.success() && help.stderr.is_empty(), "{}", text(&help.stderr));
        assert!(text(&help.stdout).starts_with("usage: "), "{}", text(&help.stdout));
        for arguments in
            [&["--fast"][..], &["x", "many"], &["x", ""], &["x", "-3"], &["x", "3", "4"]]
        {
            let wrong = rig.run(&program, arguments);
            assert_eq!(wrong.status.code(), Some(2), "{arguments:?}");
            assert!(wrong.stdout.is_empty() && text(&wrong.stderr).starts_with("usage: "));
        }
    }
}

#[test]
fn misuse_is_an_error_and_never_a_crash() {
    let rig = Rig::running();
    let done = rig.run(&rig.compile(C, "tests/misuse.c", true), &[]);
    assert!(done.status.success(), "{}{}", text(&done.stdout), text(&done.stderr));
    assert_eq!(text(&done.stdout), format!("{} wire {WIRE_VERSION}\n", env!("CARGO_PKG_VERSION")));
}

#[test]
fn another_wire_version_is_refused_with_both_versions_in_c_and_cpp() {
    let rig = Rig::new();
    let place = rig.place();
    place.create().unwrap();
    let mut config = Config::default();
    let path = iceoryx2::prelude::Path::new(place.root.as_os_str().as_encoded_bytes()).unwrap();
    config.global.set_root_path(&path);
    config.global.prefix = FileName::new(place.prefix.as_bytes()).unwrap();
    set_log_level(LogLevel::Fatal);
    let node = NodeBuilder::new().config(&config).create::<ipc::Service>().unwrap();
    let other = WIRE_VERSION + 1;
    let name = ServiceName::new(&format!("semidense/v{other}/tracker/pose")).unwrap();
    let _service =
        node.service_builder(&name).publish_subscribe::<[u64]>().open_or_create().unwrap();
    let programs = [
        rig.compile(C, "examples/poses.c", true),
        rig.compile(CPP, "examples/keyframes.cpp", true),
    ];
    for program in programs {
        let done = rig.run(&program, &[]);
        let said = text(&done.stderr);
        let both = format!("uses wire version {other}, this program {WIRE_VERSION}");
        assert!(!done.status.success() && said.contains(&both), "{}: {said}", program.display());
    }
}

#[test]
fn nothing_is_left_behind_without_a_running_instance() {
    let rig = Rig::new();
    let program = rig.folder.path().join("absent.c");
    let source = "#include <semidense.h>\nint main(void) { semidense_reader *r; return -semidense_open(0, 0, 15, 100, &r); }";
    fs::write(&program, source).unwrap();
    let done = rig.run(&rig.compile(C, program.to_str().unwrap(), true), &[]);
    assert_eq!(done.status.code(), Some(3), "{}", text(&done.stderr));
    assert!(!rig.place().root.exists());
}

#[test]
fn the_installed_library_is_found_by_pkg_config_and_cmake() {
    let rig = Rig::new();
    let prefix = rig.folder.path().join("usr");
    let mut install = Command::new(root().join("install"));
    install.arg(&prefix).env("STATIC", "no").env("BUILT", built());
    assert!(install.status().unwrap().success());
    let found = |arguments: &[&str]| {
        let mut command = Command::new("pkg-config");
        command.args(arguments).arg("semidense");
        command.env("PKG_CONFIG_PATH", prefix.join("lib/pkgconfig")).output()
    };
    let Ok(flags) = found(&["--cflags", "--libs"]) else {
        return eprintln!("no pkg-config here");
    };
    assert!(flags.status.success(), "{}", text(&flags.stderr));
    let compiled = Command::new("cc")
        .args(["-std=c11", "-D_DEFAULT_SOURCE"])
        .arg(prefix.join("share/doc/libsemidense-dev/examples/poses.c"))
        .arg("-o")
        .arg(rig.folder.path().join("poses"))
        .args(text(&flags.stdout).split_whitespace())
        .output()
        .unwrap();
    assert!(compiled.status.success(), "{}", text(&compiled.stderr));
    let project = rig.folder.path().join("project");
    fs::create_dir(&project).unwrap();
    let example = prefix.join("share/doc/libsemidense-dev/examples/keyframes.cpp");
    let lists = format!(
        "cmake_minimum_required(VERSION 3.16)\nproject(robot CXX)\nset(CMAKE_CXX_STANDARD 17)\n\
         find_package(semidense 0.1 REQUIRED)\nadd_executable(robot {})\n\
         target_link_libraries(robot PRIVATE semidense::semidense)\n",
        example.display()
    );
    fs::write(project.join("CMakeLists.txt"), lists).unwrap();
    let cmake = |arguments: &[&str]| {
        let mut command = Command::new("cmake");
        command.args(arguments).current_dir(&project);
        command.env("CMAKE_PREFIX_PATH", &prefix).output()
    };
    let Ok(configured) = cmake(&["-B", "build"]) else { return eprintln!("no CMake here") };
    assert!(configured.status.success(), "{}", text(&configured.stderr));
    let built = cmake(&["--build", "build"]).unwrap();
    assert!(built.status.success(), "{}{}", text(&built.stdout), text(&built.stderr));
}

#[test]
fn the_library_exports_only_its_own_functions_and_the_header_declares_each() {
    build();
    let library = library();
    let listed = Command::new("nm").args(["-D", "--defined-only"]).arg(&library).output().unwrap();
    let symbols: Vec<String> = text(&listed.stdout)
        .lines()
        .filter_map(|line| line.split_whitespace().last().map(str::to_owned))
        .collect();
    let foreign: Vec<_> = symbols.iter().filter(|name| !name.starts_with("semidense_")).collect();
    assert!(foreign.is_empty(), "{foreign:?}");
    let header = fs::read_to_string(root().join("include/semidense.h")).unwrap();
    let declared = header.matches("semidense_").count();
    assert!(symbols.len() >= 14 && declared > symbols.len(), "{symbols:?}");
    for symbol in &symbols {
        assert!(header.contains(&format!("{symbol}(")), "{symbol} is not in the header");
    }
    let dynamic = Command::new("readelf").arg("-d").arg(&library).output().unwrap();
    assert!(text(&dynamic.stdout).contains("[libsemidense.so.0]"), "the name with the version");
}
