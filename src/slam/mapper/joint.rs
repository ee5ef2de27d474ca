//! When keyframes are estimated jointly, and how the results enter the map.

use std::sync::Arc;

use crate::slam::alignment::reference::num_levels;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::{MIN_CONTRAST, SumPyramid};
use crate::slam::keyframe::Keyframe;
use crate::slam::map::{RealignedFrame, RefinedDepth};
use crate::slam::mapper::consistency::Contradiction;
use crate::slam::mapper::phase::Phase;
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::pose::{NO_KEYFRAME, PoseEstimate};
use crate::slam::window::Window;
use crate::slam::window::frames::TrackedFrame;
use crate::slam::window::marginals::Marginal;

impl Mapper {
    /// Takes out the window for the next estimate if a keyframe was added or the map is in doubt; or else, while
    /// mapping, for a loop search, a piece of a pass or frames to align again; or else, with `may_refine`, for the
    /// depth of a settled keyframe. Run [`Window::optimise`], which may be slow, then [`Mapper::end_adjustment`].
    pub fn begin_adjustment(&mut self, may_refine: bool) -> Option<Box<Window>> {
        let (mut window, is_new) = self.take_window()?;
        self.is_estimated = true;
        let is_mapping = matches!(self.phase, Phase::Mapping);
        let active = self.keyframe().map(|keyframe| keyframe.keyframe_id);
        let is_doubted = self.doubt.begin_estimate();
        window.reconsiders |= is_doubted;
        let is_begun = match active {
            _ if is_new || is_doubted => {
                window.take_frames(&mut self.tracked);
                true
            }
            Some(active) if is_mapping => {
                window.begin_search(&self.map, false)
                    || window.begin_piece()
                    || window.begin_frames()
                    || (may_refine && window.begin_refinement(&self.map, active))
            }
            _ => false,
        };
        if !is_begun {
            self.window = Some(window);
            return None;
        }
        Some(window)
    }

    /// Takes the window out, updated from the map, and tells whether the map had anything new for it. `None` while it
    /// is out, and before there is anything to estimate.
    pub(super) fn take_window(&mut self) -> Option<(Box<Window>, bool)> {
        let active = self.keyframe()?.keyframe_id;
        if self.depth.is_unit_open {
            return None;
        }
        let mut window = self.window.take()?;
        window.take_mature(&mut self.depth.maturing.left);
        let is_new = window.update_from_map(&self.map, active);
        window.loops.offer(&self.map.keyframes);
        Some((window, is_new))
    }

    /// Takes the window back and applies its result to the map.
    pub fn end_adjustment(&mut self, mut window: Box<Window>) -> StepOutcome {
        if let Some(refined) = window.take_refined() {
            let graph_changed = self.take_refined(refined, &mut window);
            self.return_window(window);
            return StepOutcome { graph_changed, ..Default::default() };
        }
        if let Some(closure) = window.loops.take_closure() {
            let outcome = self.close_loop(&closure, &mut window);
            self.return_window(window);
            return outcome;
        }
        if let Some(placed) = window.take_planned_frames() {
            placed.iter().for_each(|frame| self.map.store_frame_pose(frame));
            self.return_window(window);
            return StepOutcome { graph_changed: !placed.is_empty(), ..Default::default() };
        }
        let finished = self.finish_keyframe();
        let mut outcome = StepOutcome::default();
        if self.depth.unpublished > 0 {
            self.depth.refine(&self.params);
            self.publish_depth();
            outcome.keyframe_changed = true;
        }
        if let Some(rejected) = self.reject_refuted(&mut window) {
            self.return_window(window);
            return rejected;
        }
        let params = &self.params.modes;
        let covariances_of = |of: &Marginal| {
            (self.modes.of_estimate(of, params), self.modes.pose_covariance_of_estimate(of, params))
        };
        let correction = window.correction(&self.map, covariances_of);
        if !correction.keyframes.is_empty() {
            window.request_pass_on_jump(&self.map, &correction);
            // The values are checked: invalid ones leave the map unchanged.
            match self.apply(&correction) {
                Ok(applied) => {
                    outcome = applied;
                    window.record_covariances(&correction);
                }
                Err(_) => window.discard_refinement(),
            }
        }
        for placed in window.take_realigned() {
            self.map.store_frame_pose(&placed);
        }
        self.return_window(window);
        outcome.keyframe_changed |= finished.keyframe_changed | self.settle_doubt();
        outcome
    }

