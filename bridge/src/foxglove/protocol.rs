//! The messages of the Foxglove WebSocket protocol: JSON, and a short header before binary ones.

use serde::{Deserialize, Serialize};

use crate::ros::schema::{full_name, schema};
use crate::ros::topic::RosTopic;

/// The kind of a binary message that holds data.
const MESSAGE_DATA: u8 = 1;
/// Bytes before the data: kind, subscription, time.
const HEADER_BYTES: usize = 1 + 4 + 8;

/// The first message to a client.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct ServerInfo<'a> {
    op: &'static str,
    name: &'a str,
    capabilities: [&'static str; 0],
    supported_encodings: [&'static str; 1],
    metadata: Metadata,
    session_id: String,
}

#[derive(Serialize)]
struct Metadata {
    semidense: &'static str,
}

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

#[derive(Serialize)]
struct Status<'a> {
    op: &'static str,
    /// 0 info, 1 warning, 2 error.
    level: u8,
    message: &'a str,
}

/// What a client may say.
#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
enum ClientMessage {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    #[serde(rename_all = "camelCase")]
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
    #[serde(other)]
    Other,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: u32,
}

/// What a client asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// Subscriptions, each with its number and channel.
    Subscribe(Vec<(u32, u32)>),
    /// Numbers of subscriptions that end.
    Unsubscribe(Vec<u32>),
    /// What is not offered.
    Other,
}

/// A message as text: what is written here always can be.
fn json(message: &impl Serialize) -> String {
    serde_json::to_string(message).unwrap_or_default()
}

/// The first message to a client of `instance`; clients that see another session forget what they had.
pub fn server_info(instance: &str, session: i64) -> String {
    json(&ServerInfo {
        op: "serverInfo",
        name: instance,
        capabilities: [],
        supported_encodings: ["cdr"],
        metadata: Metadata { semidense: env!("CARGO_PKG_VERSION") },
        session_id: session.to_string(),
    })
}

/// The channels, numbered by their place.
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
    json(&Advertisement { op: "advertise", channels })
}

/// A remark that a client shows.
pub fn warning(message: &str) -> String {
    json(&Status { op: "status", level: 1, message })
}

/// Data for a subscription.
pub fn message_frame(subscription: u32, realtime_nanos: i64, data: &[u8]) -> Vec<u8> {
    let mut frame = Vec::with_capacity(HEADER_BYTES + data.len());
    frame.push(MESSAGE_DATA);
    frame.extend(subscription.to_le_bytes());
    frame.extend(u64::try_from(realtime_nanos).unwrap_or_default().to_le_bytes());
    frame.extend(data);
    frame
}

/// What a client's text asks for, or why it is not understood.
pub fn parse_request(text: &str) -> Result<Request, String> {
    match serde_json::from_str(text) {
        Ok(ClientMessage::Subscribe { subscriptions }) => Ok(Request::Subscribe(
            subscriptions.iter().map(|wanted| (wanted.id, wanted.channel_id)).collect(),
        )),
        Ok(ClientMessage::Unsubscribe { subscription_ids }) => {
            Ok(Request::Unsubscribe(subscription_ids))
        }
        Ok(ClientMessage::Other) => Ok(Request::Other),
        Err(error) => Err(format!("a message was not understood: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::topic::ODOMETRY;

    #[test]
    fn requests_are_understood_and_others_are_errors() {
        let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":1}]}"#;
        assert_eq!(parse_request(subscribe), Ok(Request::Subscribe(vec![(7, 1)])));
        let unsubscribe = r#"{"op":"unsubscribe","subscriptionIds":[7,8]}"#;
        assert_eq!(parse_request(unsubscribe), Ok(Request::Unsubscribe(vec![7, 8])));
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
