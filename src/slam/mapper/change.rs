//! The change to a new keyframe: propagate the depth, regularise, rescale, publish; then the work that can wait until
//! after that: the final depth of the previous keyframe, and depth for new pixels from past frames.

use std::sync::Arc;

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::gaussian::{ObservedPixels, Observer, observe};
use crate::slam::depth::matching::MatchingParams;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::keyframe_pose_covariance::UncertainPose;
use crate::slam::mapper::consistency::judge_change;
use crate::slam::mapper::depth_buffers::write_depth;
use crate::slam::mapper::finder::MAX_INDEXED;
use crate::slam::mapper::modes::in_unit;
use crate::slam::mapper::start::take_sensor_depth;
use crate::slam::mapper::{Mapper, StepInput, StepOutcome};
use crate::slam::pose::{Brightness, PoseEstimate, full_covariance};

/// Work left on a new keyframe after it is published.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unfinished {
    /// Index in the map of the previous keyframe, whose depth map is the spare one.
    before: usize,
    /// Unit of that depth, in its keyframe's unit.
    unit: f64,
    /// Number of its hypotheses.
    known: usize,
    /// Its mean inverse depth divided by that of the new keyframe when the depth was propagated.
    depth_ratio: f64,
    /// Whether the new pixels have no depth yet.
    has_new_pixels: bool,
    /// Misplacement of epipolar lines, pixels: past frames' poses are as certain as that of the new keyframe.
    line_noise_px: f32,
}

impl Mapper {
    /// Makes a frame, tracked on the active keyframe, the next keyframe: propagates the depth, regularises, rescales.
    pub(super) fn change_keyframe(&mut self, input: &StepInput<'_>) {
        let StepInput { frame, pose, sensor_depth } = *input;
        let (Some(active), Some(before)) = (self.active, self.keyframe()) else { return };
        let (epoch, map_from_before) = (before.epoch, before.map_from_keyframe);
        let place_covariance = before
            .uncertain_pose()
            .of_next(&pose.keyframe_from_camera, &full_covariance(&pose.covariance));
        let before_id = before.keyframe_id;
        self.depth.keep_mature_points(before_id, &self.params);
        if self.depth.unpublished > 0 {
            self.depth.refine(&self.params);
        }
        let (unit, is_unit_open) = (self.depth.unit, self.depth.is_unit_open);
        let frame_from_before = in_unit(&pose.keyframe_from_camera, unit);
        self.modes.propagate_modes(&frame_from_before, &self.intrinsics, &self.params.modes);
        self.depth.swap();
        self.depth.restart(frame.pixels, &self.params);
        let (brightness, propagation) = (pose.brightness, &self.params.propagation);
        self.depth.propagate_spare(&frame_from_before, brightness, &self.intrinsics, propagation);
        self.past.rebase(brightness);
        let map_from_frame = map_from_before.transform_pose(&pose.keyframe_from_camera);
        let carried_unit = map_from_before.scale * unit;
        if let Some(sensor) = sensor_depth {
            take_sensor_depth(&mut self.depth.active, sensor, carried_unit);
        }
        self.depth.refine(&self.params);
        let factor = self.depth.normalise();
        // Without any depth there is no mean to rescale by.
        self.depth.is_unit_open = is_unit_open && self.depth.active.num_hypotheses() == 0;
        self.unfinished = Some(Unfinished {
            before: active.index,
            unit,
            known: self.depth.spare.num_hypotheses(),
            // The mean of a first keyframe without depth is not 1.
            depth_ratio: self.depth.spare.mean_inverse_depth().map_or(1.0, |mean| mean * factor),
            has_new_pixels: sensor_depth.is_none(),
            line_noise_px: self.matching_at(pose).line_noise_px,
        });
        let place = UncertainPose {
            map_from_keyframe: Sim3::new(map_from_frame, carried_unit * factor),
            covariance: place_covariance,
        };
        self.add_keyframe(frame, &place, epoch);
    }