    /// Rejects the epoch being mapped where the estimate has refuted its start.
    fn reject_refuted(&mut self, window: &mut Window) -> Option<StepOutcome> {
        let refuted = window.refuted_epoch.take()?;
        let is_mapped = self.keyframe()?.epoch == refuted;
        if !(is_mapped && matches!(self.phase, Phase::Mapping | Phase::Lost(_))) {
            return None;
        }
        drop(window.take_realigned());
        window.discard_refinement();
        self.reject(Contradiction::WrongStart);
        Some(StepOutcome { keyframe_changed: true, graph_changed: true, ..Default::default() })
    }

    /// Like [`Mapper::begin_adjustment`], after the last frame: for an estimate of all keyframes, new or not, and of
    /// the frames that still wait.
    pub fn begin_last_adjustment(&mut self) -> Option<Box<Window>> {
        let (mut window, _) = self.take_window()?;
        window.take_frames(&mut self.tracked);
        window.is_last = true;
        Some(window)
    }

    /// Refines, after the last estimate, the depth of the newest unrefined keyframe from the keyframes around it; false
    /// where none is left.
    pub fn refine_depth(&mut self) -> bool {
        let Some(window) = &mut self.window else { return false };
        let Some(keyframe_id) = window.next_unrefined() else { return false };
        let keyframe = self.map.get(keyframe_id).filter(|of| of.has_depth() && !of.is_refined);
        let refined = keyframe.and_then(|keyframe| window.refine_keyframe(keyframe));
        if let Some(refined) = refined {
            self.revision += 1;
            self.map.refine(refined, self.revision);
        }
        true
    }

    /// Gives a keyframe the depth that was refined during mapping; false where its depth has changed since, is being
    /// observed, or has been forgotten.
    fn take_refined(&mut self, refined: RefinedDepth, window: &mut Window) -> bool {
        let keyframe_id = refined.keyframe_id;
        let is_active = self.keyframe().is_some_and(|active| active.keyframe_id == keyframe_id);
        let is_same = |of: &&Keyframe| of.has_depth() && of.revision == refined.of_revision;
        if is_active || self.map.get(keyframe_id).filter(is_same).is_none() {
            window.requeue_refinement(keyframe_id);
            return false;
        }
        self.revision += 1;
        self.map.refine(refined, self.revision);
        self.queue_keyframe_to_save(keyframe_id);
        true
    }

    /// Stores the points of the joint estimate in the map; call it before the map is written.
    pub fn store_confirmed_points(&mut self) {
        if let Some(window) = &self.window {
            self.map.confirmed = window.confirmed_points(&self.map);
        }
    }

    /// Keeps a tracked frame until it is aligned again.
    pub(super) fn queue_frame(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) {
        let most = self.params.window.max_waiting_frames;
        if self.realigns_frames() {
            let (copy, at) = (self.copies.of(frame), &pose.keyframe_from_camera);
            push_bounded(&mut self.tracked, most, (frame.sequence, copy), (pose.keyframe_id, at));
        }
    }

    /// Keeps a frame from before its map starts. One without contrast would align anywhere, as a gain of nearly 0
    /// explains it, and cannot lead to the frames before it: these are dropped.
    pub(super) fn keep_early_frame(&mut self, frame: &FrameView<'_>) {
        /// Two seconds at 30 Hz, one byte a pixel each.
        const MAX_QUEUED_FRAMES: usize = 60;
        if !self.realigns_frames() {
            return;
        }
        let levels = num_levels(frame.width, frame.height);
        let mut pyramid = SumPyramid::with_size(frame.width, frame.height, levels, levels - 1);
        pyramid.fill(frame.pixels);
        if pyramid.contrast() < MIN_CONTRAST {
            self.early.clear();
            return;
        }
        let (copy, at) = (self.copies.of(frame), &SE3::identity());
        push_bounded(&mut self.early, MAX_QUEUED_FRAMES, (frame.sequence, copy), (NO_KEYFRAME, at));
    }

