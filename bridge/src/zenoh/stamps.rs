//! Converts stamps of CLOCK_MONOTONIC to the receiver's clock. Those of CLOCK_REALTIME and `capture_nanos`
//! are unchanged: the former is common to all machines, the latter belongs to the camera or the recording.

use crate::zenoh::clock_offset::ClockOffset;
use crate::zenoh::unpack::Arrival;

/// Converts the stamps of a message that arrived at `now_nanos`: nothing was sent after it arrived.
pub fn translate(arrival: &mut Arrival, clock: &ClockOffset, now_nanos: i64) {
    let local = |stamp: &mut i64| *stamp = clock.local_nanos(*stamp).min(now_nanos);
    match arrival {
        Arrival::Pose(message) => local(&mut message.published_nanos),
        Arrival::Health(_, message) => {
            local(&mut message.published_nanos);
            local(&mut message.started_nanos);
        }
        Arrival::Frame(header, _) => {
            local(&mut header.clock_nanos);
            local(&mut header.sent_nanos);
        }
        _ => {}
    }
}
