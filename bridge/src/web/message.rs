//! What a page is sent: a JSON header, and behind it bytes where there are any.

use serde_json::{Value, json};
use tungstenite::Message;

use semidense::service::results::report::scene::framed;

/// A message that is only a header.
pub fn text(header: &Value) -> Message {
    Message::text(header.to_string())
}

/// A message with bytes.
pub fn binary(header: &Value, bytes: &[u8]) -> Message {
    Message::binary(framed(header, bytes))
}

/// The first message: who speaks, and how.
pub fn hello(instance: &str) -> Value {
    json!({ "kind": "hello", "version": env!("CARGO_PKG_VERSION"), "protocol": 1, "instance": instance })
}
