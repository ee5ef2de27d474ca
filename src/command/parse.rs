//! Parses the command line. Extends the errors of `clap`: they name the commands an option belongs to, and
//! the range that a negative number misses.

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, Command, Error, Parser};

/// Parses the command line; prints help, version or an error and ends the process.
pub fn parse<T: Parser>() -> T {
    try_parse(std::env::args_os()).unwrap_or_else(|error| error.exit())
}

fn try_parse<T: Parser, W: Into<std::ffi::OsString> + Clone>(
    words: impl IntoIterator<Item = W>,
) -> Result<T, Error> {
    let mut command = with_negative_numbers(T::command());
    let matches = command.try_get_matches_from_mut(words);
    let matches = matches.map_err(|error| with_owner(&command, error))?;
    T::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// Leaves the common option `--instance` out of the help of a command that has nothing to do with any instance. It
/// is still accepted: scripts pass it to every command.
pub fn no_instance() -> Arg {
    Arg::new("instance").long("instance").value_name("NAME").hide(true)
}

/// Takes `-3` as the value of the preceding option, not as an option.
fn with_negative_numbers(command: Command) -> Command {
    let command = command.mut_args(|argument| {
        let is_valued = argument.get_action().takes_values() && !argument.is_positional();
        argument.allow_negative_numbers(is_valued)
    });
    command.mut_subcommands(with_negative_numbers)
}

/// For an unknown option, names the commands that have it instead of explaining how to pass it as a value.
fn with_owner(command: &Command, mut error: Error) -> Error {
    if error.kind() != ErrorKind::UnknownArgument || names_command(&error) {
        return error;
    }
    let Some(ContextValue::String(option)) = error.get(ContextKind::InvalidArg) else {
        return error;
    };
    let mut owners = Vec::new();
    list_owners(command, "", option, &mut owners);
    let Some((last, others)) = owners.split_last() else { return error };
    let owners = match others {
        [] => last.clone(),
        _ => format!("{} and {last}", others.join(", ")),
    };
    let tip = format!("'{option}' belongs to {owners}").into();
    error.remove(ContextKind::SuggestedArg);
    error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip]));
    error
}

/// Whether the error already names the command that has the option, as it does if the option precedes that command.
fn names_command(error: &Error) -> bool {
    let Some(ContextValue::StyledStrs(tips)) = error.get(ContextKind::Suggested) else {
        return false;
    };
    tips.iter().any(|tip| tip.to_string().ends_with("exists"))
}

/// Collects the commands below `command` that have `option`, with their parent commands.
fn list_owners(command: &Command, path: &str, option: &str, owners: &mut Vec<String>) {
    for below in command.get_subcommands() {
        let name = format!("{path}{}", below.get_name());
        let is_it = |long: Option<&str>| long.is_some() && long == option.strip_prefix("--");
        if below.get_arguments().any(|a| !a.is_hide_set() && is_it(a.get_long())) {
            owners.push(format!("'{name}'"));
        }
        list_owners(below, &format!("{name} "), option, owners);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::CommandLine;

    fn refused(line: &str) -> String {
        let error = try_parse::<CommandLine, _>(line.split_whitespace()).map(drop).unwrap_err();
        error.to_string()
    }

    #[test]
    fn an_option_of_another_command_names_its_owner() {
        let error = refused("semidense run DIR --debug-images");
        assert!(error.contains("tip: '--debug-images' belongs to 'replay'\n"), "{error}");
        assert!(!error.contains("as a value"), "{error}");
        let error = refused("semidense replay DIR --live");
        let tip = "tip: '--live' belongs to 'run', 'capture', 'tracker' and 'mapper'\n";
        assert!(error.contains(tip), "{error}");
        let error = refused("semidense run DIR --frames 5");
        assert!(error.contains("belongs to 'replay', "), "{error}");
        assert!(error.contains("'bench soak'"), "{error}");
        let error = refused("semidense --live run");
        assert!(error.contains("'run --live' exists"), "{error}");
        assert!(!refused("semidense run --fast").contains("belongs"));
    }

    #[test]
    fn commands_that_concern_no_instance_offer_none_but_accept_one() {
        let without = [
            ("evaluate", "evaluate a b"),
            ("cameras", "cameras"),
            ("map info", "map info m"),
            ("map merge", "map merge a b --output c"),
        ];
        for (name, line) in without {
            for line in [
                format!("semidense {line} --instance x"),
                format!("semidense --instance x {line}"),
                format!("semidense {line}"),
            ] {
                let parsed = try_parse::<CommandLine, _>(line.split(' ')).map(drop);
                assert!(parsed.is_ok(), "{line}: {parsed:?}");
            }
            let help = refused(&format!("semidense {name} --help"));
            assert!(help.contains("--config") && !help.contains("--instance"), "{help}");
        }
        for line in
            ["status --instance x", "--instance x map save", "map export m --output o --instance x"]
        {
            let line = format!("semidense {line}");
            let CommandLine { common, .. } = try_parse(line.split(' ')).unwrap();
            assert_eq!(common.instance.as_deref(), Some("x"), "{line}");
        }
        for name in ["status", "map", "map load", "replay"] {
            assert!(refused(&format!("semidense {name} --help")).contains("--instance"), "{name}");
        }
    }

    #[test]
    fn a_negative_number_is_a_value() {
        let line = "semidense simulate --output out --noise -3 --tremor=-1";
        let CommandLine { command, .. } = try_parse(line.split_whitespace()).unwrap();
        assert!(format!("{command:?}").contains("noise: Some(-3.0)"), "{command:?}");
        let error = refused("semidense bench soak --frames -3");
        assert!(error.contains("invalid value '-3' for '--frames <N>'"), "{error}");
        assert!(refused("semidense run -x").contains("unexpected argument"));
    }
}
