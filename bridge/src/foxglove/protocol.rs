//! Messages of the Foxglove WebSocket protocol: JSON, and binary ones with a short header.

use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::ros::schema::{full_name, schema};
use crate::ros::topic::RosTopic;

/// Opcode of a binary message that carries data.
const MESSAGE_DATA: u8 = 1;
/// Bytes before the data: opcode, subscription, time.
const HEADER_BYTES: usize = 1 + 4 + 8;

#[derive(Serialize)]
struct Advertisement {
    op: &'static str,
    channels: Vec<ChannelInfo>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct ChannelInfo {
    id: usize,
    topic: String,
    encoding: &'static str,
    schema_name: String,
    schema: String,
    schema_encoding: &'static str,
}

/// A request of a client.
#[derive(Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub enum Request {
    /// Subscribe to channels.
    Subscribe {
        /// The new subscriptions.
        subscriptions: Vec<Subscription>,
    },
    /// End subscriptions.
    Unsubscribe {
        /// Their ids.
        subscription_ids: Vec<u32>,
    },
    /// Any other operation, which is not offered.
    #[serde(other)]
    Other,
}

/// A subscription to a channel.
#[derive(Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Subscription {
    /// Id chosen by the client.
    pub id: u32,
    /// Number of the channel.
    pub channel_id: u32,
}

/// The first message to a client of `instance`; a client that sees a new session discards its state.
pub fn server_info(instance: &str, session: i64) -> String {
    let info = json!({
        "op": "serverInfo",
        "name": instance,
        "capabilities": [],
        "supportedEncodings": ["cdr"],
        "metadata": { "semidense": env!("CARGO_PKG_VERSION") },
        "sessionId": session.to_string(),
    });
    info.to_string()
}

/// Advertises the channels, numbered by index.
pub fn advertisement(topics: &[&RosTopic], instance: &str) -> String {
    let channel = |(id, topic): (usize, &&RosTopic)| ChannelInfo {
        id,
        topic: topic.full_name(instance),
        encoding: "cdr",
        schema_name: full_name(topic.message_type),
        schema: schema(topic.message_type).unwrap_or_default(),
        schema_encoding: "ros2msg",
    };
    let channels = topics.iter().enumerate().map(channel).collect();
    let advertisement = Advertisement { op: "advertise", channels };
    // Serialising this structure cannot fail.
    serde_json::to_string(&advertisement).unwrap_or_default()
}

/// A status message that the client shows as a warning: level 1 of 0 to 2.
pub fn warning(message: &str) -> String {
    json!({ "op": "status", "level": 1, "message": message }).to_string()
}

/// A data message for a subscription.
pub fn message_frame(subscription: u32, realtime_nanos: i64, data: &[u8]) -> Vec<u8> {
    let mut frame = Vec::with_capacity(HEADER_BYTES + data.len());
    frame.push(MESSAGE_DATA);
    frame.extend(subscription.to_le_bytes());
    frame.extend(u64::try_from(realtime_nanos).unwrap_or_default().to_le_bytes());
    frame.extend(data);
    frame
}

/// Parses a client's text, or explains why it is not understood.
pub fn parse_request(text: &str) -> Result<Request, String> {
    serde_json::from_str(text).map_err(|error| format!("invalid message: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::topic::ODOMETRY;

    #[test]
    fn requests_are_parsed_and_others_are_errors() {
        let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":1}]}"#;
        let subscriptions = vec![Subscription { id: 7, channel_id: 1 }];
        assert_eq!(parse_request(subscribe), Ok(Request::Subscribe { subscriptions }));
        let unsubscribe = r#"{"op":"unsubscribe","subscriptionIds":[7,8]}"#;
        let subscription_ids = vec![7, 8];
        assert_eq!(parse_request(unsubscribe), Ok(Request::Unsubscribe { subscription_ids }));
        assert_eq!(parse_request(r#"{"op":"getParameters","x":1}"#), Ok(Request::Other));
        for wrong in
            ["", "{}", r#"{"op":"subscribe"}"#, r#"{"op":"unsubscribe","subscriptionIds":[-1]}"#]
        {
            assert!(parse_request(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn messages_have_the_form_of_the_protocol() {
        let frame = message_frame(0x0102, 3, &[9, 8]);
        assert_eq!(frame, [1, 2, 1, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0, 9, 8]);
        let text = advertisement(&[&ODOMETRY], "left");
        let start = r#"{"op":"advertise","channels":[{"id":0,"topic":"/left/odom","encoding":"cdr","schemaName":"nav_msgs/msg/Odometry","schema":"std_msgs/Header header\n"#;
        assert!(text.starts_with(start), "{text}");
        assert!(text.ends_with(r#","schemaEncoding":"ros2msg"}]}"#), "{text}");
    }
}
