//! The start of a map: from two frames, from a depth sensor, or from given poses.

use crate::slam::depth::gaussian::{
    NEW_VALIDITY, ObservationCounts, ObservedPixels, Observer, observe,
};
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::depth::matching::MatchingParams;
use crate::slam::depth::pose_noise::pose_noise_px;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::keyframe_pose_covariance::UncertainPose;
use crate::slam::mapper::doubt::Doubt;
use crate::slam::mapper::phase::Phase;
use crate::slam::mapper::situation::{StartFrame, StartProgress};
use crate::slam::mapper::{Mapper, StepInput, StepOutcome};
use crate::slam::parameter::ParameterError;
use crate::slam::pose::{PoseEstimate, TrackingState, upper_triangle};
use crate::slam::two_frame::{
    Failure, InitOutcome, InitState, TwoFrameInitializer, TwoFrameParams,
};

/// A two-frame start and its progress.
#[derive(Debug)]
pub(super) struct Start {
    intrinsics: Intrinsics,
    params: TwoFrameParams,
    /// Freed once a map has started.
    initializer: Option<Box<TwoFrameInitializer>>,
    /// Sequence and stamp of its first frame.
    first: Option<(u64, i64)>,
    /// The same of the latest frame.
    latest: Option<(u64, i64)>,
    /// Its progress.
    pub(super) progress: StartProgress,
    /// Outcome of the last frame, if it belonged to the start.
    pub(super) last_frame: Option<StartFrame>,
    /// Outcome of the last image, which further frames may repeat.
    last_image: StartFrame,
    /// Whether the last image was taken, from this or an earlier frame.
    pub(super) has_image: bool,
}

impl Start {
    /// Creates a start for images of `intrinsics`, before its first frame.
    pub(super) fn new(
        intrinsics: Intrinsics,
        params: &TwoFrameParams,
    ) -> Result<Self, ParameterError> {
        // Only validates the parameters: the initializer is created with the first frame.
        TwoFrameInitializer::new(intrinsics, params.clone())
            .map_err(|error| error.within("two_frame"))?;
        Ok(Self {
            intrinsics,
            params: params.clone(),
            initializer: None,
            first: None,
            latest: None,
            progress: StartProgress::default(),
            last_frame: None,
            last_image: StartFrame::Begun,
            has_image: false,
        })
    }

    /// Forgets its frames and its progress.
    pub(super) fn forget(&mut self) {
        self.give_up();
        self.progress = StartProgress::default();
    }

    /// Frees its memory, since a map has started without it.
    pub(super) fn give_up(&mut self) {
        (self.first, self.latest, self.initializer) = (None, None, None);
        self.has_image = false;
    }

    /// Takes a frame; returns the start once parallax is proven. Some frames of a fast camera are left out: a start is
    /// judged in steps of about 30 Hz, and must be proven within a fixed number of them. So is a frame that repeats the
    /// previous image, as in a video converted to a higher rate: it would confirm a motion that a single image shows, and
    /// the camera would seem to have rested before the next one.
    fn step(&mut self, frame: &FrameView<'_>, is_repeat: bool) -> Option<Proven> {
        /// A frame this soon after the previous one is left out, nanoseconds: 45 Hz.
        const TOO_SOON: std::ops::Range<i64> = 1..22_000_000;
        let since = self.latest.map(|(_, nanos)| frame.capture_nanos.saturating_sub(nanos));
        if since.is_some_and(|since| TOO_SOON.contains(&since)) {
            self.last_frame = None;
            return None;
        }
        if is_repeat && self.has_image {
            self.last_frame = Some(match self.last_image {
                StartFrame::Begun => StartFrame::Still,
                outcome => outcome,
            });
            return None;
        }
        let mut initializer = match self.initializer.take() {
            Some(initializer) => initializer,
            None => TwoFrameInitializer::new(self.intrinsics, self.params.clone()).ok()?.into(),
        };
        self.has_image = true;
        let is_first = initializer.first_pixels().is_empty();
        let outcome = initializer.step(frame.pixels);
        self.last_image = StartFrame::of(&outcome, is_first, frame.pixels);
        self.last_frame = Some(self.last_image);
        self.progress.observe(outcome.state);
        let stamp = (frame.sequence, frame.capture_nanos);
        if outcome.state != InitState::Failed(Failure::WrongSize) {
            let before = self.latest.replace(stamp);
            self.first = match outcome.frames {
                0 => self.latest,
                1 => before,
                _ => self.first,
            };
        }
        if outcome.state == InitState::Proven {
            return self.first.map(|first| Proven { first, outcome, initializer });
        }
        self.initializer = Some(initializer);
        None
    }
}

