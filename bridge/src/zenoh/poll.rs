//! Queries the sender's presence once a second, which gives its clock and reveals missed messages. Messages
//! that it keeps and that are missing here (a late start, a cut link, a drop) are fetched.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use semidense::service::clock::now_nanos;
use zenoh::bytes::ZBytes;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Session, Wait};

use crate::zenoh::clock_offset::ClockAnswer;
use crate::zenoh::kind::Kind;
use crate::zenoh::shared::Shared;
use crate::zenoh::unpack::{Arrival, unpack};

/// Time between two queries.
const PERIOD: Duration = Duration::from_secs(1);
/// The same until the first answer.
const FIRST_PERIOD: Duration = Duration::from_millis(200);
/// Upper limit for the wait for an answer.
const LONGEST_ANSWER: Duration = Duration::from_secs(2);

/// Queries until the other end of `stop` is dropped.
pub fn poll(network: &Session, instance: &str, shared: &Shared, stop: &Receiver<()>) {
    let mut period = FIRST_PERIOD;
    let mut missing_before = Vec::new();
    loop {
        let missing = ask(network, instance, shared);
        if let Some(missing) = missing {
            // Missing twice in a row: a message in transit needs no second copy. At the start nothing is in transit.
            let is_first = period == FIRST_PERIOD;
            let fetched = missing.iter().filter(|kind| is_first || missing_before.contains(*kind));
            fetched.for_each(|kind| fetch(network, instance, shared, *kind));
            missing_before = missing;
            period = PERIOD;
        }
        if stop.recv_timeout(period) != Err(RecvTimeoutError::Timeout) {
            return;
        }
    }
}

/// Sends one query; returns the missing kinds, or `None` without an answer.
fn ask(network: &Session, instance: &str, shared: &Shared) -> Option<Vec<Kind>> {
    let asked_nanos = now_nanos();
    let mut missing = None;
    get(network, &Kind::Presence.key(instance), Priority::RealTime, |bytes| {
        let answered_nanos = now_nanos();
        let bytes = bytes.to_bytes();
        let Some(opened) = shared.open(Kind::Presence, &bytes) else { return };
        let Ok(Arrival::Presence(presence)) = unpack(&opened) else {
            shared.remote().refused += 1;
            return;
        };
        let remote_nanos = opened.envelope.sent_nanos;
        let clock = ClockAnswer { asked_nanos, remote_nanos, answered_nanos };
        let lacks = shared.remote().answer(&opened.envelope, &presence, clock, Instant::now());
        missing.get_or_insert_with(Vec::new).extend(lacks);
    });
    missing
}

/// Fetches the last message of a kind.
fn fetch(network: &Session, instance: &str, shared: &Shared, kind: Kind) {
    get(network, &kind.key(instance), Priority::DataLow, |bytes| {
        shared.arrive(kind, bytes.clone())
    });
}

fn get(network: &Session, key: &str, priority: Priority, mut take: impl FnMut(&ZBytes)) {
    let asked = network
        .get(key)
        // Every answer as it arrives: two robots with one name must be detected.
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Drop)
        .priority(priority)
        .express(true)
        .timeout(LONGEST_ANSWER)
        .wait();
    let Ok(replies) = asked else { return };
    while let Ok(reply) = replies.recv() {
        if let Ok(sample) = reply.result() {
            take(sample.payload());
        }
    }
}
