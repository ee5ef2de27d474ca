//! Writes the files that a package installs next to the binary and that the command line itself describes:
//! man pages and shell completions.
//!
//!     cargo run --release -p semidense-bridge --example bridge_package_files -- FOLDER

use std::error::Error;
use std::path::{Path, PathBuf};

use clap_complete::{Shell, generate_to};

/// Name of the binary.
const NAME: &str = "semidense-bridge";

fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args_os().nth(1).map(PathBuf::from);
    let folder = folder.ok_or("say where to: bridge_package_files FOLDER")?;
    std::fs::create_dir_all(&folder)?;
    write_completions(&folder)?;
    write_manual(&folder)
}

/// `semidense-bridge.bash`, `_semidense-bridge` (zsh) and `semidense-bridge.fish`.
fn write_completions(folder: &Path) -> Result<(), Box<dyn Error>> {
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        generate_to(shell, &mut semidense_bridge::command::command_line(), NAME, folder)?;
    }
    Ok(())
}

/// `semidense-bridge.1`, and a page for each subcommand.
fn write_manual(folder: &Path) -> Result<(), Box<dyn Error>> {
    Ok(clap_mangen::generate_to(semidense_bridge::command::command_line(), folder)?)
}