/// A start whose parallax is proven.
struct Proven {
    /// Sequence and stamp of its first frame.
    first: (u64, i64),
    /// Outcome of the frame that proved it.
    outcome: InitOutcome,
    /// Holds the depth.
    initializer: Box<TwoFrameInitializer>,
}

impl Mapper {
    /// Starts an epoch: at once where a sensor gives depth or the pose is claimed without a map (it is given, so the
    /// baselines will be true), otherwise once two frames prove it. A later epoch starts at the camera's last known
    /// pose and in the unit of the last keyframe: nothing ties it to the epoch before, and a subscriber that ignores
    /// the epoch sees the smallest jump.
    pub(super) fn begin(&mut self, input: &StepInput<'_>) -> StepOutcome {
        let StepInput { frame, pose, sensor_depth } = *input;
        // After a map was rejected, a pose on it may still arrive, which is not a given one.
        let is_given = pose.state.is_tracked() && matches!(self.phase, Phase::Starting);
        if sensor_depth.is_none() && !is_given {
            return match self.start.step(frame, self.copies.is_repeat()) {
                Some(proven) => self.begin_proven(frame, pose, &proven),
                None => {
                    self.keep_early_frame(frame);
                    StepOutcome::default()
                }
            };
        }
        self.early.clear();
        self.start.give_up();
        // Depth and image of the keyframe are from this frame, though it may repeat one nearly.
        self.copies.begin_copy();
        let (origin, _) = self.origin(pose);
        self.begin_epoch(frame.pixels);
        if let Some(sensor) = sensor_depth {
            take_sensor_depth(&mut self.depth.active, sensor, 1.0);
        }
        self.depth.is_unit_open = is_given && sensor_depth.is_none();
        let scale = self.depth.normalise();
        let map_from_camera = if is_given { pose.world_from_camera } else { origin };
        let epoch = self.free_epoch();
        let place = UncertainPose::exact(Sim3::new(map_from_camera, scale));
        self.add_keyframe(frame, &place, epoch);
        StepOutcome::map_started()
    }

    /// Matching parameters for a frame at `pose`: the less certain the pose, the less certain a match.
    pub(super) fn matching_at(&self, pose: &PoseEstimate) -> MatchingParams {
        let matching = &self.params.matching;
        let pose_noise_px = pose_noise_px(&self.intrinsics, &pose.alignment_covariance);
        MatchingParams {
            line_noise_px: matching.line_noise_with(self.line_noise.std_dev_px(), pose_noise_px),
            ..matching.clone()
        }
    }

    /// Sets the unit of the depth buffer, for a keyframe without depth at given poses, such that the longest search in
    /// a frame at this baseline reaches the nearest depth that is searched for: the unit of the poses contains no
    /// information about the depth of the scene. The keyframe's own unit stays that of the poses.
    pub(super) fn guess_unit(&mut self, keyframe_from_camera: &SE3) {
        /// Share of the longest search that is used, so that rounding does not make it too long.
        const USED_SEARCH: f64 = 0.95;
        if !self.depth.is_unit_open || self.num_points() > 0 {
            return;
        }
        let focal_px = self.intrinsics.fx.max(self.intrinsics.fy);
        let nearest = f64::from(self.params.gaussian.max_inverse_depth);
        let search_px = USED_SEARCH * f64::from(self.params.matching.max_search_px);
        let baseline = keyframe_from_camera.translation.norm() / self.depth.unit;
        if baseline > 0.0 {
            self.depth.scale_unit(baseline * focal_px * nearest / search_px);
        }
    }

    /// Pose and unit at which the next epoch starts: those of the camera and of the last trusted keyframe, if any.
    fn origin(&self, pose: &PoseEstimate) -> (SE3, f64) {
        let trusted = |keyframe: &&Keyframe| keyframe.map_state == MapState::Established;
        match self.map.keyframes.iter().rev().find(trusted) {
            Some(last) => (pose.world_from_camera, last.world_from_keyframe.scale),
            None => (SE3::identity(), 1.0),
        }
    }

