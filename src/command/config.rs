//! `semidense config`: the effective configuration, and where each value comes from.

use std::process::ExitCode;

use clap::Args;
use serde_json::{Value, json};

use crate::command::print::print;
use crate::command::{CommandResult, CommonArguments};
use crate::service::config::{Config, KeyInForce, Origin};

/// Print the effective configuration, and where each value comes from
///
/// What is printed can be saved as a configuration file. The keys, their units and what each is for are explained in
/// the shipped file, config/semidense.toml or /etc/semidense/semidense.toml.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    semidense config                                     # the keys that a user may want to set\n  \
    semidense config --changed                           # what differs from the built-in values\n  \
    semidense config --config config/presets/webcam.toml --changed\n  \
    semidense config --all --set mapper.threads=2 > my.toml")]
pub struct ConfigArguments {
    /// Print the expert keys too
    #[arg(long)]
    all: bool,
    /// Print only the keys whose value is not the built-in one
    #[arg(long)]
    changed: bool,
    /// Print JSON: an object with value, built_in and origin for each key
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(common: &CommonArguments, arguments: &ConfigArguments) -> CommandResult {
    let keys = Config::keys_in_force(common.file().as_deref(), &common.settings())?;
    let is_wanted = |key: &&KeyInForce| match arguments.changed {
        true => key.built_in.is_some(),
        false => arguments.all || !key.is_expert,
    };
    let wanted: Vec<_> = keys.iter().filter(is_wanted).collect();
    let text = match arguments.json {
        true => format!("{}\n", Value::Object(wanted.iter().map(|key| as_json(key)).collect())),
        false => as_toml(&wanted),
    };
    print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// `key = value   # origin`, below the table that the key belongs to.
fn as_toml(keys: &[&KeyInForce]) -> String {
    /// Column of the origins where lines are short enough.
    const ORIGIN_COLUMN: usize = 40;
    let mut text = String::new();
    let mut last_table = "";
    for key in keys {
        let (table, name) = key.key.rsplit_once('.').unwrap_or(("", &key.key));
        if table != last_table {
            text += &format!("\n[{table}]\n");
            last_table = table;
        }
        let line = format!("{name} = {}", key.value);
        text += &format!("{line:<ORIGIN_COLUMN$} # {}\n", origin(key));
    }
    match text.is_empty() {
        true => "# every value is the built-in one\n".to_owned(),
        false => text.trim_start().to_owned(),
    }
}

fn origin(key: &KeyInForce) -> String {
    let from = match &key.origin {
        Origin::BuiltIn => "built-in".to_owned(),
        Origin::File(path) => path.display().to_string(),
        Origin::CommandLine => "command line".to_owned(),
    };
    match &key.built_in {
        Some(built_in) => format!("{from}; built-in {built_in}"),
        None => from,
    }
}

fn as_json(key: &KeyInForce) -> (String, Value) {
    let from = match &key.origin {
        Origin::BuiltIn => json!("built-in"),
        Origin::File(path) => json!(path.display().to_string()),
        Origin::CommandLine => json!("command line"),
    };
    // TOML values that JSON has, too, but for numbers that are none.
    let value =
        |text: &str| -> Value { serde_json::from_str(text).unwrap_or_else(|_| json!(text)) };
    let object = json!({
        "value": value(&key.value),
        "built_in": value(key.built_in.as_deref().unwrap_or(&key.value)),
        "origin": from,
    });
    (key.key.clone(), object)
}
