//! Frames from before the keyframe, kept to give depth to the new pixels of the next one.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::slam::geometry::se3::SE3;
use crate::slam::pose::Brightness;

/// A past frame.
#[derive(Debug)]
pub(super) struct PastFrame {
    /// Grey values, level 0.
    pub(super) pixels: Arc<[u8]>,
    /// The keyframe that it was tracked on.
    pub(super) keyframe_id: u64,
    /// The camera's pose on that keyframe, in its unit.
    pub(super) keyframe_from_camera: SE3,
    /// Its brightness relative to the active keyframe.
    pub(super) brightness: Brightness,
}

/// A bounded list of past frames; the oldest are dropped.
#[derive(Debug)]
pub(super) struct PastFrames {
    frames: VecDeque<PastFrame>,
    capacity: usize,
}

impl PastFrames {
    /// Creates an empty list of at most `capacity` frames.
    pub(super) fn with_capacity(capacity: usize) -> Self {
        Self { frames: VecDeque::with_capacity(capacity + 1), capacity }
    }

    /// Removes all frames.
    pub(super) fn clear(&mut self) {
        self.frames.clear();
    }

    /// Appends the copy of a frame.
    pub(super) fn push(
        &mut self,
        pixels: Arc<[u8]>,
        keyframe_id: u64,
        keyframe_from_camera: SE3,
        brightness: Brightness,
    ) {
        if self.frames.len() >= self.capacity {
            self.frames.pop_front();
        }
        let frame = PastFrame { pixels, keyframe_id, keyframe_from_camera, brightness };
        self.frames.push_back(frame);
    }

    /// Expresses every brightness relative to a new keyframe, whose brightness relative to the previous one is `new`:
    /// with `I_new = eᵃ I + b` a frame's `(a', b')` becomes `(a' − a, b' − e^(a' − a) b)`.
    pub(super) fn rebase(&mut self, new: Brightness) {
        for past in &mut self.frames {
            let a = past.brightness.a - new.a;
            past.brightness = Brightness { a, b: past.brightness.b - a.exp() * new.b };
        }
    }

    /// The frames, the newest first.
    pub(super) fn newest_first(&self) -> impl Iterator<Item = &PastFrame> {
        self.frames.iter().rev()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn brightness_follows_the_keyframe() {
        let mut past = PastFrames::with_capacity(4);
        // I_f = e^0.3 I_k + 5 and I_n = e^0.1 I_k − 2: a grey of 100 in the new keyframe.
        past.push([2].into(), 0, SE3::identity(), Brightness::default());
        past.push([1].into(), 0, SE3::identity(), Brightness { a: 0.3, b: 5.0 });
        past.rebase(Brightness { a: 0.1, b: -2.0 });
        let shown = |b: Brightness| b.a.exp() * 100.0 + b.b;
        let in_keyframe = (100.0 + 2.0) / 0.1f64.exp();
        let mut newest_first = past.newest_first();
        let frame = newest_first.next().unwrap();
        assert!((shown(frame.brightness) - (0.3f64.exp() * in_keyframe + 5.0)).abs() < 1e-9);
        let before = newest_first.next().unwrap();
        assert!((shown(before.brightness) - in_keyframe).abs() < 1e-9);
    }

    #[test]
    fn the_oldest_frame_is_dropped() {
        let mut past = PastFrames::with_capacity(2);
        for i in 0..5u8 {
            past.push([i].into(), 0, SE3::identity(), Brightness::default());
        }
        let kept: Vec<u8> = past.newest_first().map(|f| f.pixels[0]).collect();
        assert_eq!(kept, [4, 3]);
    }
}
