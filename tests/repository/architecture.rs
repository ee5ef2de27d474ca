//! The structure of the source: imports run down, `slam` is pure, foreign names stay in their module, files can be
//! read in one sitting. The rule about imports is the table in docs/development.md.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs;
use std::path::{Path, PathBuf};

/// A file longer than this is split along its algorithm.
const MAX_LINES: usize = 500;

/// Names that are reserved to some modules, and why.
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

/// What `slam` must not use: it takes images and poses and returns poses and depth.
const IMPURE: &[&str] =
    &["std::fs", "std::io", "std::net", "std::env", "rand::", "thread_local!", "static mut"];

/// Where `unsafe` may be used.
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

/// The table of docs/development.md, `| module | may import | … |`, as module → modules.
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

/// The files that each file imports from, by the paths of their modules: `src/slam/map.rs` is `slam::map`.
type Imports = BTreeMap<String, BTreeSet<String>>;

/// The code of a file without its test-only items, and the modules that it declares for tests. An item ends at the
/// first closing line with the indentation of its attribute.
fn without_tests(lines: &[String]) -> (String, Vec<String>) {
    let (mut code, mut test_modules) = (String::new(), Vec::new());
    let mut lines = lines.iter();
    while let Some(line) = lines.next() {
        let indent = line.len() - line.trim_start().len();
        if !line.trim_start().starts_with("#[cfg(test)]") {
            code.push_str(line);
            code.push('\n');
            continue;
        }
        for line in lines.by_ref() {
            let text = line.trim();
            let name = text.strip_suffix(';').and_then(|text| text.split("mod ").nth(1));
            test_modules.extend(name.map(str::to_owned));
            let is_attribute = text.starts_with("#[");
            let ends = !is_attribute && text.ends_with(['}', ';', ',']);
            if ends && line.len() - line.trim_start().len() == indent {
                break;
            }
        }
    }
    (code, test_modules)
}

/// Collects the paths of a `use` tree that starts at `text`, prefixed by `before`; returns the text after the tree.
fn read_tree<'a>(text: &'a str, before: &str, paths: &mut Vec<String>) -> &'a str {
    let is_name = |c: char| c.is_alphanumeric() || c == '_' || c == ':' || c == '*';
    let end = text.find(|c| !is_name(c)).unwrap_or(text.len());
    let path = format!("{before}{}", &text[..end]);
    let is_group = text[end..].starts_with('{') && (path.is_empty() || path.ends_with("::"));
    if !is_group {
        paths.push(path);
        return &text[end..];
    }
    let mut rest = &text[end + 1..];
    loop {
        rest = rest.trim_start_matches([',', ' ', '\n']);
        if let Some(after) = rest.strip_prefix('}') {
            return after;
        }
        let after = read_tree(rest, &path, paths);
        if after.len() == rest.len() {
            return after;
        }
        rest = after;
        if let Some(renamed) = rest.strip_prefix(" as ") {
            rest = &renamed[renamed.find([',', '}', '\n']).unwrap_or(renamed.len())..];
        }
    }
}

/// The paths used by the code of `module`, including its own submodules.
fn named_in(module: &str, code: &str) -> Vec<String> {
    let parent = module.rsplit_once("::").map_or("", |(parent, _)| parent);
    let starts = [("crate::", ""), ("super::", parent), ("self::", module)];
    let mut named = Vec::new();
    for (start, from) in starts {
        for (at, _) in code.match_indices(start) {
            let is_inside = code[..at].ends_with(|c: char| c.is_alphanumeric() || "_:".contains(c));
            let before = if from.is_empty() { String::new() } else { format!("{from}::") };
            if !is_inside {
                read_tree(&code[at + start.len()..], &before, &mut named);
            }
        }
    }
    let declared = code.lines().filter_map(|line| line.strip_suffix(';')?.split("mod ").nth(1));
    for part in declared {
        let uses = code.match_indices(&format!("{part}::")).any(|(at, _)| {
            !code[..at].ends_with(|c: char| c.is_alphanumeric() || "_:".contains(c))
        });
        named.extend(uses.then(|| format!("{module}::{part}")));
    }
    named
}

