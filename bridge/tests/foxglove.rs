//! The Foxglove WebSocket protocol, tested with Foxglove's own client.

mod sample_run;
mod support;

use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

use sample_run::{REALTIME, frame, graph, health, keyframe, pose, script};
use semidense_bridge::feed::FeedEnded;
use semidense_bridge::foxglove::{SUBPROTOCOLS, serve};
use semidense_bridge::session::Event;
use serde_json::{Value, json};
use support::{Process, Rig, has_tool, succeed, tools};
use tungstenite::handshake::server::{Request, Response};

#[test]
fn foxgloves_own_client_receives_what_it_subscribes_to() {
    if !has_client() {
        return;
    }
    for protocol in SUBPROTOCOLS {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let server = std::thread::spawn(move || {
            let (stream, _) = listener.accept().unwrap();
            #[expect(clippy::result_large_err, reason = "tungstenite's own type")]
            let answer = |_: &Request, mut response: Response| {
                let header = protocol.parse().unwrap();
                response.headers_mut().insert("Sec-WebSocket-Protocol", header);
                Ok(response)
            };
            let socket = tungstenite::accept_hdr(stream, answer).unwrap();
            let (sender, events) = sync_channel::<Event>(64);
            std::thread::spawn(move || {
                // One-off messages are sent before anything is subscribed to.
                [Event::Joined, keyframe(1), graph()]
                    .into_iter()
                    .for_each(|e| sender.send(e).unwrap());
                for sequence in 0.. {
                    let more = [frame(sequence), pose(sequence), health("tracker")];
                    if more.into_iter().any(|event| sender.send(event).is_err()) {
                        return;
                    }
                    std::thread::sleep(Duration::from_millis(10));
                }
            });
            serve(socket, "left", |timeout| match events.recv_timeout(timeout) {
                Ok(event) => Ok(Some(event)),
                Err(RecvTimeoutError::Timeout) => Ok(None),
                Err(RecvTimeoutError::Disconnected) => Err(FeedEnded),
            })
        });
        let found = run_client(&address.to_string(), protocol, "left");
        check(&found, "left");
        assert_eq!(found["cloudPoints"], 500);
        let seconds = REALTIME / 1_000_000_000;
        let stamp = found["odomSeconds"].as_i64().unwrap();
        assert!((seconds..seconds + 60).contains(&stamp), "{stamp}");
        server.join().unwrap().unwrap();
    }
}

#[test]
fn the_port_of_the_live_page_accepts_foxglove_clients() {
    if !has_client() {
        return;
    }
    let rig = Rig::new();
    let (_view, address) = rig.view(&[]);
    let mut run = Process::start(rig.run(80, &["--live", "loop:20000:8:sim"]));
    let host = address.strip_prefix("http://").unwrap().split('/').next().unwrap();
    for protocol in SUBPROTOCOLS {
        check(&run_client(host, protocol, "semidense"), "semidense");
    }
    assert!(run.is_running());
}

/// Whether Foxglove's client and the decoder for ROS 2 messages that it uses are installed.
fn has_client() -> bool {
    has_tool(&tools().join("node_modules/@foxglove/ws-protocol"))
}

/// What Foxglove's client receives at an address.
fn run_client(address: &str, protocol: &str, instance: &str) -> Value {
    let mut client = Command::new("node");
    client.arg(script("foxglove_client.mjs")).args([address, protocol, instance]);
    client.env("NODE_MODULES", tools().join("node_modules"));
    client.stdout(Stdio::piped()).stderr(Stdio::piped());
    serde_json::from_str(&succeed(client)).unwrap()
}

fn check(found: &Value, instance: &str) {
    assert_eq!(found["name"], instance);
    assert_eq!(found["encodings"], json!(["cdr"]));
    let topics = found["topics"].as_array().unwrap();
    assert!(topics.len() >= 12, "{topics:?}");
    // Every topic was subscribed to, and its messages decode with its schema.
    for topic in topics {
        assert!(found["counts"][topic.as_str().unwrap()].as_u64() > Some(0), "{topic}: {found}");
    }
    assert_eq!(found["odom"], json!(["odom", format!("{instance}_optical_frame")]));
    assert_eq!(found["imageFormat"], "jpeg");
    assert!(found["status"].as_str().unwrap().starts_with(instance), "{found}");
    // Nothing arrives after unsubscribing; an unknown channel is a warning and does not end the connection.
    assert_eq!(found["afterUnsubscribe"], 0);
    assert!(found["warning"].as_str().unwrap().contains("there is no channel 999"), "{found}");
}
