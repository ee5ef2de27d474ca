//! The value of each key, and where it comes from.

use std::path::{Path, PathBuf};

use toml::{Table, Value};

use crate::service::config::{Config, ConfigError, apply, layout};

/// Where a value comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// Built into the program.
    BuiltIn,
    /// The configuration file.
    File(PathBuf),
    /// `--set`, or another option of the command line.
    CommandLine,
}

/// A key with its value.
#[derive(Debug, Clone, PartialEq)]
pub struct EffectiveKey {
    /// The dotted key, as the shipped file lists it.
    pub key: String,
    /// Its value as TOML.
    pub value: String,
    /// The built-in value, where it differs.
    pub built_in: Option<String>,
    /// Where it comes from.
    pub origin: Origin,
    /// Whether it is below `[expert]`.
    pub is_expert: bool,
}

impl Config {
    /// Every key as [`Config::load`] gives it for the same file and settings, in the order of the shipped file.
    pub fn effective_keys(
        file: Option<&Path>,
        settings: &[String],
    ) -> Result<Vec<EffectiveKey>, ConfigError> {
        let config = Self::load(file, settings)?;
        let of_file = file.map(Self::read_table).transpose()?.unwrap_or_default();
        let mut of_line = Table::new();
        for setting in settings {
            apply(&mut of_line, setting).map_err(|reason| ConfigError::Syntax {
                place: format!("--set {setting}"),
                reason,
            })?;
        }
        let (of_file, of_line) = (layout::flatten(&of_file), layout::flatten(&of_line));
        let names = |keys: &[(String, Value)], key: &str| keys.iter().any(|(of, _)| of == key);
        let origin = |key: &str| match file {
            _ if names(&of_line, key) => Origin::CommandLine,
            Some(path) if names(&of_file, key) => Origin::File(path.to_owned()),
            _ => Origin::BuiltIn,
        };
        let defaults = Self::default().flat();
        let keys = config.flat().into_iter().map(|(key, value)| {
            let before = defaults.iter().find(|(known, _)| *known == key);
            let built_in = before.map(|(_, value)| value.clone()).filter(|old| *old != value);
            let listed = layout::listed(&key);
            let is_expert = listed != key;
            EffectiveKey { origin: origin(&key), key: listed, value, built_in, is_expert }
        });
        let (expert, user): (Vec<_>, Vec<_>) = keys.partition(|key| key.is_expert);
        Ok(user.into_iter().chain(expert).collect())
    }

    /// Every key without `expert.`, with its value as TOML.
    fn flat(&self) -> Vec<(String, String)> {
        // As text, numbers keep their shortest form.
        let text = toml::to_string(self).unwrap_or_default();
        let keys = layout::flatten(&text.parse().unwrap_or_default()).into_iter();
        keys.map(|(key, value)| (key, value.to_string())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_has_the_origin_of_its_value() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("robot.toml");
        std::fs::write(&path, "[mapper]\nthreads = 3\n[expert.mapping]\nmin_gradient = 6.5\n")
            .unwrap();
        let settings = ["mapper.threads=1".to_owned(), "instance=\"front\"".to_owned()];
        let keys = Config::effective_keys(Some(&path), &settings).unwrap();
        let find = |name: &str| keys.iter().find(|key| key.key == name).unwrap();
        let threads = find("mapper.threads");
        assert_eq!((threads.value.as_str(), &threads.origin), ("1", &Origin::CommandLine));
        assert_eq!(threads.built_in.as_deref(), Some("0"));
        let gradient = find("expert.mapping.min_gradient");
        assert_eq!((gradient.value.as_str(), &gradient.origin), ("6.5", &Origin::File(path)));
        assert!(gradient.is_expert);
        assert_eq!(find("instance").origin, Origin::CommandLine);
        let deadline = find("tracker.deadline_ms");
        assert_eq!((&deadline.origin, &deadline.built_in), (&Origin::BuiltIn, &None));
        // User keys first; every key once.
        let first_expert = keys.iter().position(|key| key.is_expert).unwrap();
        assert!(keys[first_expert..].iter().all(|key| key.is_expert));
        let mut names: Vec<_> = keys.iter().map(|key| &key.key).collect();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), keys.len());
    }
}
