//! When keyframes are estimated together, and what becomes of it.

use crate::slam::frame::FrameView;
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::pose::PoseEstimate;
use crate::slam::window::Window;
use crate::slam::window::frames::TrackedFrame;

impl Mapper {
    /// The keyframes to be estimated together, where one has been added since the last time: to be given back with
    /// [`Mapper::end_adjustment`] after [`Window::optimise`], which may take its time.
    pub fn begin_adjustment(&mut self) -> Option<Box<Window>> {
        let (mut window, is_new) = self.take_window()?;
        if !is_new {
            self.window = Some(window);
            return None;
        }
        window.take_frames(&mut self.tracked, &mut self.spare_pixels);
        Some(window)
    }

    /// The window with what is new in the map, and whether anything is. `None` where it is away, and before there is
    /// anything to be estimated.
    fn take_window(&mut self) -> Option<(Box<Window>, bool)> {
        let active = self.keyframe()?.keyframe_id;
        if self.depth.is_unit_open {
            return None;
        }
        let mut window = self.window.take()?;
        let is_new = window.take_in(&self.map, active);
        Some((window, is_new))
    }

    /// Takes the keyframes back and moves the map to where they are now.
    pub fn end_adjustment(&mut self, mut window: Box<Window>) -> StepOutcome {
        let finished = self.finish_keyframe();
        let mut outcome = StepOutcome::default();
        if self.depth.unpublished > 0 {
            self.depth.refine(&self.params);
            self.publish_depth();
            outcome.keyframe_changed = true;
        }
        let correction = window.correction(&self.map);
        if !correction.keyframes.is_empty() {
            // Its numbers are checked: one that is broken leaves the map as it is.
            outcome = self.apply(&correction).unwrap_or(outcome);
        }
        for placed in window.take_placed() {
            self.map.place_frame(&placed);
        }
        self.window = Some(window);
        outcome.keyframe_changed |= finished.keyframe_changed;
        outcome
    }

    /// As [`Mapper::begin_adjustment`], where no more frames come: of all keyframes, new or not, and of the frames that
    /// still wait.
    pub fn begin_last_adjustment(&mut self) -> Option<Box<Window>> {
        let (mut window, _) = self.take_window()?;
        window.take_frames(&mut self.tracked, &mut self.spare_pixels);
        window.conclude();
        Some(window)
    }

    /// Keeps the points that the joint estimate has in the map: to be called before it is written.
    pub fn keep_confirmed(&mut self) {
        if let Some(window) = &self.window {
            self.map.confirmed = window.confirmed_points(&self.map);
        }
    }

    /// Keeps a tracked frame until it is aligned again.
    pub(super) fn keep_frame(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) {
        let most = self.params.window.max_waiting_frames;
        if self.params.window.num_free == 0 || most == 0 {
            return;
        }
        if self.tracked.len() >= most {
            self.spare_pixels.push(self.tracked.remove(0).pixels);
        }
        let mut pixels = self.spare_pixels.pop().unwrap_or_default();
        pixels.clear();
        pixels.extend_from_slice(frame.pixels);
        self.tracked.push(TrackedFrame {
            sequence: frame.sequence,
            keyframe_id: pose.keyframe_id,
            keyframe_from_camera: pose.keyframe_from_camera,
            pixels,
        });
    }

    /// Takes the keyframes back and leaves the map as it is: it has changed meanwhile, so that the estimate is one of
    /// another map.
    pub fn drop_adjustment(&mut self, mut window: Box<Window>) {
        // They keep the poses that the tracker gave them.
        drop(window.take_placed());
        self.window = Some(window);
    }
}