    /// Whether a keyframe made of `frame` would keep almost none of the depth because the camera has turned away from
    /// it. Frames are then tracked on the active keyframe for as long as they see it.
    pub(super) fn would_lose_depth(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) -> bool {
        /// Points needed to continue tracking on a keyframe: as many as a start needs.
        const MIN_KEPT: usize = 200;
        /// With this many of the keyframe's points in view, no closer check is needed.
        const ENOUGH_IN_VIEW: f64 = 4000.0;
        let is_exact = pose.alignment_covariance.iter().all(|entry| *entry == 0.0);
        let known = self.depth.active.num_hypotheses();
        let in_view = pose.quality.in_view_ratio * known as f64;
        if is_exact || known < MIN_KEPT || in_view >= ENOUGH_IN_VIEW {
            return false;
        }
        let frame_from_before = in_unit(&pose.keyframe_from_camera, self.depth.unit);
        let (min_gradient, most) = (self.params.min_gradient, self.params.max_candidates);
        self.depth.swap();
        self.depth.active.restart_without_structure(frame.pixels, min_gradient, most);
        let propagation = &self.params.propagation;
        self.depth.propagate_spare(
            &frame_from_before,
            pose.brightness,
            &self.intrinsics,
            propagation,
        );
        let carried = self.depth.active.num_hypotheses();
        self.depth.swap();
        carried < MIN_KEPT.max((self.params.consistency.min_kept_ratio * known as f64) as usize)
    }

    /// Finishes a new keyframe after it is published: writes the final depth of the previous one into the map, gives
    /// new pixels depth from past frames, and judges the change. Call it once the step's outcome is published;
    /// otherwise the next step does it first.
    pub fn finish_keyframe(&mut self) -> StepOutcome {
        let Some(unfinished) = self.unfinished.take() else { return StepOutcome::default() };
        self.revision += 1;
        let before = self.map.keyframes.get_mut(unfinished.before);
        // A keyframe whose depth was forgotten stays without.
        if let Some(before) = before.filter(|before| !before.image.is_empty()) {
            before.revision = self.revision;
            write_depth(&self.depth.spare, unfinished.unit, before);
        }
        let searches = self.params.depth_filter.searches_past();
        let mut keyframe_changed = false;
        if searches && unfinished.has_new_pixels && self.seed_from_past(unfinished.line_noise_px) {
            self.depth.refine(&self.params);
            self.depth.keep_unit_mean();
            self.publish_depth();
            keyframe_changed = true;
        }
        let depth = &self.depth.active;
        let (known, mean) = (depth.num_hypotheses(), depth.mean_inverse_depth());
        let depth_ratio = unfinished.depth_ratio / mean.unwrap_or(1.0);
        let params = &self.params.consistency;
        if let Some(contradiction) = judge_change(unfinished.known, known, depth_ratio, params) {
            keyframe_changed |= self.contradict(contradiction);
        }
        self.thin();
        StepOutcome { keyframe_changed, ..Default::default() }
    }

    /// Gives new pixels of the keyframe depth from earlier frames, shortest baseline first: each narrows the search of
    /// the next. False where no frame was far enough away.
    fn seed_from_past(&mut self, line_noise_px: f32) -> bool {
        /// Each frame's baseline is at least this many times the one before.
        const BASELINE_STEP: f64 = 1.7;
        /// Baselines shorter than this share of the mean depth yield no depth.
        const MIN_BASELINE: f64 = 0.01;
        let Some(keyframe) = self.keyframe() else { return false };
        let map_from_keyframe = keyframe.map_from_keyframe;
        let matching = MatchingParams { line_noise_px, ..self.params.matching.clone() };
        let mut least = MIN_BASELINE;
        let mut used = 0;
        for past in self.past.newest_first() {
            if used >= self.params.num_seed_frames {
                break;
            }
            let tracked_on = (past.keyframe_id, &past.keyframe_from_camera);
            let Some(map_from_camera) = self.map.frame_pose(tracked_on.0, tracked_on.1) else {
                continue;
            };
            let mut keyframe_from_camera =
                map_from_keyframe.inverse_transform_pose(&map_from_camera);
            keyframe_from_camera.translation /= self.depth.unit;
            let baseline = keyframe_from_camera.translation.norm();
            if baseline < least {
                continue;
            }
            self.frame.fill(&past.pixels);
            let observer = Observer {
                image: &self.frame,
                view: TwoView::new(&self.intrinsics, &keyframe_from_camera.inverse()),
                brightness: past.brightness,
                pixels: ObservedPixels::New,
            };
            observe(&mut self.depth.active, &observer, &matching, &self.params.gaussian);
            least = baseline * BASELINE_STEP;
            used += 1;
        }
        used > 0
    }

