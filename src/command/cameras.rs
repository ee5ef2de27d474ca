//! `semidense cameras`: lists the cameras of this machine and what they offer.

use std::path::Path;
use std::process::ExitCode;

use clap::Args;

use crate::capture::v4l::listing::{Access, CameraReport, ControlReport, FormatReport, cameras};
use crate::command::CommandResult;
use crate::command::parse::no_instance;
use crate::command::print::print_as;

/// List the cameras of this machine: names, formats, sizes, rates and controls
///
/// `v4l:` takes a camera's path, its number or one of its names. A usb-… name follows the camera, a pci-…
/// name the port. Formats in parentheses are not supported.
#[derive(Debug, Args)]
#[command(arg = no_instance())]
pub struct CamerasArguments {
    /// Print the list as JSON
    #[arg(long)]
    json: bool,
}

/// Prints the list.
pub fn run(arguments: CamerasArguments) -> CommandResult {
    let found = cameras(Path::new("/dev"));
    const NONE: &str =
        "no cameras: /dev has no video capture device; recordings and the simulator need none\n";
    print_as(arguments.json, &found, |found| match found.is_empty() {
        true => NONE.to_owned(),
        false => found.iter().map(text_of).collect(),
    })?;
    Ok(ExitCode::SUCCESS)
}

fn text_of(camera: &CameraReport) -> String {
    let mut lines = vec![format!("{}  {}", camera.path.display(), camera.card)];
    let state = match camera.access {
        Access::Free => "free",
        Access::Busy => "busy: another program is streaming from it",
        Access::Forbidden => "permission denied: run usermod -aG video USER and log in again",
        Access::Unusable => "cannot be opened",
    };
    let problem = camera.problem.as_ref().filter(|_| camera.access == Access::Unusable);
    let problem = problem.map_or(String::new(), |problem| format!(" ({problem})"));
    lines.push(format!("  state     {state}{problem}"));
    if !camera.driver.is_empty() {
        lines.push(format!("  driver    {}, {}", camera.driver, camera.bus));
    }
    lines.extend(camera.names.iter().map(|name| format!("  name      {name}")));
    lines.extend(camera.formats.iter().flat_map(format_lines));
    lines.extend(camera.controls.iter().map(control_line));
    lines.join("\n") + "\n"
}

/// One line for the format and its first size, one for each further size.
fn format_lines(format: &FormatReport) -> Vec<String> {
    let code = if format.usable { format.code.clone() } else { format!("({})", format.code) };
    if !format.usable || format.sizes.is_empty() {
        return vec![format!("  format    {code:6} {}", format.description)];
    }
    let line = |(index, size): (usize, &crate::capture::v4l::listing::SizeReport)| {
        let rates: Vec<String> = size.rates_hz.iter().map(|rate| format!("{rate:.4}")).collect();
        let rates: Vec<&str> =
            rates.iter().map(|r| r.trim_end_matches('0').trim_end_matches('.')).collect();
        let rates = match rates.is_empty() {
            true => String::new(),
            false => format!(" at {} Hz", rates.join(", ")),
        };
        let (word, code) = if index == 0 { ("format", code.as_str()) } else { ("", "") };
        format!("  {word:9} {code:6} {}{rates}", size.size)
    };
    format.sizes.iter().enumerate().map(line).collect()
}

fn control_line(control: &ControlReport) -> String {
    let value = control.value.map_or("-".to_owned(), |value| value.to_string());
    let item = control.items.iter().find(|(index, _)| Some(*index as i32) == control.value);
    let item = item.map_or(String::new(), |(_, name)| format!(" ({name})"));
    let fixed = if control.fixed { ", cannot be set now" } else { "" };
    format!(
        "  control   {}: {value}{item}, {} to {} in steps of {}, default {}{fixed}",
        control.name, control.minimum, control.maximum, control.step, control.default
    )
}
