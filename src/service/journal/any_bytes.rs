//! Paths in JSON: text where they are text, else their bytes.

use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::OsStringExt;

use serde::{Deserialize, Serialize};

/// A path, or a name with one in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum AnyBytes {
    /// It is text.
    Text(String),
    /// It is not.
    Bytes(Vec<u8>),
}

impl<T: AsRef<OsStr>> From<T> for AnyBytes {
    fn from(path: T) -> Self {
        let text = path.as_ref().to_owned().into_string();
        text.map_or_else(|path| Self::Bytes(path.into_vec()), Self::Text)
    }
}

impl AnyBytes {
    /// The path itself.
    pub fn to_os_string(&self) -> OsString {
        match self {
            Self::Text(text) => text.into(),
            Self::Bytes(bytes) => OsString::from_vec(bytes.clone()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_the_same_after_json() {
        for path in [&b"tum:a \"b\"\n"[..], b"\xff\x00/x", b""] {
            let path = OsString::from_vec(path.to_vec());
            let json = serde_json::to_string(&AnyBytes::from(&path)).unwrap();
            assert_eq!(serde_json::from_str::<AnyBytes>(&json).unwrap().to_os_string(), path);
        }
    }
}
