//! Alignment of one frame to the points of the keyframes around it.

use std::sync::Arc;

use crate::slam::geometry::se3::SE3;
use crate::slam::map::RealignedFrame;
use crate::slam::window::frames::TrackedFrame;
use crate::slam::window::{ALIGNMENT_LEVELS, Window};

/// Levels that a frame is aligned on first: most are within a pixel or two. Where their keyframe's first depth was
/// wrong they may be ten off.
const FINE_LEVELS: [usize; 2] = [1, 0];
/// Share of the comparisons that agree with most frames that are placed correctly.
const SURE_INLIER_RATIO: f64 = 0.8;
/// Most iterations of a level.
const MAX_ITERATIONS: u32 = 10;
/// Keyframes before and after its own whose points a frame is aligned to.
const REACH: usize = 3;
/// Comparisons that must agree with a frame's new pose.
const MIN_INLIERS: usize = 60;
/// Share of the comparisons that must agree.
const MIN_INLIER_RATIO: f64 = 0.5;
/// The same for a pose from a guess. With frames placed wrongly, up to 35° off, 0.50 to 0.61 of the comparisons agreed;
/// with those placed correctly at least 0.83, on five recordings and in nine rooms with noise and blur.
const MIN_GUESS_INLIER_RATIO: f64 = 0.7;

impl Window {
    /// Aligns frames from before their map started, the newest first, each from its guess with the correction of the
    /// frame after it; drops those before one that does not fit.
    pub(super) fn retrace(
        &mut self,
        waiting: &mut Vec<TrackedFrame>,
        end: usize,
        left: &mut usize,
    ) {
        // The last frame's keyframe, and the correction of its guess.
        let mut found_off: Option<(u64, SE3)> = None;
        while *left > 0 {
            let is_ready = |frame: &TrackedFrame| {
                frame.is_guess && self.index_of(frame.keyframe_id).is_none_or(|index| index < end)
            };
            let Some(place) = waiting.iter().rposition(is_ready) else { return };
            let mut frame = waiting.remove(place);
            *left -= 1;
            let (keyframe_id, guess) = (frame.keyframe_id, frame.keyframe_from_camera);
            if let Some((_, off)) = found_off.filter(|(of, _)| *of == keyframe_id) {
                frame.keyframe_from_camera = off * guess;
            }
            let index = self.index_of(keyframe_id);
            let placed = index.and_then(|index| self.realign_frame(index, &frame));
            let (Some(placed), Some(index)) = (placed, index) else {
                waiting.retain(|other| !(other.is_guess && other.keyframe_id == keyframe_id));
                continue;
            };
            let mut found = placed.keyframe_from_camera;
            found.translation /= self.keyframes[index].unit;
            found_off = Some((keyframe_id, found * guess.inverse()));
            self.frames.place(&frame, Some(placed));
        }
        // The remaining ones start with that correction.
        let Some((keyframe_id, off)) = found_off else { return };
        for other in waiting.iter_mut().filter(|of| of.is_guess && of.keyframe_id == keyframe_id) {
            other.keyframe_from_camera = off * other.keyframe_from_camera;
        }
    }

    pub(super) fn realign_frame(
        &mut self,
        index: usize,
        frame: &TrackedFrame,
    ) -> Option<RealignedFrame> {
        let keyframe = &self.keyframes[index];
        let (epoch, unit) = (keyframe.epoch, keyframe.unit);
        let host_from_map = keyframe.camera_from_map;
        let mut host_from_camera = frame.keyframe_from_camera;
        host_from_camera.translation *= unit;
        let is_host = |&k: &usize| self.keyframes[k].is_host && self.keyframes[k].epoch == epoch;
        let last = (index + REACH).min(self.keyframes.len() - 1);
        let mut members: Vec<usize> =
            (index.saturating_sub(REACH)..=last).filter(is_host).collect();
        if members.is_empty() {
            return None;
        }
        members.push(self.keyframes.len());
        let camera_from_map = host_from_camera.inverse() * host_from_map;
        self.push_camera(epoch, Arc::clone(&frame.pixels), camera_from_map, unit)?;
        let camera_from_map = self.align_frame(&members, frame.is_guess);
        self.keyframes.pop();
        camera_from_map.map(|camera_from_map| RealignedFrame {
            sequence: frame.sequence,
            keyframe_id: frame.keyframe_id,
            keyframe_from_camera: host_from_map * camera_from_map.inverse(),
        })
    }

