//! Frames between keyframes, aligned again to the points that are known better by then.
//!
//! The tracker aligned a frame to depth that was still being estimated; its errors, tilt above all, are in the frame's
//! pose relative to the keyframe and stay there when the keyframe moves.

use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::window::Window;
use crate::slam::window::keyframe::WindowKeyframe;

/// Frames aligned with one adjustment: twice as many as come between two keyframes, so that those of an epoch's first
/// keyframes are made up for without delaying it.
const MOST_AT_ONCE: usize = 30;
/// Levels that a frame is aligned on: it is within a pixel or two already.
const FRAME_LEVELS: [usize; 2] = [1, 0];
/// Most iterations of a level.
const MAX_ITERATIONS: u32 = 10;
/// Keyframes before and after its own whose points a frame is aligned to.
const REACH: usize = 3;
/// Comparisons that must agree with a frame's new pose.
const FEWEST_INLIERS: usize = 60;
/// Share of the comparisons that must.
const LEAST_INLIER_RATIO: f64 = 0.5;

/// A frame that was tracked, to be aligned again.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackedFrame {
    /// Its sequence.
    pub sequence: u64,
    /// The keyframe that it was tracked on.
    pub keyframe_id: u64,
    /// Where it is, in the keyframe's unit.
    pub keyframe_from_camera: SE3,
    /// Grey values.
    pub pixels: Vec<u8>,
}

/// Where a frame is after it was aligned again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedFrame {
    /// Its sequence.
    pub sequence: u64,
    /// Its keyframe.
    pub keyframe_id: u64,
    /// Where it is, in the unit of the map.
    pub keyframe_from_camera: SE3,
}

/// Frames that wait and frames that are done.
#[derive(Debug, Clone, Default)]
pub(super) struct WindowFrames {
    waiting: Vec<TrackedFrame>,
    placed: Vec<PlacedFrame>,
    /// Memory of images that are not needed any more.
    spare: Vec<Vec<u8>>,
}

impl Window {
    /// Takes frames that were tracked since the last time, in their order, and leaves memory for others.
    pub fn take_frames(&mut self, frames: &mut Vec<TrackedFrame>, spare: &mut Vec<Vec<u8>>) {
        spare.append(&mut self.frames.spare);
        let waiting = &mut self.frames.waiting;
        waiting.append(frames);
        let excess = waiting.len().saturating_sub(self.params.max_waiting_frames);
        spare.extend(waiting.drain(..excess).map(|frame| frame.pixels));
    }

    /// Frames that have been aligned again since somebody asked.
    pub fn take_placed(&mut self) -> Vec<PlacedFrame> {
        std::mem::take(&mut self.frames.placed)
    }

    /// Aligns the frames that have waited long enough: until enough keyframes have come, and an epoch's first ones have
    /// settled.
    pub(super) fn place_frames(&mut self, newest: usize, is_first: bool) {
        if is_first {
            return;
        }
        let ready = (newest + 1).saturating_sub(self.params.frame_lag);
        self.place_frames_before(ready, MOST_AT_ONCE);
    }

    /// Aligns all frames that still wait.
    pub fn place_rest(&mut self) {
        self.place_frames_before(self.keyframes.len(), usize::MAX);
    }

    fn place_frames_before(&mut self, end: usize, most: usize) {
        let mut waiting = std::mem::take(&mut self.frames.waiting);
        let mut left = most;
        waiting.retain_mut(|frame| {
            let of = |keyframe: &WindowKeyframe| keyframe.keyframe_id == frame.keyframe_id;
            let index = self.keyframes.iter().position(of);
            if left == 0 || index.is_some_and(|index| index >= end) {
                return true;
            }
            left -= 1;
            let placed = index.and_then(|index| self.place_frame(index, frame));
            self.frames.placed.extend(placed);
            self.frames.spare.push(std::mem::take(&mut frame.pixels));
            false
        });
        self.frames.waiting = waiting;
    }

    fn place_frame(&mut self, index: usize, frame: &mut TrackedFrame) -> Option<PlacedFrame> {
        let keyframe = &self.keyframes[index];
        let (epoch, host_from_map) = (keyframe.epoch, keyframe.camera_from_map);
        let mut host_from_camera = frame.keyframe_from_camera;
        host_from_camera.translation *= keyframe.unit;
        let is_host = |&k: &usize| self.keyframes[k].is_host && self.keyframes[k].epoch == epoch;
        let last = (index + REACH).min(self.keyframes.len() - 1);
        let mut members: Vec<usize> =
            (index.saturating_sub(REACH)..=last).filter(is_host).collect();
        if members.is_empty() {
            return None;
        }
        let (width, height) = (self.camera.width, self.camera.height);
        let pixels = std::mem::take(&mut frame.pixels);
        let image = Image::try_from_pixels(width, height, pixels)?;
        members.push(self.keyframes.len());
        self.keyframes.push(WindowKeyframe {
            keyframe_id: u64::MAX,
            epoch,
            images: vec![image],
            camera_from_map: host_from_camera.inverse() * host_from_map,
            unit: 1.0,
            points: Vec::new(),
            is_host: false,
        });
        let is_aligned = self.align_last(&members, &FRAME_LEVELS, MAX_ITERATIONS);
        let mut placed = self.keyframes.pop()?;
        frame.pixels = placed.images.swap_remove(0).into_pixels();
        let system = &self.solver.system;
        let agrees = system.inliers >= FEWEST_INLIERS
            && system.inliers as f64 >= LEAST_INLIER_RATIO * system.compared as f64;
        (is_aligned && agrees).then(|| PlacedFrame {
            sequence: frame.sequence,
            keyframe_id: frame.keyframe_id,
            keyframe_from_camera: host_from_map * placed.camera_from_map.inverse(),
        })
    }
}
