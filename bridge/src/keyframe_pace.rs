//! How often a keyframe is passed on: its depth is refined with nearly every frame, and point clouds are large.

use std::sync::Arc;
use std::time::{Duration, Instant};

use semidense::slam::keyframe::Keyframe;

/// Minimum time between two revisions of the same keyframe.
const PERIOD: Duration = Duration::from_secs(1);

/// Passes on a new keyframe at once, then one revision a second, and its last one when the next keyframe arrives.
#[derive(Debug, Default)]
pub struct KeyframePace {
    /// Name and time of the last one passed on.
    passed: Option<(KeyframeName, Instant)>,
    waiting: Option<Arc<Keyframe>>,
}

/// Epoch and id.
type KeyframeName = (u32, u64);

fn name(keyframe: &Keyframe) -> KeyframeName {
    (keyframe.epoch, keyframe.keyframe_id)
}

impl KeyframePace {
    /// Takes a keyframe received at `now`; returns those to pass on.
    pub fn take(&mut self, keyframe: Arc<Keyframe>, now: Instant) -> Vec<Arc<Keyframe>> {
        let newest = name(&keyframe);
        let waited = self.waiting.take().filter(|waiting| name(waiting) != newest);
        let mut ready: Vec<Arc<Keyframe>> = waited.into_iter().collect();
        let is_early = |(passed, at): (KeyframeName, Instant)| {
            passed == newest && now.saturating_duration_since(at) < PERIOD
        };
        if self.passed.is_some_and(is_early) {
            self.waiting = Some(keyframe);
        } else {
            self.passed = Some((newest, now));
            ready.push(keyframe);
        }
        ready
    }

    /// The pending revision, for the end of the run.
    pub fn finish(&mut self) -> Option<Arc<Keyframe>> {
        self.waiting.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use semidense::slam::geometry::intrinsics::Intrinsics;
    use semidense::slam::geometry::sim3::Sim3;

    fn keyframe(keyframe_id: u64, revision: u64) -> Arc<Keyframe> {
        let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5, width: 2, height: 2 };
        let mut keyframe = Keyframe::at(Sim3::identity(), intrinsics, Vec::new(), Vec::new());
        (keyframe.keyframe_id, keyframe.revision) = (keyframe_id, revision);
        Arc::new(keyframe)
    }

    #[test]
    fn the_first_and_last_revision_are_passed_on_with_one_a_second_between() {
        let start = Instant::now();
        let mut pace = KeyframePace::default();
        let mut take = |millis: u64, id, revision| -> Vec<(u64, u64)> {
            let passed = pace.take(keyframe(id, revision), start + Duration::from_millis(millis));
            passed.iter().map(|k| (k.keyframe_id, k.revision)).collect()
        };
        assert_eq!(take(0, 1, 1), [(1, 1)]);
        assert_eq!(take(500, 1, 2), []);
        assert_eq!(take(1000, 1, 3), [(1, 3)]);
        assert_eq!(take(1100, 1, 4), []);
        assert_eq!(take(1200, 2, 5), [(1, 4), (2, 5)]);
        assert_eq!(take(1300, 2, 6), []);
        assert_eq!(pace.finish().map(|k| k.revision), Some(6));
        assert_eq!(pace.finish(), None);
    }
}
