//! The scenes, by name.

use std::str::FromStr;

use serde::de::IntoDeserializer;
use serde::de::value::Error;
use serde::{Deserialize, Serialize};

/// The scene that is simulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SceneKind {
    /// A furnished room of 6 × 5 × 3 m.
    Room,
    /// One large printed plane, seen from 1.5 m above.
    Plane,
    /// A corridor of 24 × 2.4 × 2.6 m.
    Corridor,
    /// Four furnished rooms around a corridor, 9 × 10 × 2.7 m, walked through in rounds.
    Flat,
    /// Two identical rooms on a repeating corridor, 13.8 × 5.8 × 2.7 m.
    Twins,
}

impl FromStr for SceneKind {
    type Err = &'static str;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::deserialize(name.into_deserializer())
            .map_err(|_: Error| "unknown scene; scenes are room, plane, corridor, flat and twins")
    }
}
