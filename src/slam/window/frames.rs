//! Frames between keyframes, aligned again once the points are more accurate.
//!
//! The tracker aligned a frame to depth that was still being estimated; its errors, tilt above all, are in the frame's
//! pose relative to the keyframe and stay there when the keyframe moves.

use std::sync::Arc;

use crate::slam::geometry::se3::SE3;
use crate::slam::map::RealignedFrame;
use crate::slam::window::Window;

/// Frames aligned with one adjustment: twice as many as lie between two keyframes at 30 Hz, so that the backlog of an
/// epoch's first keyframes is cleared without delaying it.
const MAX_FRAMES_AT_ONCE: usize = 30;
/// … or, of a camera at 60 or 120 Hz, as many as wait beyond this share of the most that may: at that limit those that
/// have waited longest are dropped. Up to the share frames wait, as poses and points still improve.
const BACKLOG_SHARE: f64 = 0.5;
/// Up to this many are aligned in the time of one or two frames.
const FEW_FRAMES: usize = 8;
/// Keyframes after its own that a frame of an epoch's first keyframes waits for: all of these move with each estimate,
/// and the frame moves with its own.
const FIRST_LAG: usize = 4;

/// A tracked frame to be aligned again, or a frame from before its map started.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackedFrame {
    /// Its sequence number.
    pub sequence: u64,
    /// Those of the frames after it that repeat its image.
    pub repeats: Vec<u64>,
    /// The keyframe that it was tracked on.
    pub keyframe_id: u64,
    /// Its pose on the keyframe, in the keyframe's unit.
    pub keyframe_from_camera: SE3,
    /// Whether that is only a guess: no pose was known when the frame arrived.
    pub is_guess: bool,
    /// Grey values.
    pub pixels: Arc<[u8]>,
}

/// Frames that wait and frames that were aligned.
#[derive(Debug, Clone, Default)]
pub(super) struct WindowFrames {
    waiting: Vec<TrackedFrame>,
    placed: Vec<RealignedFrame>,
    /// Set where frames that have waited long enough are to be aligned: whether after an epoch's first keyframes.
    planned: Option<bool>,
    /// Whether the window was taken out for that.
    is_begun: bool,
    /// Whether that alignment is done.
    is_done: bool,
}

impl WindowFrames {
    /// Keeps the pose that was found for a frame, if any, for it and its repeats.
    pub(super) fn place(&mut self, frame: &TrackedFrame, placed: Option<RealignedFrame>) {
        let Some(placed) = placed else { return };
        let repeats = frame.repeats.iter().map(|&sequence| RealignedFrame { sequence, ..placed });
        self.placed.extend([placed].into_iter().chain(repeats));
    }
}

impl Window {
    /// Takes the frames tracked since the last call, in their order.
    pub fn take_frames(&mut self, frames: &mut Vec<TrackedFrame>) {
        let waiting = &mut self.frames.waiting;
        waiting.append(frames);
        let excess = waiting.len().saturating_sub(self.params.max_waiting_frames);
        waiting.drain(..excess);
    }

    /// Takes the frames that were aligned again since the last call.
    pub fn take_realigned(&mut self) -> Vec<RealignedFrame> {
        std::mem::take(&mut self.frames.placed)
    }

    /// After an estimate: plans the alignment of frames that have waited long enough as a separate task where they are
    /// many, so that the keyframes need not wait. Aligns them at once where they are few, since keyframes in such close
    /// succession should not wait for a task, and where those of the estimate before are still pending.
    pub(super) fn plan_frames(&mut self, newest: usize, is_first: bool) {
        let end = self.num_followed(newest, is_first);
        let is_ready = |frame: &&TrackedFrame| self.index_of(frame.keyframe_id) < Some(end);
        let are_many = self.frames.waiting.iter().filter(is_ready).count() > FEW_FRAMES;
        match self.frames.planned.take() {
            None if are_many => self.frames.planned = Some(is_first),
            _ => self.realign_frames(newest, is_first),
        }
    }

    /// Begins a planned alignment of frames, by [`Window::optimise`]; false without one. Call it when all else is done.
    pub fn begin_frames(&mut self) -> bool {
        self.frames.is_begun = self.frames.planned.is_some();
        self.frames.is_begun
    }

    /// Aligns the frames if the window was taken out for them; false otherwise.
    pub(super) fn realign_planned_frames(&mut self) -> bool {
        if !std::mem::take(&mut self.frames.is_begun) {
            return false;
        }
        if let (Some(newest), Some(is_first)) =
            (self.keyframes.len().checked_sub(1), self.frames.planned.take())
        {
            self.realign_frames(newest, is_first);
            let members = self.choose_members(newest).members;
            self.free_unused_images(&members);
        }
        self.frames.is_done = true;
        true
    }

    /// Takes the frames that were aligned, if the window was taken out for them alone.
    pub fn take_planned_frames(&mut self) -> Option<Vec<RealignedFrame>> {
        std::mem::take(&mut self.frames.is_done).then(|| self.take_realigned())
    }

