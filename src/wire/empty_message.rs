//! Messages in which nothing has been counted yet.

use zerocopy::FromZeros;

use crate::wire::message::HealthMessage;

impl HealthMessage {
    /// Nothing has been counted, no rate is known.
    pub fn empty() -> Self {
        Self { rate_hz: f64::NAN, ..Self::new_zeroed() }
    }
}