    /// The number of the next epoch: neither it nor any above was assigned before, here or by a mapper that died.
    pub fn free_epoch(&self) -> u32 {
        let numbers = self.map.keyframes.iter().map(|keyframe| keyframe.epoch);
        let after_last = numbers.max().map_or(0, |last| last.saturating_add(1));
        after_last.max(self.first_free_epoch)
    }

    /// Leaves the active keyframe and starts depth on `pixels`, in a new world.
    fn begin_epoch(&mut self, pixels: &[u8]) {
        self.deactivate_keyframe();
        if let Some(left) = self.keyframe() {
            let (keyframe_id, epoch) = (left.keyframe_id, left.epoch);
            self.left_worlds.insert(epoch, self.world_from_map);
            self.queue_keyframe_to_save(keyframe_id);
        }
        self.active = None;
        self.phase = Phase::Mapping;
        self.doubt = Doubt::None;
        self.world_from_map = Sim3::identity();
        self.last_world_from_camera = None;
        self.last_tracked = None;
        self.past.clear();
        self.modes.forget();
        self.depth.restart(pixels, &self.params);
    }

    /// Makes the first frame of a proven start a keyframe and this frame the next one, so that the tracker starts where
    /// the camera is.
    fn begin_proven(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        proven: &Proven,
    ) -> StepOutcome {
        let Proven { first, outcome: start, initializer } = proven;
        let is_repeat = self.copies.is_repeat();
        let (origin, unit) = self.origin(pose);
        let first_pixels = initializer.first_pixels();
        self.begin_epoch(first_pixels);
        let epoch = self.free_epoch();
        initializer.fill(&mut self.depth.active);
        let observations = self.observe_proven(frame, start);
        self.depth.refine(&self.params);
        let scale = self.depth.normalise();
        self.modes.rescale(scale);
        let first_frame =
            FrameView { sequence: first.0, capture_nanos: first.1, pixels: first_pixels, ..*frame };
        let place = UncertainPose::exact(Sim3::new(origin, unit * scale));
        // A map starts with two frames in one step, of which this one may repeat the image before it.
        self.copies.begin_copy();
        self.add_keyframe(&first_frame, &place, epoch);
        self.copies.begin_copy();
        let pose = PoseEstimate {
            epoch,
            world_from_camera: Sim3::new(origin, unit).transform_pose(&start.first_from_current),
            keyframe_id: self.next_keyframe_id - 1,
            ..proven_pose(frame, start, scale)
        };
        self.change_keyframe(&StepInput { frame, pose: &pose, sensor_depth: None });
        self.adopt_early_frames(&pose.keyframe_from_camera, is_repeat);
        StepOutcome { observations, ..StepOutcome::map_started() }
    }

    /// Observes the depth of the first frame in the one that proves the start.
    fn observe_proven(&mut self, frame: &FrameView<'_>, start: &InitOutcome) -> ObservationCounts {
        self.frame.fill(frame.pixels);
        let observer = Observer {
            image: &self.frame,
            view: self.view_of(&start.first_from_current),
            brightness: start.brightness,
            pixels: ObservedPixels::New,
        };
        let (matching, gaussian) = (&self.params.matching, &self.params.gaussian);
        let current_from_first = start.first_from_current.inverse();
        let covariance = &start.pose_covariance;
        self.modes.begin(&self.depth.active, &self.intrinsics, &current_from_first, covariance);
        let observations = observe(&mut self.depth.active, &observer, matching, gaussian).counts;
        self.modes.update_after_observation(&self.depth.active, &current_from_first);
        observations
    }
}

/// The pose of the frame that proves a start, on the first as a keyframe whose unit is `scale`.
fn proven_pose(frame: &FrameView<'_>, start: &InitOutcome, scale: f64) -> PoseEstimate {
    let mut keyframe_from_camera = start.first_from_current;
    keyframe_from_camera.translation /= scale;
    let covariance = upper_triangle(|row, column| {
        let unit = |of: usize| if of < 3 { scale } else { 1.0 };
        start.pose_covariance[(row, column)] / (unit(row) * unit(column))
    });
    PoseEstimate {
        state: TrackingState::Initializing,
        keyframe_from_camera,
        covariance,
        // Without a covariance the pose would count as given, and observations at it as exact.
        alignment_covariance: covariance,
        brightness: start.brightness,
        ..PoseEstimate::unknown(frame)
    }
}

