//! The receiver's view of the sender: its program, its clock, received and missing messages, time last heard.

use std::time::{Duration, Instant};

use semidense::wire::topic::WIRE_VERSION;

use crate::zenoh::clock_offset::{ClockAnswer, ClockOffset};
use crate::zenoh::envelope::Envelope;
use crate::zenoh::kind::Kind;
use crate::zenoh::outlet::{Presence, realtime_offset_nanos};

/// A sender that is silent for longer gives way to another program with its name: presence is queried once a second.
const TAKEOVER_AFTER: Duration = Duration::from_millis(1500);
/// Silence after which health reports the link as down: processes report once a second.
const LONGEST_SILENCE: Duration = Duration::from_secs(3);

/// State of the sender.
#[derive(Debug, Default)]
pub struct Remote {
    /// Converts its stamps.
    pub clock: ClockOffset,
    /// Number of refused malformed messages.
    pub refused: u64,
    sender: Option<u64>,
    run: u64,
    heard: Option<Instant>,
    is_joined: Option<bool>,
    /// Another wire version that was received, and when.
    foreign: Option<(u32, Instant)>,
    /// When another program last sent under the same name.
    rival: Option<Instant>,
    received: [u64; Kind::COUNT],
    lost: [u64; Kind::COUNT],
}

impl Remote {
    /// Whether a message is to be used: from the current sender and run, and new.
    pub fn admit(&mut self, envelope: &Envelope, kind: Kind, now: Instant) -> bool {
        if !self.is_from_sender(envelope, now) || envelope.run < self.run {
            return false;
        }
        self.run = envelope.run;
        let received = &mut self.received[kind as usize];
        if envelope.number <= *received {
            return false;
        }
        if *received > 0 {
            self.lost[kind as usize] += envelope.number - *received - 1;
        }
        *received = envelope.number;
        true
    }

    /// Processes an answer about presence; returns the kinds kept there and missing here.
    pub fn answer(
        &mut self,
        envelope: &Envelope,
        presence: &Presence,
        clock: ClockAnswer,
        now: Instant,
    ) -> Vec<Kind> {
        if !self.is_from_sender(envelope, now) {
            return Vec::new();
        }
        self.clock.take(clock);
        self.is_joined = Some(presence.is_joined != 0);
        let is_missing =
            |kind: &Kind| presence.newest[*kind as usize] > self.received[*kind as usize];
        Kind::ALL.into_iter().filter(|kind| kind.is_kept()).filter(is_missing).collect()
    }

    /// Records a message of another wire version.
    pub fn note_foreign_version(&mut self, version: u32, now: Instant) {
        if self.foreign.is_none_or(|(known, _)| known != version) {
            tracing::warn!(
                "the robot uses wire version {version}, this program {WIRE_VERSION}: install the same version of semidense-bridge on both"
            );
        }
        self.foreign = Some((version, now));
    }

    /// Why the state is outdated; `None` while the sender and its instance are running.
    pub fn silence_reason(&self, instance: &str, endpoints: &str, now: Instant) -> Option<String> {
        let is_recent = |heard: &Instant| now.saturating_duration_since(*heard) <= LONGEST_SILENCE;
        if self.heard.as_ref().is_none_or(|heard| !is_recent(heard)) {
            let foreign = self.foreign.as_ref().filter(|(_, heard)| is_recent(heard));
            return Some(match foreign {
                Some((version, _)) => format!(
                    "the robot uses wire version {version}, this program {WIRE_VERSION}: install the same version on both"
                ),
                None => format!(
                    "no messages of `{instance}` from {endpoints}: the link is down, or `semidense zenoh send` is not running there"
                ),
            });
        }
        if self.is_joined == Some(false) {
            return Some(format!(
                "the robot is reachable, but its instance `{instance}` is not running"
            ));
        }
        self.rival.as_ref().filter(|heard| is_recent(heard)).map(|_| {
            format!("two programs send as `{instance}`: give each robot its own name (--instance there, --from here)")
        })
    }

