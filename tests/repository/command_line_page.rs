//! docs/command-line.md is the help of every command, as printed by the program. After a change of the command line,
//! regenerate it: `SEMIDENSE_WRITE_REFERENCE=1 cargo test --release --test repository command_line_page`.

use std::fmt::Write;
use std::path::Path;

use clap::Command;

/// Width of the help on the page, columns.
const WIDTH: usize = 100;

/// The help of `command` and its subcommands, one section each.
fn section(command: &mut Command, path: &str, page: &mut String) {
    let name = format!("{path}{}", command.get_name());
    let help = command.clone().term_width(WIDTH).bin_name(&name).render_long_help().to_string();
    let common = help.find("\nCommon options:");
    // Only in the section of the program itself.
    let help = match common.filter(|_| !path.is_empty()) {
        Some(at) => &help[..at],
        None => &help,
    };
    let lines: Vec<&str> = help.trim_end().lines().map(str::trim_end).collect();
    write!(page, "\n## {name}\n\n```text\n{}\n```\n", lines.join("\n")).unwrap();
    let names: Vec<String> = command.get_subcommands().map(|c| c.get_name().to_owned()).collect();
    for below in names.iter().filter(|below| *below != "help") {
        section(command.find_subcommand_mut(below).unwrap(), &format!("{name} "), page);
    }
}

#[test]
fn the_page_equals_the_help_of_the_program() {
    let mut page = "# Command line\n\nEvery command with its options, as `--help` prints them; the options that all \
                    commands have stand with the program itself.\n"
        .to_owned();
    let mut program = semidense::command::command_line();
    program.build();
    section(&mut program, "", &mut page);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/command-line.md");
    if std::env::var_os("SEMIDENSE_WRITE_REFERENCE").is_some() {
        std::fs::write(&path, &page).unwrap();
    }
    let written = std::fs::read_to_string(&path).unwrap_or_default();
    let differs = written.lines().zip(page.lines()).position(|(a, b)| a != b);
    let told = differs.map(|line| (line + 1, page.lines().nth(line).unwrap_or_default()));
    assert!(
        written == page,
        "docs/command-line.md is not what the program says, from line {told:?}: \
         SEMIDENSE_WRITE_REFERENCE=1 cargo test --release --test repository command_line_page"
    );
}