    /// Adds `frame`, whose depth is the active one, to the map as the active keyframe.
    pub(super) fn add_keyframe(
        &mut self,
        frame: &FrameView<'_>,
        place: &UncertainPose,
        epoch: u32,
    ) {
        let UncertainPose { map_from_keyframe, covariance: place_covariance } = *place;
        let (keyframe_id, image) = (self.next_keyframe_id, self.copies.of(frame));
        self.map.keyframes.push(Keyframe {
            keyframe_id,
            epoch,
            revision: self.revision,
            sequence: frame.sequence,
            capture_nanos: frame.capture_nanos,
            map_state: MapState::Established,
            world_from_keyframe: self.world_from_map * map_from_keyframe,
            map_from_keyframe,
            map_revision: self.map.revision,
            mode_covariance: self.modes.published(&self.params.modes),
            place_covariance,
            is_refined: false,
            intrinsics: self.intrinsics,
            image: Arc::clone(&image),
            points: Vec::new(),
            description: None,
        });
        self.finder.index_new(&mut self.map.keyframes, MAX_INDEXED);
        self.map.forget_depth_beyond(self.params.max_map_bytes());
        self.next_keyframe_id += 1;
        self.past.push(image, keyframe_id, SE3::identity(), Brightness::default());
        self.activate_keyframe(self.map.keyframes.len() - 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::image::buffer::Image;
    use crate::slam::keyframe::DepthPoint;
    use crate::slam::keyframe_pose_covariance::KeyframePoseCovariance;
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::depth_buffers::DepthBuffers;
    use crate::slam::mapper::reuse::ReuseParams;
    use crate::slam::pose::TrackingState;
    use crate::slam::test_scene::{CAMERA, Scene};

    /// The outcome of a step, or of its deferred work, and the keyframes' points after it.
    #[derive(Debug, Clone, PartialEq)]
    struct Taken {
        outcome: StepOutcome,
        points: Vec<Vec<DepthPoint>>,
    }

    /// Renders the scene from a camera: depth, and an image with noise from `seed`.
    fn seen(scene: &Scene, world_from_camera: &SE3, seed: u64) -> (Image<f32>, Vec<u8>) {
        let view = scene.render(&CAMERA, world_from_camera);
        let mut depth = view.inverse_depth.clone();
        depth.pixels_mut().iter_mut().for_each(|d| *d = 1.0 / *d);
        (depth, view.noisy(1.0, seed))
    }

    /// Moves a camera sideways with exact poses, and exact depth for its first keyframe only; the fifth step proposes a
    /// keyframe. Returns the outcomes of the steps and of their deferred work, and the mapper.
    fn walk(params: MapperParams, steps: u64, finishes: bool) -> (Vec<[Taken; 2]>, Mapper) {
        walk_with_repeats(params, steps, finishes, 0)
    }

    /// The same with each frame followed by `repeats` of it.
    fn walk_with_repeats(
        params: MapperParams,
        steps: u64,
        finishes: bool,
        repeats: usize,
    ) -> (Vec<[Taken; 2]>, Mapper) {
        let scene = Scene::new(3);
        let mut mapper = Mapper::new(CAMERA, params).unwrap();
        let outcomes = (0..steps).map(|k| {
            let x = 0.08 * k as f64;
            let world_from_camera = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            let (depth, pixels) = seen(&scene, &world_from_camera, k);
            let frame = FrameView::new(&CAMERA, k, k as i64 * 33_333_333, &pixels);
            let pose = PoseEstimate {
                state: TrackingState::Tracking,
                keyframe_id: mapper.keyframe().map_or(u64::MAX, |k| k.keyframe_id),
                world_from_camera,
                keyframe_from_camera: mapper.keyframe().map_or(SE3::identity(), |k| {
                    k.world_from_keyframe.inverse_transform_pose(&world_from_camera)
                }),
                proposes_keyframe: k == 4,
                ..PoseEstimate::unknown(&frame)
            };
            let step = mapper.step(&frame, &pose, (k == 0).then_some(&depth), &mut || {});
            let taken = |outcome, mapper: &Mapper| {
                let keyframes = mapper.map.keyframes.iter();
                Taken { outcome, points: keyframes.map(|k| k.points.clone()).collect() }
            };
            let at_once = taken(step, &mapper);
            let rest = if finishes { mapper.finish_keyframe() } else { StepOutcome::default() };
            let rest = taken(rest, &mapper);
            for _ in 0..repeats {
                let repeated = mapper.step(&frame, &pose, None, &mut || {});
                assert_eq!(repeated, StepOutcome::default());
            }
            [at_once, rest]
        });
        (outcomes.collect(), mapper)
    }

    #[test]
    fn a_new_keyframe_is_published_first_and_finished_afterwards() {
        let (outcomes, mapper) = walk(MapperParams::default(), 6, true);
        let [step, rest] = &outcomes[4];
        let (published, then) = (step.outcome, rest.outcome);
        assert!(published.keyframe_created && published.needs_image());
        assert!(then.needs_publishing() && !then.needs_image() && !then.graph_changed);
        assert!(outcomes[..4].iter().all(|[_, rest]| rest.outcome == StepOutcome::default()));
        // The previous keyframe has its final depth, the new one depth for new pixels.
        assert!(step.points[0] != rest.points[0]);
        assert!(rest.points[1].len() > step.points[1].len());
        // Without the call, the next step does the deferred work, and nothing else changes.
        let (others, late) = walk(MapperParams::default(), 6, false);
        assert!(others[5][0].outcome.keyframe_changed);
        for (one, other) in mapper.map().keyframes.iter().zip(&late.map().keyframes) {
            assert!(one.points == other.points, "keyframe {}", one.keyframe_id);
            assert_eq!(one.world_from_keyframe, other.world_from_keyframe);
        }
    }

    #[test]
    fn repeated_images_change_nothing() {
        let mut params = MapperParams::default();
        // With copies of all frames, and of those alone that give depth to new pixels.
        for num_free in [params.window.num_free, 0] {
            params.window.num_free = num_free;
            let (once, mapper) = walk(params.clone(), 6, true);
            let (repeated, other) = walk_with_repeats(params.clone(), 6, true, 3);
            assert!(once == repeated && once[5][0].outcome.observations.fused > 100);
            assert_eq!(mapper.past.newest_first().count(), other.past.newest_first().count());
        }
    }

    /// Number of points that the second keyframe gets from the first one's depth, where its image has this brightness
    /// relative to the first and the tracker reports `told`.
    fn carried(brightness: Brightness, told: Brightness) -> usize {
        let scene = Scene::new(3);
        let params = MapperParams { min_keyframe_interval: 1, ..MapperParams::default() };
        let mut mapper = Mapper::new(CAMERA, params).unwrap();
        for k in 0..2u64 {
            let x = 0.05 * k as f64;
            let world_from_camera = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            let mut view = scene.render(&CAMERA, &world_from_camera);
            let mut depth = view.inverse_depth.clone();
            depth.pixels_mut().iter_mut().for_each(|d| *d = 1.0 / *d);
            if k == 1 {
                let relit = |grey: f32| brightness.a.exp() as f32 * grey + brightness.b as f32;
                view.intensity.pixels_mut().iter_mut().for_each(|grey| *grey = relit(*grey));
            }
            let pixels = view.noisy(1.0, k);
            let frame = FrameView::new(&CAMERA, k, k as i64 * 33_333_333, &pixels);
            let pose = PoseEstimate {
                state: TrackingState::Tracking,
                keyframe_id: mapper.keyframe().map_or(u64::MAX, |k| k.keyframe_id),
                world_from_camera,
                keyframe_from_camera: mapper.keyframe().map_or(SE3::identity(), |k| {
                    k.world_from_keyframe.inverse_transform_pose(&world_from_camera)
                }),
                brightness: told,
                proposes_keyframe: true,
                ..PoseEstimate::unknown(&frame)
            };
            mapper.step(&frame, &pose, (k == 0).then_some(&depth), &mut || {});
        }
        assert_eq!(mapper.map.keyframes.len(), 2);
        mapper.map.keyframes[1].points.len()
    }

    #[test]
    fn depth_is_propagated_across_a_change_of_brightness_of_the_right_sign() {
        let brightness = Brightness { a: -0.4, b: 10.0 };
        let same = carried(Brightness::default(), Brightness::default());
        let right = carried(brightness, brightness);
        let wrong = carried(brightness, Brightness { a: 0.4, b: -10.0 / (-0.4f64).exp() });
        assert!(4 * right > 3 * same && 2 * wrong < same, "{right} {wrong} of {same}");
    }

    #[test]
    fn line_noise_of_estimated_poses_does_not_apply_to_past_frames_with_given_poses() {
        let with_line_noise = |line_noise_px| {
            let matching = MatchingParams { line_noise_px, ..MatchingParams::default() };
            walk(MapperParams { matching, ..MapperParams::default() }, 6, true).0
        };
        let (small, large) = (with_line_noise(0.1), with_line_noise(3.0));
        assert!(small[4][1].points[1].len() > small[4][0].points[1].len(), "no new pixels");
        assert!(small == large);
    }

    #[test]
    fn the_keyframe_does_not_count_as_one_of_the_past_frames() {
        let params = MapperParams { max_past_frames: 1, ..MapperParams::default() };
        let (outcomes, _) = walk(params, 5, true);
        let [step, rest] = &outcomes[4];
        assert!(rest.points[1].len() > step.points[1].len());
    }

    #[test]
    fn checking_whether_depth_is_left_behind_leaves_it_unchanged() {
        let (_, mut mapper) = walk(MapperParams::default(), 3, true);
        let before = mapper.depth.active.clone();
        let (_, pixels) = seen(&Scene::new(8), &SE3::identity(), 1);
        let frame = FrameView::new(&CAMERA, 3, 0, &pixels);
        // The frame sees nothing of the keyframe, and its pose is not a given one.
        let pose =
            PoseEstimate { alignment_covariance: [1e-6; 21], ..PoseEstimate::unknown(&frame) };
        mapper.would_lose_depth(&frame, &pose);
        let DepthBuffers { active, spare, .. } = &mapper.depth;
        assert!(spare.image.intensity.pixels() == pixels && spare.structure.pixels().is_empty());
        assert!(active.image.intensity == before.image.intensity);
        assert!(active.hypotheses == before.hypotheses && active.candidates == before.candidates);
        assert!(active.structure == before.structure);
    }

    #[test]
    fn depth_that_was_forgotten_does_not_come_back() {
        let (_, mut mapper) = walk(MapperParams::default(), 5, false);
        assert!(!mapper.map.keyframes[0].points.is_empty());
        mapper.map.forget_depth_beyond(0);
        mapper.finish_keyframe();
        assert!(mapper.map.keyframes[0].points.is_empty());
        assert!(!mapper.map.keyframes[1].points.is_empty());
    }

    #[test]
    fn a_new_keyframe_adds_the_uncertainty_of_its_pose_to_that_of_the_previous_one() {
        let scene = Scene::new(3);
        let reuse = ReuseParams { max_distance: 0.0, ..ReuseParams::default() };
        let params = MapperParams { min_keyframe_interval: 1, reuse, ..MapperParams::default() };
        let mut mapper = Mapper::new(CAMERA, params).unwrap();
        for k in 0..3u64 {
            let x = 0.05 * k as f64;
            let world_from_camera = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            let (depth, pixels) = seen(&scene, &world_from_camera, k);
            let frame = FrameView::new(&CAMERA, k, k as i64 * 33_333_333, &pixels);
            let mut pose = PoseEstimate {
                state: TrackingState::Tracking,
                world_from_camera,
                proposes_keyframe: true,
                ..PoseEstimate::unknown(&frame)
            };
            let mut expected = KeyframePoseCovariance::ZERO;
            if let Some(keyframe) = mapper.keyframe() {
                pose.keyframe_id = keyframe.keyframe_id;
                pose.keyframe_from_camera =
                    keyframe.world_from_keyframe.inverse_transform_pose(&world_from_camera);
                (pose.covariance[0], pose.covariance[20]) = (1e-4, 1e-6);
                let covariance = full_covariance(&pose.covariance);
                let place = keyframe.uncertain_pose();
                expected = place.of_next(&pose.keyframe_from_camera, &covariance);
            }
            mapper.step(&frame, &pose, Some(&depth), &mut || {});
            let keyframe = mapper.keyframe().unwrap();
            assert_eq!((keyframe.keyframe_id, keyframe.place_covariance), (k, expected));
        }
        let grown = mapper.map.keyframes.iter().map(|k| k.place_covariance.matrix()[(5, 5)]);
        let grown: Vec<f64> = grown.collect();
        assert!(grown[0] == 0.0 && (grown[1] - 1e-6).abs() < 1e-9, "{grown:?}");
        assert!((grown[2] - 2e-6).abs() < 1e-9, "{grown:?}");
    }
}
