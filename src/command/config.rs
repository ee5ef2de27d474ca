//! `semidense config`: prints the effective configuration and the origin of each value.

use std::process::ExitCode;

use clap::Args;
use serde_json::{Value, json};

use crate::command::print::print;
use crate::command::{CommandResult, CommonArguments};
use crate::service::config::{Config, EffectiveKey, Origin};

/// Print the effective configuration, and where each value comes from
///
/// The output can be saved as a configuration file. The shipped file, config/semidense.toml or
/// /etc/semidense/semidense.toml, explains each key, its unit and its purpose.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    semidense config                                     # the keys that a user may want to set\n  \
    semidense config --changed                           # what differs from the built-in values\n  \
    semidense config --config config/presets/webcam.toml --changed\n  \
    semidense config --all --set mapper.threads=2 > my.toml")]
pub struct ConfigArguments {
    /// Print expert keys as well
    #[arg(long)]
    all: bool,
    /// Print only the keys whose value differs from the built-in one
    #[arg(long)]
    changed: bool,
    /// Print JSON: an object with value, built_in and origin for each key
    #[arg(long)]
    json: bool,
}

/// Prints the keys.
pub fn run(common: &CommonArguments, arguments: &ConfigArguments) -> CommandResult {
    let keys = Config::effective_keys(common.file().as_deref(), &common.settings())?;
    let wanted = arguments.wanted(&keys);
    let text = match arguments.json {
        true => format!("{}\n", Value::Object(wanted.iter().map(|key| as_json(key)).collect())),
        false => as_toml(&wanted),
    };
    print(&text)?;
    Ok(ExitCode::SUCCESS)
}

impl ConfigArguments {
    /// The keys to print.
    fn wanted<'a>(&self, keys: &'a [EffectiveKey]) -> Vec<&'a EffectiveKey> {
        let is_wanted = |key: &&EffectiveKey| match self.changed {
            true => key.built_in.is_some(),
            false => self.all || !key.is_expert,
        };
        keys.iter().filter(is_wanted).collect()
    }
}

/// `key = value   # origin`, below the table that the key belongs to. A table may be opened only once, and
/// keys without a table must precede the first.
fn as_toml(keys: &[&EffectiveKey]) -> String {
    /// Column of the origins where lines are short enough.
    const ORIGIN_COLUMN: usize = 40;
    let mut tables = vec![("", String::new())];
    for key in keys {
        let (table, name) = key.key.rsplit_once('.').unwrap_or(("", &key.key));
        let line = format!("{name} = {}", key.value);
        let built_in = key.built_in.iter().map(|value| format!("; built-in {value}"));
        let origin = name_of(&key.origin) + &built_in.collect::<String>();
        let line = format!("{line:<ORIGIN_COLUMN$} # {origin}\n");
        match tables.iter_mut().find(|(known, _)| *known == table) {
            Some((_, lines)) => *lines += &line,
            None => tables.push((table, format!("\n[{table}]\n{line}"))),
        }
    }
    let text: String = tables.into_iter().map(|(_, lines)| lines).collect();
    match text.is_empty() {
        true => "# every value is the built-in one\n".to_owned(),
        false => text.trim_start().to_owned(),
    }
}

fn name_of(origin: &Origin) -> String {
    match origin {
        Origin::BuiltIn => "built-in".to_owned(),
        Origin::File(path) => path.display().to_string(),
        Origin::CommandLine => "command line".to_owned(),
    }
}

fn as_json(key: &EffectiveKey) -> (String, Value) {
    // TOML values that JSON has too, except for numbers that are not finite.
    let value =
        |text: &str| -> Value { serde_json::from_str(text).unwrap_or_else(|_| json!(text)) };
    let object = json!({
        "value": value(&key.value),
        "built_in": value(key.built_in.as_deref().unwrap_or(&key.value)),
        "origin": name_of(&key.origin),
    });
    (key.key.clone(), object)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_output_can_be_saved_and_read_again() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("robot.toml");
        std::fs::write(&file, "root = \"/tmp/robot\"\n[capture.camera]\nrate_hz = 15.0\n").unwrap();
        let user = ["instance=front", "mapper.threads=2", "capture.scheduling.cpus=[0, 1]"];
        let expert = ["capture.connect_timeout_s=7.5", "mapping.min_gradient=6.5"];
        let texts = |keys: &[&str]| keys.iter().map(|&key| key.to_owned()).collect::<Vec<_>>();
        let both = texts(&[&user[..], &expert].concat());
        // Expert keys are printed only on request.
        for (all, changed, file, settings) in [
            (false, false, Some(file.as_path()), texts(&user)),
            (true, false, Some(file.as_path()), both.clone()),
            (false, true, Some(file.as_path()), both),
            (false, true, None, Vec::new()),
        ] {
            let keys = Config::effective_keys(file, &settings).unwrap();
            let arguments = ConfigArguments { all, changed, json: false };
            let text = as_toml(&arguments.wanted(&keys));
            let saved = folder.path().join("saved.toml");
            std::fs::write(&saved, &text).unwrap();
            let read = Config::load(Some(&saved), &[]);
            let read = read.unwrap_or_else(|error| panic!("{error}\n{text}"));
            assert_eq!(read, Config::load(file, &settings).unwrap(), "{text}");
        }
    }
}
