//! How often something is sent: at most so many a second, the newest of what came meanwhile.

use std::sync::Arc;
use std::time::{Duration, Instant};

use semidense::slam::keyframe::Keyframe;

/// Lets through at most so many a second.
#[derive(Debug)]
pub struct Rate {
    period: Duration,
    due: Option<Instant>,
}

impl Rate {
    /// At most `rate_hz` a second; a rate that is not positive lets one through a minute.
    pub fn new(rate_hz: f64) -> Self {
        const LONGEST: Duration = Duration::from_secs(60);
        let period = Duration::try_from_secs_f64(1.0 / rate_hz).unwrap_or(LONGEST).min(LONGEST);
        Self { period, due: None }
    }

    /// Whether one may go now; it counts as gone.
    pub fn is_due(&mut self, now: Instant) -> bool {
        let due = self.due.unwrap_or(now);
        if now < due {
            return false;
        }
        // On the grid of the rate where that is kept, so that 15 of 30 frames go and not 10.
        let next = due + self.period;
        self.due = Some(if next > now { next } else { now + self.period });
        true
    }
}

/// The newest revision of the active keyframe.
#[derive(Debug)]
pub struct Latest {
    rate: Rate,
    sent: Option<(u32, u64)>,
    waiting: Option<Arc<Keyframe>>,
}

impl Latest {
    /// At most `rate_hz` revisions a second.
    pub fn new(rate_hz: f64) -> Self {
        Self { rate: Rate::new(rate_hz), sent: None, waiting: None }
    }

    /// Takes in a revision.
    pub fn take(&mut self, keyframe: Arc<Keyframe>) {
        self.waiting = Some(keyframe);
    }

    /// What is to be sent now: another keyframe at once, a revision when it is due.
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

    /// The run is over.
    pub fn forget(&mut self) {
        (self.sent, self.waiting) = (None, None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_kept() {
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
