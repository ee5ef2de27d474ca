//! Every bad input that we can think of: the attempt, the message and the exit code. Nothing panics, nothing hangs,
//! nothing is left behind; `docs/bad-inputs.md` lists what this test observed.

mod table;

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::rendered::rendered;
use crate::support::{Ended, Rig, finish};
use table::{Row, SECTIONS};

/// Frames of the recording that is damaged.
const FRAMES: usize = 20;

/// If set, the page is regenerated: `SEMIDENSE_WRITE_DOCS=1 cargo test --release --test files bad_input`.
const WRITE_VARIABLE: &str = "SEMIDENSE_WRITE_DOCS";

/// Functions that rows may call besides the system's programs. Each row starts in a folder with a recording of twenty
/// frames (`recording`, TUM layout, 160x120) and its rig (`rig.toml`).
const PRELUDE: &str = r#"
image() { ls recording/rgb/*.png | sed -n "$1p"; }
change() { sed -i "$2" "$1"; }
until_said() {
    word=$1; shift
    "$@" 2> said & until grep -q "$word" said; do sleep 0.1; done
    kill -INT $!; wait $!; code=$?
    cat said >&2
    return $code
}
halve() { truncate -s $(($(stat -c %s "$1") / 2)) "$1"; }
"#;

const RIG: &str =
    "model = \"pinhole\"\nwidth = 160\nheight = 120\nfx = 131\nfy = 131\ncx = 79.5\ncy = 59.5\n";

/// A shell in the folder of `rig` in which `semidense` is the real binary.
fn shell(rig: &Rig, script: &str) -> Command {
    // Found by name on the path, so that programs like `timeout` find it too.
    let programs = rig.folder().join("bin");
    if fs::create_dir(&programs).is_ok() {
        let binary = env!("CARGO_BIN_EXE_semidense");
        std::os::unix::fs::symlink(binary, programs.join("semidense")).unwrap();
    }
    let paths = std::env::var("PATH").unwrap_or_default();
    let mut command = Command::new("bash");
    command
        .arg("-c")
        .arg(format!("{PRELUDE}\n{script}"))
        .env("PATH", format!("{}:{paths}", programs.display()))
        .current_dir(rig.folder())
        .env("SEMIDENSE_ROOT", rig.root())
        .env_remove("XDG_RUNTIME_DIR")
        .env("LC_ALL", "C.UTF-8")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

/// The message in the form of the page: the error with the command or tip below it, else the first warning, and the
/// last line of the result if that reports skipped images. Machine-dependent parts are replaced.
fn said(ended: &Ended, rig: &Rig) -> String {
    let find = |start: &str| ended.stderr.lines().find(|line| line.contains(start));
    let below = ended.stderr.lines().skip_while(|line| !line.starts_with("error: ")).skip(1);
    let below =
        below.map(str::trim).find(|line| line.starts_with("mkdir ") || line.starts_with("tip: "));
    let line = find("error: ").or_else(|| find("waiting: ")).or_else(|| find(" WARN "));
    let line = line.or_else(|| find("warning: ")).unwrap_or_default();
    let line = match line.split_once(" WARN ") {
        Some((_, text)) => format!("warning: {text}"),
        None => line.to_owned(),
    };
    let line = below.map_or(line.clone(), |below| format!("{line}<br>{below}"));
    let last = ended.stdout.lines().last().filter(|line| line.contains("left out"));
    let line = last.map_or(line.clone(), |last| format!("{line}<br>{last}"));
    let line = line.replace(&rig.folder().display().to_string(), "…");
    let mut text = String::new();
    let mut words = line.split(' ').peekable();
    while let Some(word) = words.next() {
        let is_measured = words.peek() == Some(&"MB") && word.parse::<u64>().is_ok();
        text += if is_measured { "N" } else { word };
        text += " ";
    }
    text.trim_end().to_owned()
}

/// Runs a row; returns its line of the page, or what is wrong with the message.
fn observe(row: &Row, template: &Path) -> Result<String, String> {
    let rig = Rig::new();
    let copied = Command::new("cp").arg("-r").arg(template).arg(rig.folder()).status();
    assert!(copied.unwrap().success());
    fs::write(rig.folder().join("rig.toml"), RIG).unwrap();
    let made = finish(shell(&rig, &format!("set -e\n{}", row.setup)));
    let ended = finish(shell(&rig, row.command));
    let (code, said, stderr) = (ended.status.code(), said(&ended, &rig), &ended.stderr);
    let errors = stderr.lines().filter(|line| line.starts_with("error: ")).count();
    let left = rig.leftovers();
    let missing: Vec<_> = row.words.iter().filter(|word| !said.contains(**word)).collect();
    let is_as_told = made.status.success()
        && code == Some(row.code)
        && !stderr.contains("panicked")
        && errors == usize::from(matches!(row.code, 1 | 2))
        && missing.is_empty()
        && left.is_empty();
    if !is_as_told {
        return Err(format!(
            "{} ({}): exit {code:?}, {errors} errors, without {missing:?}, left {left:?}\n  said {said}\n  {}{stderr}{}",
            row.tried, row.command, made.stderr, ended.stdout
        ));
    }
    // Escapes what a Markdown table would interpret.
    let cell = |text: &str| text.replace('|', "\\|").replace('*', "\\*");
    let command = row.command.replace('|', "\\|");
    Ok(format!("| {} | `{command}` | {} | {} |\n", cell(row.tried), cell(&said), row.code))
}

#[test]
fn every_bad_input_has_its_line_and_exit_code() {
    let rig = Rig::new();
    let template = rendered(&rig, FRAMES);
    // They mostly wait for processes to start: run the sections in parallel.
    let seen: Vec<Vec<Result<String, String>>> = std::thread::scope(|scope| {
        let observe_all = |section: &'static table::Section| {
            let template = &template;
            move || section.rows.iter().map(|row| observe(row, template)).collect()
        };
        let threads: Vec<_> = SECTIONS.iter().map(|s| scope.spawn(observe_all(s))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    let mut page = table::INTRODUCTION.to_owned();
    let (mut rows, mut faults) = (0, Vec::new());
    for (section, seen) in SECTIONS.iter().zip(seen) {
        page += &format!(
            "\n## {}\n\n| input | command | message | exit |\n|---|---|---|---|\n",
            section.title
        );
        for row in seen {
            match row {
                Ok(line) => page += &line,
                Err(wrong) => faults.push(wrong),
            }
            rows += 1;
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n\n"));
    assert!(rows >= 40, "{rows} rows");
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/bad-inputs.md");
    if std::env::var_os(WRITE_VARIABLE).is_some() {
        fs::write(path, &page).unwrap();
    }
    let written = fs::read_to_string(path).unwrap_or_default();
    for (seen, stands) in page.lines().zip(written.lines()) {
        assert_eq!(
            seen, stands,
            "docs/bad-inputs.md is out of date: write it with {WRITE_VARIABLE}=1"
        );
    }
    assert_eq!(page.lines().count(), written.lines().count(), "write it with {WRITE_VARIABLE}=1");
}

/// Checks for exit code 1 and exactly one error, with these words.
fn assert_refused(ended: &Ended, words: &[&str], what: &str) {
    assert_eq!(ended.status.code(), Some(1), "{what}: {}", ended.stderr);
    assert!(!ended.stderr.contains("panicked"), "{what}: {}", ended.stderr);
    let errors: Vec<_> = ended.stderr.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{what}: {}", ended.stderr);
    for word in words {
        assert!(errors[0].contains(word), "{what}: `{word}` is not in: {}", errors[0]);
    }
}

#[test]
fn paths_of_arbitrary_bytes_are_accepted() {
    let rig = Rig::new();
    let folder = rendered(&rig, FRAMES);
    let odd = r"$(printf 'b\xffd $x')";
    fs::write(rig.folder().join("rig.toml"), RIG).unwrap();
    let script = format!(
        "set -e\nmv '{}' \"{odd}\"; cp rig.toml \"{odd}.toml\"; echo > \"{odd}.conf\"\n\
         semidense --config \"{odd}.conf\" run \"{odd}\" --rig \"{odd}.toml\" --output \"{odd}-run\"\n\
         semidense --config \"{odd}.conf\" replay \"tum:{odd}\" --rig \"{odd}.toml\" --output \"{odd}-replay\"\n\
         cmp \"{odd}-run/trajectory_online.txt\" \"{odd}-replay/trajectory_online.txt\"\n\
         semidense simulate --frames 1 --output \"{odd}-sim\" --json\n\
         semidense evaluate \"{odd}/groundtruth.txt\" \"{odd}/groundtruth.txt\" --plot \"{odd}.svg\"",
        folder.display()
    );
    let ended = finish(shell(&rig, &script));
    assert!(ended.status.success(), "{}", ended.stderr);
    assert_eq!(rig.leftovers(), Vec::<String>::new());
}

/// The binary in a shell whose children may write files of at most a few kilobytes: to a program this looks much like
/// a full disk.
fn with_small_files(rig: &Rig, arguments: &str) -> Command {
    let mut command = Command::new("sh");
    command
        .arg("-c")
        .arg(format!(
            "ulimit -f 16; trap '' XFSZ; exec '{}' {arguments}",
            env!("CARGO_BIN_EXE_semidense")
        ))
        .env("SEMIDENSE_ROOT", rig.root())
        .stdin(std::process::Stdio::null())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped());
    command
}

#[test]
fn results_that_do_not_fit_give_one_line_and_no_partial_file() {
    let rig = Rig::new();
    let output = rig.output();
    let arguments = format!("replay sim --frames 2 --output '{}'", output.display());
    let ended = finish(with_small_files(&rig, &arguments));
    assert_refused(&ended, &["output/report.html", "MB are free", "--output"], "full folder");
    let names: Vec<String> = fs::read_dir(&output)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    // The run is not lost: only its journal is left.
    assert!(names.len() == 1 && names[0].starts_with(".semidense-journal"), "{names:?}");
}

#[test]
fn a_full_standard_output_is_an_error_and_a_closed_pipe_is_not() {
    let rig = Rig::new();
    let folder = rendered(&rig, FRAMES);
    let truth = folder.join("groundtruth.txt");
    let evaluate = || {
        let mut command = rig.command(&["evaluate"]);
        command.arg(&truth).arg(&truth);
        command
    };
    let mut command = evaluate();
    command.stdout(fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    assert_refused(&finish(command), &["standard output"], "/dev/full");

    let mut replay = rig.command(&["replay", "--output", rig.output().to_str().unwrap()]);
    replay.arg(&folder);
    for mut command in [evaluate(), replay] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        command.stdout(writer);
        let ended = finish(command);
        assert!(ended.status.success() && ended.stderr.is_empty(), "{}", ended.stderr);
    }
}