    /// Aligns the frames whose keyframes enough others have followed, more among an epoch's first ones.
    fn realign_frames(&mut self, newest: usize, is_first: bool) {
        let backlog = (BACKLOG_SHARE * self.params.max_waiting_frames as f64) as usize;
        let excess = self.frames.waiting.len().saturating_sub(backlog);
        let most = MAX_FRAMES_AT_ONCE.max(excess);
        self.realign_frames_before(self.num_followed(newest, is_first), most);
    }

    /// Number of keyframes that enough others have followed.
    fn num_followed(&self, newest: usize, is_first: bool) -> usize {
        let lag =
            if is_first { self.params.frame_lag.max(FIRST_LAG) } else { self.params.frame_lag };
        (newest + 1).saturating_sub(lag)
    }

    /// Aligns all frames that still wait.
    pub fn realign_rest(&mut self) {
        self.frames.planned = None;
        self.realign_frames_before(self.keyframes.len(), usize::MAX);
    }

    fn realign_frames_before(&mut self, end: usize, most: usize) {
        let mut waiting = std::mem::take(&mut self.frames.waiting);
        let mut left = most;
        self.retrace(&mut waiting, end, &mut left);
        waiting.retain(|frame| {
            let index = self.index_of(frame.keyframe_id);
            if frame.is_guess || left == 0 || index.is_some_and(|index| index >= end) {
                return true;
            }
            left -= 1;
            let placed = index.and_then(|index| self.realign_frame(index, frame));
            self.frames.place(frame, placed);
            false
        });
        self.frames.waiting = waiting;
    }
}

#[cfg(test)]
pub(super) mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::test_scene::CAMERA;
    use crate::slam::window::keyframe::WindowKeyframe;
    use crate::slam::window::params::WindowParams;
    use crate::slam::window::surface::Surface;

    pub fn frame(keyframe_id: u64) -> TrackedFrame {
        TrackedFrame {
            sequence: keyframe_id,
            repeats: Vec::new(),
            keyframe_id,
            keyframe_from_camera: SE3::identity(),
            is_guess: false,
            pixels: vec![0; CAMERA.width * CAMERA.height].into(),
        }
    }

    /// A window of eight keyframes without points, and a frame on each that waits.
    fn window() -> Window {
        let mut window = Window::new(CAMERA, WindowParams::default());
        window.keyframes = (0..8)
            .map(|keyframe_id| WindowKeyframe {
                keyframe_id,
                epoch: 0,
                images: Vec::new(),
                camera_from_map: SE3::identity(),
                unit: 1.0,
                points: Vec::new(),
                is_host: false,
                agreed: Vec::new(),
                surface: Surface::default(),
            })
            .collect();
        window.take_frames(&mut (0..8).map(frame).collect());
        window
    }

    #[test]
    fn frames_of_an_epochs_first_keyframes_wait_for_more_keyframes_but_not_for_all() {
        let left = |is_first| {
            let mut window = window();
            window.realign_frames(7, is_first);
            window.frames.waiting.iter().map(|frame| frame.keyframe_id).collect::<Vec<_>>()
        };
        assert_eq!(left(true), [4, 5, 6, 7]);
        assert_eq!(left(false), [7]);
    }

    #[test]
    fn frames_of_a_fast_camera_are_aligned_before_they_would_be_dropped() {
        for (waiting, left) in [(20, 0), (80, 50), (130, 100), (190, 100)] {
            let mut window = window();
            window.frames.waiting = vec![frame(3); waiting];
            window.realign_frames(7, false);
            assert_eq!(window.frames.waiting.len(), left, "{waiting}");
        }
    }

    #[test]
    fn repeats_get_the_pose_of_their_image() {
        let mut frames = WindowFrames::default();
        let frame = TrackedFrame { repeats: vec![4, 5], ..frame(3) };
        let placed = RealignedFrame {
            sequence: 3,
            keyframe_id: 1,
            keyframe_from_camera: SE3::exp(&Vector6::repeat(0.1)),
        };
        frames.place(&frame, None);
        assert!(frames.placed.is_empty());
        frames.place(&frame, Some(placed));
        let expected = [3, 4, 5].map(|sequence| RealignedFrame { sequence, ..placed });
        assert_eq!(frames.placed, expected);
    }

    #[test]
    fn many_frames_are_aligned_separately_and_few_with_the_estimate() {
        let left = |window: &Window| window.frames.waiting.len();
        let mut few = window();
        few.plan_frames(7, false);
        assert_eq!((left(&few), few.begin_frames()), (1, false));
        let many = || {
            let mut many = window();
            many.take_frames(&mut (0..20).map(|_| frame(3)).collect());
            many.plan_frames(7, false);
            many
        };
        let mut alone = many();
        assert_eq!((left(&alone), alone.begin_frames()), (28, true));
        assert!(alone.optimise().is_none());
        assert_eq!((left(&alone), alone.begin_frames()), (1, false));
        assert!(alone.take_planned_frames().is_some() && alone.take_planned_frames().is_none());
        // The next keyframe arrives before that.
        let mut overtaken = many();
        overtaken.plan_frames(7, false);
        assert_eq!((left(&overtaken), overtaken.begin_frames()), (1, false));
    }
}