/// Gives every candidate the depth of a sensor, in units of `scale` metres.
pub(super) fn take_sensor_depth(map: &mut DepthMap, sensor: &Image<f32>, scale: f64) {
    /// Relative standard deviation of a depth camera at room distances.
    const SENSOR_STD_DEV_RATIO: f32 = 0.01;
    if (sensor.width(), sensor.height()) != (map.image.width(), map.image.height()) {
        return;
    }
    let pixels = map.hypotheses.pixels_mut().iter_mut().zip(map.candidates.pixels());
    for ((hypothesis, candidate), &depth) in pixels.zip(sensor.pixels()) {
        if !candidate || !(depth > 0.0) || !depth.is_finite() {
            continue;
        }
        let inverse_depth = scale as f32 / depth;
        *hypothesis = Hypothesis {
            inverse_depth,
            variance: (SENSOR_STD_DEV_RATIO * inverse_depth).powi(2),
            independent: (SENSOR_STD_DEV_RATIO * inverse_depth).powi(2),
            smoothed: inverse_depth,
            validity: NEW_VALIDITY,
            propagated: true,
            failures: 0,
        };
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::mapper::MapperParams;
    use crate::slam::test_scene::{CAMERA, Scene};
    use crate::slam::window::frames::TrackedFrame;

    /// Time from frame to frame at 30 Hz.
    const PERIOD_NANOS: i64 = 33_333_333;

    #[test]
    fn a_start_has_as_much_time_with_a_fast_camera_as_with_a_slow_one() {
        let image = Scene::new(1).render(&CAMERA, &SE3::identity());
        // Number of frames taken when the start gives up on a camera at rest, and the time of that.
        let given_up = |rate: i64| {
            let mut start = Start::new(CAMERA, &TwoFrameParams::default()).unwrap();
            let mut taken = 0;
            for sequence in 0..300 {
                let pixels = &image.noisy(2.0, sequence);
                let nanos = sequence as i64 * 1_000_000_000 / rate;
                start.step(&FrameView::new(&CAMERA, sequence, nanos, pixels), false);
                taken += usize::from(start.last_frame.is_some());
                if start.progress.failures > 0 {
                    return (taken, nanos as f64 * 1e-9);
                }
            }
            panic!("never at {rate} Hz");
        };
        for rate in [30, 60, 120] {
            let (taken, secs) = given_up(rate);
            assert_eq!(taken, 61, "{rate} Hz");
            // At 120 Hz every third frame is taken.
            assert!((1.4..2.1).contains(&secs), "{rate} Hz: {secs} s");
        }
    }

    /// A start with a camera that moves forwards by 0.2 per frame, and the frame that proves it.
    fn proven(params: &TwoFrameParams) -> (Proven, Vec<u8>) {
        proven_with(params, 1)
    }

    /// The same with each image sent `times` times.
    fn proven_with(params: &TwoFrameParams, times: u64) -> (Proven, Vec<u8>) {
        let mut start = Start::new(CAMERA, params).unwrap();
        let proven = (0..3 * times).find_map(|sent| {
            let image = sent / times;
            let moved = Vector6::new(0.0, 0.0, 0.2 * image as f64, 0.0, 0.0, 0.0);
            let pixels = Scene::new(1).render(&CAMERA, &SE3::exp(&moved)).noisy(2.0, 100 + image);
            let nanos = PERIOD_NANOS * sent as i64;
            let frame = FrameView::new(&CAMERA, 10 + sent, nanos, &pixels);
            let proven = start.step(&frame, sent % times > 0);
            let repeated = [StartFrame::Still, StartFrame::LittleParallax];
            let expected = repeated.get(image as usize).copied();
            assert!(sent % times == 0 || start.last_frame == expected, "{:?}", start.last_frame);
            Some((proven?, pixels))
        });
        proven.unwrap()
    }

    #[test]
    fn an_image_that_is_repeated_counts_once() {
        let (once, pixels) = proven(&TwoFrameParams::default());
        let (repeated, last) = proven_with(&TwoFrameParams::default(), 2);
        assert_eq!(pixels, last);
        assert_eq!(repeated.outcome, once.outcome);
        assert_eq!(repeated.first, once.first);
    }

    #[test]
    fn a_map_from_a_doubled_video_is_that_of_its_images() {
        /// Sends the images at these places, each as it is or compressed again; returns the images of the first two
        /// keyframes, the second one's pose on the first, and the guesses for other frames.
        fn map_from(sent: &[(u64, bool)], hz: i64) -> ([Vec<u8>; 2], SE3, Vec<TrackedFrame>) {
            let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
            for (sequence, &(image, is_again)) in (0..).zip(sent) {
                let pixels = seen(image, is_again);
                let frame = FrameView::new(
                    &CAMERA,
                    sequence,
                    sequence as i64 * 1_000_000_000 / hz,
                    &pixels,
                );
                mapper.step(&frame, &PoseEstimate::unknown(&frame), None, &mut || {});
            }
            let [first, second] = &mapper.map.keyframes[..] else { panic!("no map") };
            let images = [first, second].map(|keyframe| keyframe.image.to_vec());
            let second = &second.world_from_keyframe.rigid;
            let place = first.world_from_keyframe.inverse_transform_pose(second);
            (images, place, mapper.tracked.clone())
        }
        fn seen(image: u64, is_again: bool) -> Vec<u8> {
            let moved = Vector6::new(0.0, 0.0, 0.2 * image as f64, 0.0, 0.0, 0.0);
            let pixels = Scene::new(1).render(&CAMERA, &SE3::exp(&moved)).noisy(2.0, 100 + image);
            let greys = pixels.iter().enumerate();
            greys
                .map(|(at, &grey)| if is_again && at % 7 == 0 { grey.max(2) ^ 1 } else { grey })
                .collect()
        }
        let (once, pose, before) = map_from(&[(0, false), (1, false), (2, false)], 30);
        assert_eq!(once, [seen(0, false), seen(2, false)]);
        let twice = [0, 1, 2].map(|image| [(image, false), (image, true)]).concat();
        let (images, doubled, guesses) = map_from(&twice[..5], 30);
        assert_eq!((images, doubled), (once, pose));
        let guess = |frames: &[TrackedFrame]| frames[frames.len() - 1].keyframe_from_camera;
        assert_eq!(guess(&before), guess(&guesses));
        assert_eq!(
            guesses.iter().map(|frame| &frame.repeats[..]).collect::<Vec<_>>(),
            [&[][..], &[3]]
        );
        // At 60 Hz, and from a repeat on, every second frame is left out as too soon: the others are repeats.
        let (images, place, guesses) = map_from(&twice[1..], 60);
        // The last of them shows the second keyframe's image.
        let off = guess(&guesses).inverse() * place;
        assert!(off.log().norm() < 1e-9 && place.log().norm() > 0.1, "{off:?}");
        assert_eq!(images, [seen(0, true), seen(2, true)]);
    }

    #[test]
    fn new_pixels_of_the_second_keyframe_are_searched_at_an_estimated_pose() {
        let mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
        let (proven, pixels) = proven(&TwoFrameParams::default());
        let pose = proven_pose(&FrameView::new(&CAMERA, 12, 0, &pixels), &proven.outcome, 1.3);
        let searched = mapper.matching_at(&pose).line_noise_px;
        assert!(searched >= mapper.params.matching.line_noise_px, "{searched} px");
    }

    #[test]
    fn a_black_frame_is_not_kept_and_drops_the_early_frames_before_it() {
        let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
        let seen = Scene::new(1).render(&CAMERA, &SE3::identity()).noisy(2.0, 1);
        // A sensor's black with its noise.
        let dark = seen.iter().map(|&grey| 8 + grey % 5).collect::<Vec<u8>>();
        for (sequence, pixels) in (0..).zip([&seen, &seen, &dark, &seen]) {
            mapper.keep_early_frame(&FrameView::new(&CAMERA, sequence, 0, pixels));
        }
        let kept = mapper.early.iter().map(|frame| frame.sequence);
        assert_eq!(kept.collect::<Vec<_>>(), [3]);
    }

    #[test]
    fn the_first_keyframe_has_the_stamp_of_the_frame_that_the_start_continued_from() {
        // After one frame of the camera's motion 84 % of the points are still visible, after two 78 %.
        for (min_visible_ratio, first) in [(0.6, 10), (0.8, 11)] {
            let mut params = TwoFrameParams::default();
            params.evidence.min_visible_ratio = min_visible_ratio;
            let stamp = (first, PERIOD_NANOS * (first as i64 - 10));
            assert_eq!(proven(&params).0.first, stamp);
        }
    }
}