    /// Number of messages of a kind that did not arrive.
    pub fn lost(&self, kind: Kind) -> u64 {
        self.lost[kind as usize]
    }

    /// Whether the envelope is from the current sender: the first one heard, or its successor once it has gone.
    fn is_from_sender(&mut self, envelope: &Envelope, now: Instant) -> bool {
        if self.sender != Some(envelope.sender) {
            let is_alive = self
                .heard
                .is_some_and(|heard| now.saturating_duration_since(heard) < TAKEOVER_AFTER);
            if self.sender.is_some() && is_alive {
                if self.rival.is_none() {
                    tracing::warn!("two programs send under the same name; only one is used");
                }
                self.rival = Some(now);
                return false;
            }
            self.begin(envelope.sender);
            self.rival = None;
        }
        self.heard = Some(now);
        self.clock.set_realtime(envelope.realtime_offset_nanos, realtime_offset_nanos());
        true
    }

    /// Starts over with another sender, whose numbers and clock are new.
    fn begin(&mut self, sender: u64) {
        self.sender = Some(sender);
        (self.run, self.is_joined) = (0, None);
        self.received = [0; Kind::COUNT];
        self.clock = ClockOffset::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::zenoh::envelope::{Origin, Packed, open, seal};

    fn envelope(sender: u64, run: u64, number: u64) -> Envelope {
        let origin = Origin { sender, run, sent_nanos: 0, realtime_offset_nanos: 0 };
        open(&seal(&origin, Kind::Pose, number, &0_u64, &Packed::empty())).unwrap().envelope
    }

    const ANSWER: ClockAnswer = ClockAnswer { asked_nanos: 0, remote_nanos: 0, answered_nanos: 1 };

    #[test]
    fn a_message_is_used_once_and_lost_ones_are_counted() {
        let (mut remote, now) = (Remote::default(), Instant::now());
        let mut admit = |run, number| remote.admit(&envelope(1, run, number), Kind::Pose, now);
        assert!(admit(1, 5) && admit(1, 6) && !admit(1, 6) && admit(1, 9));
        assert!(admit(2, 10) && !admit(1, 11), "of the run before");
        assert_eq!(remote.lost(Kind::Pose), 2);
    }

    #[test]
    fn another_sender_is_accepted_once_the_first_has_gone() {
        let (mut remote, now) = (Remote::default(), Instant::now());
        assert!(remote.admit(&envelope(1, 3, 50), Kind::Pose, now));
        assert!(!remote.admit(&envelope(2, 1, 1), Kind::Pose, now));
        assert!(remote.silence_reason("rig", "x", now).unwrap().contains("two programs"));
        let later = now + TAKEOVER_AFTER;
        assert!(remote.admit(&envelope(2, 1, 1), Kind::Pose, later));
        let cause = remote.silence_reason("rig", "x", later).unwrap_or_default();
        assert!(!cause.contains("two programs"), "only one sends now: {cause}");
    }

    #[test]
    fn silence_is_reported_with_its_cause() {
        let (mut remote, now) = (Remote::default(), Instant::now());
        let cause = |remote: &Remote, now| remote.silence_reason("rig", "tcp/robot:7447", now);
        assert!(cause(&remote, now).unwrap().contains("tcp/robot:7447"));
        remote.note_foreign_version(WIRE_VERSION + 1, now);
        let both = cause(&remote, now).unwrap();
        assert!(both.contains(&format!("version {}", WIRE_VERSION + 1)), "{both}");
        let mut presence = Presence { is_joined: 1, newest: [0; Kind::COUNT] };
        presence.newest[Kind::Graph as usize] = 4;
        let missing = remote.answer(&envelope(1, 1, 0), &presence, ANSWER, now);
        assert_eq!((missing, cause(&remote, now)), (vec![Kind::Graph], None));
        presence.is_joined = 0;
        remote.answer(&envelope(1, 1, 0), &presence, ANSWER, now);
        assert!(cause(&remote, now).unwrap().contains("is not running"));
        assert!(cause(&remote, now + 2 * LONGEST_SILENCE).unwrap().contains("no messages"));
    }
}
