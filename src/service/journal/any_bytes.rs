//! Paths in JSON: text where they are text, else their bytes.

use std::ffi::OsString;
use std::os::unix::ffi::{OsStrExt, OsStringExt};

use serde::{Deserialize, Deserializer, Serialize, Serializer};

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Path {
    Text(String),
    Bytes(Vec<u8>),
}

impl From<&OsString> for Path {
    fn from(path: &OsString) -> Self {
        match path.to_str() {
            Some(text) => Self::Text(text.to_owned()),
            None => Self::Bytes(path.as_bytes().to_vec()),
        }
    }
}

impl From<Path> for OsString {
    fn from(path: Path) -> Self {
        match path {
            Path::Text(text) => text.into(),
            Path::Bytes(bytes) => Self::from_vec(bytes),
        }
    }
}

pub(super) fn serialize<S: Serializer>(path: &OsString, to: S) -> Result<S::Ok, S::Error> {
    Path::from(path).serialize(to)
}

pub(super) fn deserialize<'a, D: Deserializer<'a>>(from: D) -> Result<OsString, D::Error> {
    Path::deserialize(from).map(OsString::from)
}

/// The same for an optional path.
pub(super) mod optional {
    use super::{Deserialize, Deserializer, OsString, Path, Serialize, Serializer};

    pub(in super::super) fn serialize<S: Serializer>(
        path: &Option<OsString>,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        path.as_ref().map(Path::from).serialize(to)
    }

    pub(in super::super) fn deserialize<'a, D: Deserializer<'a>>(
        from: D,
    ) -> Result<Option<OsString>, D::Error> {
        Ok(Option::<Path>::deserialize(from)?.map(OsString::from))
    }
}