/// All imports between the files of a folder, excluding tests.
fn imports_in(folder: &str) -> Imports {
    let mut codes = BTreeMap::new();
    let mut for_tests = Vec::new();
    for (file, lines) in sources(folder) {
        let path = file.trim_start_matches(folder).trim_start_matches('/').trim_end_matches(".rs");
        let module = path.replace('/', "::");
        let (code, test_modules) = without_tests(&lines);
        let below = if module == "lib" { String::new() } else { format!("{module}::") };
        for_tests.extend(test_modules.into_iter().map(|name| format!("{below}{name}")));
        codes.insert(module, code);
    }
    let is_test = |module: &str| for_tests.iter().any(|of| module == of || is_below(module, of));
    codes.retain(|module, _| !is_test(module));
    let imports_of = |(module, code): (&String, &String)| {
        let named = named_in(module, code);
        let others = named.iter().filter_map(|path| file_of(path, &codes));
        (module.clone(), others.filter(|other| other != module).map(str::to_owned).collect())
    };
    codes.iter().map(imports_of).collect()
}

/// The file that a path leads into: its longest prefix that is a file.
fn file_of<'a>(path: &'a str, codes: &BTreeMap<String, String>) -> Option<&'a str> {
    let ends = path.match_indices("::").map(|(end, _)| end).chain([path.len()]);
    ends.map(|end| &path[..end]).filter(|module| codes.contains_key(*module)).last()
}

fn is_below(module: &str, other: &str) -> bool {
    module.strip_prefix(other).is_some_and(|rest| rest.starts_with("::"))
}

/// The shortest path along imports, including both ends.
fn shortest_path(imports: &Imports, from: &str, to: &str) -> Option<Vec<String>> {
    let mut before = BTreeMap::from([(from.to_owned(), None)]);
    let mut waiting = VecDeque::from([from.to_owned()]);
    while let Some(module) = waiting.pop_front() {
        if module == to {
            let back = |of: &String| before.get(of).cloned().flatten();
            let mut path: Vec<String> = std::iter::successors(Some(module), back).collect();
            path.reverse();
            return Some(path);
        }
        for next in imports.get(&module).into_iter().flatten() {
            if !before.contains_key(next) {
                before.insert(next.clone(), Some(module.clone()));
                waiting.push_back(next.clone());
            }
        }
    }
    None
}

/// The shortest import cycle other than between a file and its parts: one in which no file is above all others, or
/// that remains without the imports from a part to a file above it.
fn circle_in(imports: &Imports) -> Option<Vec<String>> {
    let mut down = imports.clone();
    for (module, others) in &mut down {
        others.retain(|other| !is_below(module, other));
    }
    let beside = down.iter().flat_map(|(module, others)| {
        let beside = others.iter().filter(|other| !is_below(other, module));
        beside.map(move |other| (module, other))
    });
    let circles = beside.filter_map(|(module, other)| {
        shortest_path(&down, other, module).or_else(|| {
            let path = shortest_path(imports, other, module)?;
            let is_above_all = |top: &String| path.iter().all(|of| of == top || is_below(of, top));
            (!path.iter().any(is_above_all)).then_some(path)
        })
    });
    circles.min_by_key(Vec::len)
}

#[test]
fn a_module_with_parts_is_a_file_next_to_its_folder() {
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
fn imports_have_no_cycles() {
    for folder in ["src", "bridge/src", "c/src"] {
        let imports = imports_in(folder);
        assert!(imports.values().any(|others| !others.is_empty()), "no imports in {folder}");
        if let Some(circle) = circle_in(&imports) {
            let files: Vec<String> = circle
                .iter()
                .chain(circle.first())
                .map(|module| format!("{folder}/{}.rs", module.replace("::", "/")))
                .collect();
            panic!(
                "a circle of imports: what both need belongs into a file below them\n    {}",
                files.join("\n -> ")
            );
        }
    }
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
    // Among the other packages only the boundary to C needs it: its rules are in c/src/lib.rs.
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
fn every_file_starts_with_its_purpose() {
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
