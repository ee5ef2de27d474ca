//! Pinned figures: a measurement must be close to its value in the table `tests/figures.toml`, better or worse.
//! Replays give the same bits on every run and, with portable arithmetic, on every machine, so that only a change of
//! the program moves them. `SEMIDENSE_WRITE_FIGURES=1 cargo test --release` regenerates the table.

use std::fs::{File, OpenOptions};
use std::path::Path;

use toml::{Table, Value};

/// If set, the table is written instead of compared.
const WRITE_VARIABLE: &str = "SEMIDENSE_WRITE_FIGURES";

/// Relative difference by which a figure may deviate from the table.
const TOLERANCE: f64 = 0.2;

/// First lines of the table.
const HEAD: &str = "\
# What the tests measured when this was written: each figure is held to 20 % of its value here, better or worse, or to
# a slack that its test names; numbers of frames are held more closely. A change that moves them for a reason writes
# the table anew: SEMIDENSE_WRITE_FIGURES=1 cargo test --release --test estimation -- accuracy depth_modes
";

/// A measured figure.
#[derive(Debug, Clone, Copy)]
pub struct Figure {
    name: &'static str,
    value: f64,
    tolerance: f64,
    slack: f64,
}

impl Figure {
    /// A figure that may differ by a fifth, and always by `slack`, in its own unit.
    pub fn new(name: &'static str, value: f64, slack: f64) -> Self {
        Self { name, value, tolerance: TOLERANCE, slack }
    }

    /// A count that may differ by at most `slack`.
    pub fn count(name: &'static str, value: f64, slack: f64) -> Self {
        Self { name, value, tolerance: 0.0, slack }
    }

    fn allowed(&self, pinned: f64) -> f64 {
        (self.tolerance * pinned.abs()).max(self.slack)
    }
}

/// Compares the figures of a `section` with the table, or writes them to it.
pub fn hold(section: &str, figures: &[Figure]) {
    let table = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/figures.toml");
    if std::env::var_os(WRITE_VARIABLE).is_some() {
        write(&table, section, figures);
        return;
    }
    let pinned = read(&table);
    let wrong: Vec<String> = figures.iter().filter_map(|f| compare(section, f, &pinned)).collect();
    assert!(
        wrong.is_empty(),
        "figures of {section} moved:\n  {}\n{WRITE_VARIABLE}=1 writes tests/figures.toml anew",
        wrong.join("\n  ")
    );
}

/// What is wrong with a figure.
fn compare(section: &str, figure: &Figure, pinned: &Table) -> Option<String> {
    let name = figure.name;
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|i| i as f64));
    let Some(before) = pinned.get(section).and_then(|s| s.get(name)).and_then(number) else {
        return Some(format!("{name} is not in the table"));
    };
    let (now, allowed) = (figure.value, figure.allowed(before));
    let is_near = (now - before).abs() <= allowed;
    (!is_near).then(|| format!("{name}: {now:.5}, not {before:.5} ± {allowed:.5}"))
}

fn read(table: &Path) -> Table {
    let text = std::fs::read_to_string(table).unwrap_or_default();
    text.parse().expect("tests/figures.toml is TOML")
}

/// Replaces a section; locked, as several tests write the same file.
fn write(table: &Path, section: &str, figures: &[Figure]) {
    let lock = Path::new(env!("CARGO_TARGET_TMPDIR")).join("figures.lock");
    let held: File = OpenOptions::new().create(true).append(true).open(lock).unwrap();
    held.lock().unwrap();
    let mut sections = read(table);
    let values = figures.iter().map(|f| (f.name.to_owned(), Value::Float(rounded(f.value))));
    sections.insert(section.to_owned(), Value::Table(values.collect()));
    let written = table.with_extension("new");
    std::fs::write(&written, format!("{HEAD}\n{}", toml::to_string(&sections).unwrap())).unwrap();
    std::fs::rename(&written, table).unwrap();
}

/// Four digits suffice for a tolerance of a fifth.
fn rounded(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap()
}