    /// Aligns the last of the members, which is a frame: from the coarse levels if its pose is a guess, otherwise on
    /// the fine ones, and from the coarse ones too where fewer comparisons agree than with most frames. Returns the
    /// pose that more agree with; `None` where these are too few.
    fn align_frame(&mut self, members: &[usize], is_guess: bool) -> Option<SE3> {
        let begin = self.keyframes.last()?.camera_from_map;
        let mut best: Option<(usize, usize, SE3)> = None;
        let begun_on = [&FINE_LEVELS[..], &ALIGNMENT_LEVELS];
        for levels in &begun_on[usize::from(is_guess)..] {
            self.keyframes.last_mut()?.camera_from_map = begin;
            if !self.align_last(members, levels, MAX_ITERATIONS) {
                continue;
            }
            let (inliers, compared) = (self.solver.system.inliers, self.solver.system.compared);
            if best.is_none_or(|(most, ..)| inliers > most) {
                best = Some((inliers, compared, self.keyframes.last()?.camera_from_map));
            }
            if inliers as f64 >= SURE_INLIER_RATIO * compared as f64 {
                break;
            }
        }
        let least = if is_guess { MIN_GUESS_INLIER_RATIO } else { MIN_INLIER_RATIO };
        best.filter(|&(inliers, compared, _)| {
            inliers >= MIN_INLIERS && inliers as f64 >= least * compared as f64
        })
        .map(|(.., camera_from_map)| camera_from_map)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::test_scene::CAMERA;
    use crate::slam::window::frames::tests::frame;
    use crate::slam::window::params::WindowParams;
    use crate::slam::window::tests::room;

    #[test]
    fn a_frame_that_is_ten_pixels_off_is_aligned() {
        let mut room = room(|_, _| (1.0, 0.0)).keyframes;
        let seen = room.remove(2);
        let truth = room[1].camera_from_map * seen.camera_from_map.inverse();
        let mut window = Window::new(CAMERA, WindowParams::default());
        window.keyframes = room;
        let off = SE3::exp(&Vector6::new(0.02, 0.0, 0.01, 0.02, -0.03, 0.0));
        let frame = TrackedFrame {
            keyframe_from_camera: truth * off,
            pixels: seen.images[0].pixels().into(),
            ..frame(1)
        };
        let placed = window.realign_frame(1, &frame).unwrap();
        let error = (placed.keyframe_from_camera * truth.inverse()).log();
        assert!(error.norm() < 0.003, "{error}");
        assert_eq!(window.keyframes.len(), 3);
    }

    #[test]
    fn a_guess_of_another_view_is_dropped_with_the_frames_before_it() {
        let mut room = room(|_, _| (1.0, 0.0)).keyframes;
        let seen = room.remove(2);
        let keyframe_from_camera = room[1].camera_from_map * seen.camera_from_map.inverse();
        let placed_of = |views: &[&[u8]]| {
            let mut window = Window::new(CAMERA, WindowParams::default());
            window.keyframes = room.clone();
            let guess = |(&pixels, sequence): (&&[u8], u64)| TrackedFrame {
                sequence,
                keyframe_from_camera,
                is_guess: true,
                pixels: pixels.into(),
                ..frame(1)
            };
            window.take_frames(&mut views.iter().zip(0..).map(guess).collect());
            window.realign_rest();
            window.take_realigned().iter().map(|placed| placed.sequence).collect::<Vec<_>>()
        };
        let view = seen.images[0].pixels();
        // At low contrast more than half of the comparisons agree with it, which would be enough for a tracked frame.
        let another = view.iter().rev().map(|&grey| (0.3 * f64::from(grey) + 90.0) as u8);
        let another: Vec<u8> = another.collect();
        let mut window = Window::new(CAMERA, WindowParams::default());
        window.keyframes = room.clone();
        let pixels = another.clone().into();
        let tracked = TrackedFrame { keyframe_from_camera, pixels, ..frame(1) };
        assert!(window.realign_frame(1, &tracked).is_some());
        assert_eq!(placed_of(&[view, view, view]), [2, 1, 0]);
        assert_eq!(placed_of(&[view, &another, view]), [2]);
    }
}
