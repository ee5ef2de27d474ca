//! The two parts of a configuration file: keys that a user may want at the top, all others below `[expert]`.
//!
//! `expert.` belongs to the file, not to the program: a key is the same with and without it. Moving a key from one part
//! to the other breaks no file and no script, and each algorithm keeps its parameters in one struct.

use std::ops::Range;

use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// The table of keys that nobody has to set.
pub const EXPERT: &str = "expert";

/// Keys outside `[expert]`: what a camera, a robot, a recording or a first try may need.
const USER_KEYS: [&str; 43] = [
    "instance",
    "root",
    "capture.source",
    "capture.rig",
    "capture.mask",
    "capture.strict",
    "capture.scheduling.policy",
    "capture.scheduling.priority",
    "capture.scheduling.cpus",
    "capture.scheduling.lock_memory",
    "capture.camera.format",
    "capture.camera.rate_hz",
    "capture.camera.exposure_us",
    "capture.camera.gain",
    "capture.camera.white_balance_k",
    "capture.camera.focus",
    "tracker.deadline_ms",
    "tracker.early_wake_us",
    "tracker.stale_periods",
    "tracker.scheduling.policy",
    "tracker.scheduling.priority",
    "tracker.scheduling.cpus",
    "tracker.scheduling.lock_memory",
    "mapper.threads",
    "mapper.scheduling.policy",
    "mapper.scheduling.priority",
    "mapper.scheduling.cpus",
    "mapper.scheduling.lock_memory",
    "map.folder",
    "map.read_only",
    "map.detail",
    "mapping.depth_filter",
    "mapping.max_map_megabytes",
    "supervisor.watchdog_s",
    "results.max_relative_std_dev",
    "results.map_resolution",
    "results.pcd",
    "results.full_points",
    "results.alignment",
    "simulator.scene",
    "simulator.seed",
    "simulator.frames",
    "simulator.motion.mean_speed_m_s",
];

/// Replaced keys and their replacements, which take the same values.
const MOVED_KEYS: [(&str, &str); 7] = [
    ("tracking.alignment.pixel_noise", "noise.pixel_std_dev"),
    ("tracking.alignment.model_noise", "noise.model_std_dev"),
    ("tracking.reference.selection.intensity_std_dev", "noise.model_std_dev"),
    ("mapping.matching.image_noise", "noise.pixel_std_dev"),
    ("mapping.two_frame.fit.image_noise", "noise.pixel_std_dev"),
    ("mapping.two_frame.max_witnesses", "mapping.two_frame.max_earlier_frames"),
    (
        "mapping.two_frame.evidence.min_early_witnesses",
        "mapping.two_frame.evidence.min_earlier_frames",
    ),
];

/// An error in the two parts of a file.
#[derive(Debug, PartialEq, Eq)]
pub struct LayoutError {
    /// What is wrong.
    pub reason: String,
    /// Byte range of the text that it refers to.
    pub span: Range<usize>,
}

/// The dotted `key` as the shipped file lists it.
pub fn listed(key: &str) -> String {
    if USER_KEYS.contains(&key) { key.to_owned() } else { format!("{EXPERT}.{key}") }
}

/// The dotted `key` without `expert.`.
pub fn plain(key: &str) -> &str {
    key.strip_prefix(EXPERT).and_then(|rest| rest.strip_prefix('.')).unwrap_or(key)
}

/// The replacement of the dotted `key`, as the shipped file lists it; `None` for one in use or one that never existed.
pub fn moved(key: &str) -> Option<String> {
    MOVED_KEYS.iter().find(|(before, _)| *before == key).map(|(_, now)| listed(now))
}

/// Refuses a replaced key, in a table without `[expert]`, and names its replacement.
pub fn find_moved(root: &DeTable) -> Result<(), LayoutError> {
    for (before, now) in MOVED_KEYS {
        let mut keys = before.split('.');
        let first = keys.next().and_then(|key| root.get(key));
        let found = keys.fold(first, |value, key| value?.get_ref().as_table()?.get(key));
        if let Some(value) = found {
            let reason = format!("`{before}` is now `{}`", listed(now));
            return Err(LayoutError { reason, span: value.span() });
        }
    }
    Ok(())
}

/// Moves keys below `[expert]` to their place without it. A key in both places is an error.
pub fn merge(root: &mut DeTable) -> Result<(), LayoutError> {
    let Some(expert) = root.remove(EXPERT) else { return Ok(()) };
    let span = expert.span();
    match expert.into_inner() {
        DeValue::Table(expert) => merge_into(root, expert, ""),
        _ => Err(LayoutError { reason: "expected keys below it".to_owned(), span }),
    }
}

fn merge_into<'a>(
    table: &mut DeTable<'a>,
    from: DeTable<'a>,
    prefix: &str,
) -> Result<(), LayoutError> {
    for (key, value) in from {
        let path = format!("{prefix}{}", key.get_ref());
        let Some(there) = table.get_mut(&key) else {
            table.insert(key, value);
            continue;
        };
        let span = there.span();
        match (there.get_mut(), value.into_inner()) {
            (DeValue::Table(there), DeValue::Table(inner)) => {
                merge_into(there, inner, &format!("{path}."))?;
            }
            _ => {
                let reason = format!("`{path}` is also given as `{EXPERT}.{path}`: keep one");
                return Err(LayoutError { reason, span });
            }
        }
    }
    Ok(())
}

/// Splits the `flat` table of all keys into two parts, as in the shipped file.
pub fn split(flat: &Table) -> Table {
    let is_user = |(key, _): &(String, Value)| listed(key) == *key;
    let (user, expert): (Vec<_>, Vec<_>) = flatten(flat).into_iter().partition(is_user);
    let mut table = Table::new();
    for (key, value) in user.into_iter().chain(expert) {
        // Cannot fail: no value of the flat table is also a table.
        let _ = put(&mut table, &listed(&key), value);
    }
    table
}

/// The dotted keys in `table` and its subtables, with their values.
pub fn flatten(table: &Table) -> Vec<(String, Value)> {
    let mut keys = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => {
                let below = flatten(inner).into_iter();
                keys.extend(below.map(|(rest, value)| (format!("{key}.{rest}"), value)));
            }
            value => keys.push((key.clone(), value.clone())),
        }
    }
    keys
}

/// Puts the value of a dotted key into `table`; an error if one of its parts has a value itself.
pub fn put(mut table: &mut Table, key: &str, value: Value) -> Result<(), String> {
    let mut keys: Vec<&str> = key.split('.').map(str::trim).collect();
    let last = keys.pop().unwrap_or_default();
    for key in keys {
        let entry = table.entry(key).or_insert_with(|| Value::Table(Table::new()));
        table = entry.as_table_mut().ok_or_else(|| format!("`{key}` has no keys below it"))?;
    }
    table.insert(last.to_owned(), value);
    Ok(())
}