    fn realigns_frames(&self) -> bool {
        self.params.window.num_free > 0 && self.params.window.max_waiting_frames > 0
    }

    /// Adopts the early frames for a map that has started with two frames, its first keyframes, the second at
    /// `first_from_second`. Frames before the second will be aligned to the map, from initial poses by constant motion.
    pub(super) fn adopt_early_frames(&mut self, first_from_second: &SE3, is_second_repeat: bool) {
        let [.., first, second] = &self.map.keyframes[..] else { return };
        let motion = first_from_second.log();
        let begin = first.sequence;
        let (steps, num_repeats) = steps_of(&self.early);
        let num_repeats = num_repeats + f64::from(is_second_repeat);
        // Of a first image that was repeated for long only the last repeats may be left.
        let shows_first = |frame: &TrackedFrame| {
            frame.sequence == begin || frame.repeats.contains(&begin) || frame.pixels == first.image
        };
        let begin_step =
            self.early.iter().position(shows_first).map_or(begin as f64, |at| steps[at]);
        let interval = (second.sequence as f64 - num_repeats - begin_step).max(1.0);
        for (mut frame, step) in self.early.drain(..).zip(steps) {
            frame.repeats.retain(|&sequence| sequence != begin);
            if frame.sequence == begin {
                if frame.repeats.is_empty() {
                    continue;
                }
                frame.sequence = frame.repeats.remove(0);
            }
            frame.keyframe_id = first.keyframe_id;
            frame.keyframe_from_camera = SE3::exp(&(motion * ((step - begin_step) / interval)));
            frame.is_guess = true;
            self.tracked.push(frame);
        }
        for keyframe in [first, second].map(|keyframe| (keyframe.sequence, keyframe.keyframe_id)) {
            let (sequence, keyframe_id) = keyframe;
            let keyframe_from_camera = SE3::identity();
            self.map.store_frame_pose(&RealignedFrame {
                sequence,
                keyframe_id,
                keyframe_from_camera,
            });
        }
    }

    /// Takes the window back without applying its result: the map has changed since, and the estimate belongs to
    /// another map.
    pub fn drop_adjustment(&mut self, mut window: Box<Window>) {
        // The frames keep the poses that the tracker gave them.
        drop(window.take_planned_frames());
        drop(window.take_realigned());
        window.discard_refinement();
        window.repeat_piece();
        window.loops.repeat_closure();
        self.doubt.drop_estimate();
        self.return_window(window);
    }
}

/// Where along the camera's motion each image lies, in frames, and how many frames repeat one: a repeat is no step of the
/// motion.
fn steps_of(frames: &[TrackedFrame]) -> (Vec<f64>, f64) {
    let mut num_repeats = 0;
    let mut steps = Vec::with_capacity(frames.len());
    for frame in frames {
        steps.push(frame.sequence.saturating_sub(num_repeats) as f64);
        // Of many repeats only the last are listed.
        let last = frame.repeats.last().unwrap_or(&frame.sequence);
        num_repeats = num_repeats.saturating_add(last.saturating_sub(frame.sequence));
    }
    (steps, num_repeats as f64)
}

