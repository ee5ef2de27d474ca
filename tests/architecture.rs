//! The structure: imports run down, `slam` is pure, foreign names stay in their module,
//! files can be read in one sitting. The rule about imports is the table in docs/development.md.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// A file longer than this is split along its algorithm.
const MAX_LINES: usize = 500;

/// What only some modules may name, and why.
const RESERVED: &[(&str, &[&str], &str)] = &[
    ("iceoryx2::", &["src/wire"], "its API changes with every release: one module to change"),
    ("png::", &["src/capture"], "image files are read and written in one module"),
    ("zune_jpeg", &["src/capture"], "image files are read and written in one module"),
    ("mcap::", &["src/capture/bag"], "bags are read in one module"),
    ("cdr_encoding", &["src/capture/bag"], "bags are read in one module"),
    ("ioctl", &["src/capture/v4l"], "the kernel's video interface is spoken in one module"),
    (
        "std::time",
        &["src/service", "src/command", "src/wire", "src/capture/v4l"],
        "time is a value: only shells ask for it",
    ),
    ("std::thread", &["src/service", "src/capture/v4l"], "threads belong to the shells"),
    ("tracing::", &["src/service", "src/command", "src/main.rs"], "only shells log"),
    ("println!", &["src/command", "src/service/progress"], "only commands print"),
    ("std::process::exit", &["src/command"], "only commands choose exit codes"),
];

/// What `slam` must not do: it takes images and poses and gives poses and depth.
const IMPURE: &[&str] =
    &["std::fs", "std::io", "std::net", "std::env", "rand::", "thread_local!", "static mut"];

/// Where `unsafe` may stand.
const UNSAFE_MODULES: &[&str] = &["src/wire", "src/capture/v4l", "src/service/schedule.rs"];
const UNSAFE_KERNEL_MARK: &str = "kernel";

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn rust_files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found.sort();
}

/// (path relative to the root, its lines without trailing comments)
fn sources(folder: &str) -> Vec<(String, Vec<String>)> {
    let mut files = Vec::new();
    rust_files(&root().join(folder), &mut files);
    assert!(!files.is_empty(), "no files below {folder}");
    files
        .into_iter()
        .map(|path| {
            let text = fs::read_to_string(&path).unwrap();
            let name = path.strip_prefix(root()).unwrap().to_string_lossy().into_owned();
            let code =
                text.lines().map(|l| l.split("//").next().unwrap_or("").to_owned()).collect();
            (name, code)
        })
        .collect()
}

/// The table of docs/development.md, `| module | may import | … |` as module → modules.
fn allowed_imports() -> BTreeMap<String, Vec<String>> {
    let page = fs::read_to_string(root().join("docs/development.md")).unwrap();
    let rows = page.lines().skip_while(|l| !l.starts_with("| module | may import")).skip(2);
    let table: BTreeMap<String, Vec<String>> = rows
        .take_while(|l| l.starts_with('|'))
        .map(|row| {
            let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
            let words = |cell: &str| {
                cell.split(|c: char| !c.is_alphanumeric() && c != '_')
                    .filter(|w| !w.is_empty())
                    .map(str::to_owned)
                    .collect::<Vec<_>>()
            };
            (words(cells[0]).concat(), words(cells[1]))
        })
        .collect();
    assert_eq!(table.len(), 5, "the table of modules in docs/development.md: {table:?}");
    table
}

#[test]
fn a_module_with_parts_is_a_file_beside_its_folder() {
    for folder in ["src", "bridge/src", "c/src"] {
        for (file, _) in sources(folder) {
            assert!(!file.ends_with("/mod.rs"), "{file}: name it after its folder, beside it");
        }
    }
}

#[test]
fn imports_run_down() {
    let allowed = allowed_imports();
    let mut wrong = Vec::new();
    for (file, lines) in sources("src") {
        let Some(module) = file.strip_prefix("src/").and_then(|f| f.split_once('/')).map(|f| f.0)
        else {
            continue;
        };
        let may = allowed.get(module).unwrap_or_else(|| {
            panic!("{file}: {module} is not in the table of docs/development.md")
        });
        for (number, line) in lines.iter().enumerate() {
            for (other, _) in
                allowed.iter().filter(|(other, _)| *other != module && !may.contains(other))
            {
                if line.contains(&format!("crate::{other}"))
                    || line.contains(&format!("semidense::{other}"))
                {
                    wrong.push(format!(
                        "{file}:{}: {module} must not import {other}: imports run down",
                        number + 1
                    ));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn foreign_names_stay_in_their_module() {
    let mut wrong = Vec::new();
    for (file, lines) in sources("src") {
        for (number, line) in lines.iter().enumerate() {
            for (name, modules, reason) in RESERVED {
                if line.contains(name) && !modules.iter().any(|module| file.starts_with(module)) {
                    wrong.push(format!(
                        "{file}:{}: {name} belongs to {modules:?}: {reason}",
                        number + 1
                    ));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn slam_is_pure() {
    let mut wrong = Vec::new();
    for (file, lines) in sources("src/slam") {
        for (number, line) in lines.iter().enumerate() {
            for name in IMPURE.iter().filter(|name| line.contains(**name)) {
                wrong.push(format!(
                    "{file}:{}: {name}: slam has no I/O and no state outside its values",
                    number + 1
                ));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn unsafe_stays_in_its_modules_with_a_reason() {
    let mut wrong = Vec::new();
    for (file, lines) in sources("src") {
        let name = file.rsplit('/').next().unwrap();
        let may = UNSAFE_MODULES.iter().any(|module| file.starts_with(module))
            || (file.starts_with("src/slam/") && name.contains(UNSAFE_KERNEL_MARK));
        for (number, line) in lines.iter().enumerate() {
            if !may && line.split(|c: char| !c.is_alphanumeric() && c != '_').any(|w| w == "unsafe")
            {
                wrong.push(format!(
                    "{file}:{}: unsafe belongs to {UNSAFE_MODULES:?} and kernels",
                    number + 1
                ));
            }
        }
    }
    // Of the other packages only the boundary to C needs it: its rules are in c/src/lib.rs.
    for (file, lines) in ["bridge/src", "c/src"].into_iter().flat_map(sources) {
        for (number, line) in lines.iter().enumerate() {
            let is_boundary = file == "c/src/exports.rs";
            if !is_boundary
                && line.split(|c: char| !c.is_alphanumeric() && c != '_').any(|w| w == "unsafe")
            {
                wrong.push(format!("{file}:{}: unsafe belongs to c/src/exports.rs", number + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn files_can_be_read_in_one_sitting() {
    let mut wrong = Vec::new();
    for folder in ["src", "tests", "examples", "benches", "bridge/src", "c"] {
        for (file, lines) in sources(folder) {
            if lines.len() > MAX_LINES {
                wrong.push(format!(
                    "{file}: {} lines, at most {MAX_LINES}: split it along the algorithm",
                    lines.len()
                ));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_file_says_first_what_it_is_for() {
    let mut files = Vec::new();
    for folder in ["src", "tests", "examples", "benches", "bridge/src", "c"] {
        rust_files(&root().join(folder), &mut files);
    }
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        assert!(
            text.starts_with("//! "),
            "{}: the first line says what the file is for",
            file.display()
        );
    }
}
