//! Message definitions as carried by recordings and Foxglove (`ros2msg`), and the hashes of their types.

use std::collections::BTreeSet;

use crate::ros::message::{Declared, FieldType, MESSAGES, Vector3};
use crate::ros::own_message::OWN_MESSAGES;

/// Line between the definitions of a schema.
const SEPARATOR: &str =
    "================================================================================";

/// The name of a type as the tools of ROS 2 spell it: `nav_msgs/msg/Odometry` for `nav_msgs/Odometry`.
pub fn full_name(name: &str) -> String {
    name.replacen('/', "/msg/", 1)
}

/// The hash of a type, as `RIHS01_…`; `None` for a type without a topic here.
pub fn type_hash(name: &str) -> Option<String> {
    let (_, hash, _) = known(name)?;
    Some(format!("RIHS01_{}", (*hash)?))
}

fn known(name: &str) -> Option<&'static Declared> {
    MESSAGES.iter().chain(OWN_MESSAGES).find(|(known, ..)| *known == name)
}

fn definition(name: &str) -> Option<String> {
    // A point has the fields of a vector.
    let name = if name == "geometry_msgs/Point" { Vector3::TYPE } else { name };
    known(name).map(|(.., definition)| definition())
}

/// The complete definition of a type: its fields, then each type they use, in the form `ros2msg`. `None` for
/// an unknown type.
pub fn schema(name: &str) -> Option<String> {
    let mut text = definition(name)?;
    let mut seen = BTreeSet::from([name.to_owned()]);
    let mut waiting = vec![text.clone()];
    while let Some(fields) = waiting.pop() {
        for line in fields.lines() {
            let used = line.split([' ', '[']).next().unwrap_or_default();
            let Some(used_fields) = definition(used) else { continue };
            if seen.insert(used.to_owned()) {
                text.push_str(&format!("{SEPARATOR}\nMSG: {used}\n{used_fields}"));
                waiting.push(used_fields);
            }
        }
    }
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_schema_contains_every_type_that_it_uses_once() {
        for (name, ..) in MESSAGES.iter().filter(|(_, hash, _)| hash.is_some()) {
            let text = schema(name).unwrap();
            for line in text.lines().filter(|line| !line.starts_with("MSG: ")) {
                let word = line.split([' ', '[']).next().unwrap();
                if word.contains('/') {
                    let section = format!("MSG: {word}\n");
                    assert_eq!(text.matches(&section).count(), 1, "{name}: {word}");
                }
            }
        }
        assert_eq!(schema("std_msgs/String"), None);
        assert_eq!(full_name("nav_msgs/Odometry"), "nav_msgs/msg/Odometry");
    }
}