/// Appends the copy of a frame to a list of at most `most`; the oldest is dropped. A repeat is added to its image, of
/// whose repeats the oldest is dropped.
fn push_bounded(
    frames: &mut Vec<TrackedFrame>,
    most: usize,
    (sequence, pixels): (u64, Arc<[u8]>),
    (keyframe_id, at): (u64, &SE3),
) {
    let last = frames.last_mut().filter(|last| Arc::ptr_eq(&last.pixels, &pixels));
    if let Some(last) = last.filter(|last| last.keyframe_id == keyframe_id) {
        if last.repeats.len() >= most {
            last.repeats.remove(0);
        }
        last.repeats.push(sequence);
        return;
    }
    if frames.len() >= most {
        frames.remove(0);
    }
    frames.push(TrackedFrame {
        sequence,
        repeats: Vec::new(),
        keyframe_id,
        keyframe_from_camera: *at,
        is_guess: false,
        pixels,
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::keyframe_pose_covariance::{KeyframePoseCovariance, KeyframePoseMatrix};
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::phase::Active;
    use crate::slam::test_scene::{CAMERA, Scene};

    #[test]
    fn an_estimate_gives_places_in_the_map_and_the_search_those_relative_to_others() {
        let sideways = |x: f64| SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
        let scene = Scene::new(3);
        let estimated = |of_first: f64| {
            let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
            let places = (0..).zip([0.0, 0.15, 0.3, 0.4]);
            mapper.map.keyframes =
                places.map(|(id, x)| scene.keyframe(id, sideways(x), 1.0)).collect();
            let of_first = KeyframePoseMatrix::identity() * of_first;
            mapper.map.keyframes[0].place_covariance = KeyframePoseCovariance::bounded(&of_first);
            mapper.active = Some(Active::new(3));
            let mut window = mapper.begin_adjustment(false).unwrap();
            window.optimise().unwrap();
            mapper.end_adjustment(window);
            mapper.map
        };
        let [exact, uncertain] = [0.0, 0.01].map(estimated);
        let relative = &exact.loops.relative_covariances;
        assert!(relative.keys().eq(&[1, 2, 3]), "{relative:?}");
        assert_eq!(relative, &uncertain.loops.relative_covariances);
        for (one, other) in exact.keyframes.iter().zip(&uncertain.keyframes).skip(1) {
            let [one_place, other] = [one, other].map(|of| of.place_covariance.matrix());
            let by_first = other - one_place;
            for at in [(1, 1), (4, 4), (6, 6)] {
                assert!((by_first[at] - 0.01).abs() < 1e-6, "{by_first}");
            }
            // The first keyframe is at the origin and its unit 1.
            let relative = relative[&one.keyframe_id];
            assert!(one_place[(6, 6)] > 0.0 && relative[(6, 6)] == one_place[(6, 6)]);
        }
    }

    /// Early frames of at most `most` images: each a sequence and an image.
    fn early(sent: &[(u64, usize)], most: usize) -> Vec<TrackedFrame> {
        let images: [Arc<[u8]>; 3] = [1, 2, 3].map(|grey| vec![grey; 4].into());
        let mut frames = Vec::new();
        for &(sequence, image) in sent {
            let copy = Arc::clone(&images[image]);
            push_bounded(&mut frames, most, (sequence, copy), (NO_KEYFRAME, &SE3::identity()));
        }
        frames
    }

    #[test]
    fn repeated_images_are_kept_once_and_are_no_steps_of_the_motion() {
        // The fourteenth frame was dropped.
        let frames = early(&[(10, 0), (11, 0), (12, 1), (13, 1), (15, 2), (16, 2)], 3);
        let listed = frames.iter().map(|frame| (frame.sequence, &frame.repeats[..]));
        assert!(listed.eq([(10, &[11][..]), (12, &[13]), (15, &[16])]));
        assert_eq!(steps_of(&frames), (vec![10.0, 11.0, 13.0], 3.0));
    }

    #[test]
    fn of_many_repeats_the_last_are_listed_and_none_is_a_step() {
        let sent: Vec<_> = (10..30).map(|sequence| (sequence, 0)).chain([(30, 1)]).collect();
        let frames = early(&sent, 4);
        assert_eq!(frames[0].repeats, [26, 27, 28, 29]);
        assert_eq!(steps_of(&frames), (vec![10.0, 11.0], 19.0));
    }

    #[test]
    fn frames_of_another_keyframe_are_kept_apart_though_they_repeat_an_image() {
        let image: Arc<[u8]> = vec![1; 4].into();
        let mut frames = Vec::new();
        for (sequence, keyframe) in [(1, 0), (2, 0), (3, 1), (4, 1)] {
            let copy = Arc::clone(&image);
            push_bounded(&mut frames, 9, (sequence, copy), (keyframe, &SE3::identity()));
        }
        let listed =
            frames.iter().map(|frame| (frame.keyframe_id, frame.sequence, &frame.repeats[..]));
        assert!(listed.eq([(0, 1, &[2][..]), (1, 3, &[4])]));
    }
}
