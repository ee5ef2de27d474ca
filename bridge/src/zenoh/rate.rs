//! Rate limits that let through the newest item.

use std::sync::Arc;
use std::time::{Duration, Instant};

use semidense::slam::keyframe::Keyframe;

/// Lets through a limited number of items per second.
#[derive(Debug)]
pub struct Rate {
    period: Duration,
    due: Option<Instant>,
}

impl Rate {
    /// At most `rate_hz` per second; a rate that is not positive lets one through per minute.
    pub fn new(rate_hz: f64) -> Self {
        const LONGEST: Duration = Duration::from_secs(60);
        let period = Duration::try_from_secs_f64(1.0 / rate_hz).unwrap_or(LONGEST).min(LONGEST);
        Self { period, due: None }
    }

    /// Whether an item may be sent now; if so, it counts as sent.
    pub fn is_due(&mut self, now: Instant) -> bool {
        let due = self.due.unwrap_or(now);
        if now < due {
            return false;
        }
        // On the grid of the rate if that is kept, so that 15 of 30 frames are sent and not 10.
        let next = due + self.period;
        self.due = Some(if next > now { next } else { now + self.period });
        true
    }
}

/// Limits the rate of revisions of the active keyframe.
#[derive(Debug)]
pub struct Latest {
    rate: Rate,
    sent: Option<(u32, u64)>,
    waiting: Option<Arc<Keyframe>>,
}

impl Latest {
    /// At most `rate_hz` revisions per second.
    pub fn new(rate_hz: f64) -> Self {
        Self { rate: Rate::new(rate_hz), sent: None, waiting: None }
    }

    /// Replaces the pending revision.
    pub fn take(&mut self, keyframe: Arc<Keyframe>) {
        self.waiting = Some(keyframe);
    }

    /// The keyframe to send now: another one at once, a revision when it is due.
    pub fn due(&mut self, now: Instant) -> Option<Arc<Keyframe>> {
        let id = self.waiting.as_ref().map(|k| (k.epoch, k.keyframe_id))?;
        if self.sent != Some(id) {
            self.rate.due = None;
        }
        if !self.rate.is_due(now) {
            return None;
        }
        self.sent = Some(id);
        self.waiting.take()
    }

    /// Forgets the keyframe at the end of a run.
    pub fn forget(&mut self) {
        (self.sent, self.waiting) = (None, None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_not_exceeded() {
        let start = Instant::now();
        let count = |rate_hz: f64| {
            let mut rate = Rate::new(rate_hz);
            let frames = (0..300).map(|i| start + Duration::from_micros(33_333) * i);
            frames.filter(|now| rate.is_due(*now)).count()
        };
        assert_eq!(count(100.0), 300);
        assert!((145..=155).contains(&count(15.0)), "{}", count(15.0));
        assert!((95..=105).contains(&count(10.0)), "{}", count(10.0));
        assert_eq!([count(0.0), count(f64::NAN), count(-1.0)], [1; 3]);
    }
}
