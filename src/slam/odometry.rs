//! The whole algorithm without processes: images in, poses and a map out, on the caller's thread.
//!
//! [`Odometry`] calls tracker, mapper and joint estimation as `semidense replay` does and gives the same bits. The
//! processes exist to do the same within deadlines.

use serde::{Deserialize, Serialize};

use crate::slam::alignment::reference::Reference;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::{NO_DATA, raise_black};
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;
use crate::slam::mapper::{Mapper, MapperParams, StepOutcome};
use crate::slam::parameter::ParameterError;
use crate::slam::pose::PoseEstimate;
use crate::slam::tracker::{Tracker, TrackerParams};
use crate::slam::window::Window;

/// Tuning of tracker and mapper; the defaults are those of the program.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OdometryParams {
    /// Tuning of the tracker.
    pub tracker: TrackerParams,
    /// Tuning of depth and keyframes.
    pub mapper: MapperParams,
    /// Whether pixels of grey level 0 show nothing of the scene, such as those of a robot's own parts, and are to be
    /// ignored; otherwise they are black.
    pub zero_is_hidden: bool,
}

/// Why there is no odometry for a camera.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OdometryError {
    /// Invalid size or intrinsics.
    #[error(
        "invalid camera: size {} × {}, intrinsics {}, {}, {}, {}",
        .0.width, .0.height, .0.fx, .0.fy, .0.cx, .0.cy
    )]
    Intrinsics(Intrinsics),
    /// A parameter out of its range.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
}

/// Poses and a semi-dense map from the rectified grey images of one camera.
///
/// ```
/// use semidense::{FrameView, Intrinsics, Odometry, OdometryParams};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let camera = Intrinsics { fx: 262.0, fy: 262.0, cx: 159.5, cy: 119.5, width: 320, height: 240 };
/// let mut odometry = Odometry::new(camera, OdometryParams::default())?;
/// # let images: Vec<Vec<u8>> = vec![vec![100; 320 * 240]; 2];
/// for (number, image) in images.iter().enumerate() {
///     let nanos = number as i64 * 33_333_333;
///     let pose = odometry.push(&FrameView::new(&camera, number as u64, nanos, image));
///     if pose.state.is_tracked() {
///         println!("{}", pose.map_from_camera.translation);
///     }
/// }
/// odometry.finish();
/// for keyframe in odometry.keyframes() {
///     println!("keyframe {}: {} points", keyframe.keyframe_id, keyframe.points.len());
/// }
/// # Ok(())
/// # }
/// ```
///
/// Depth is estimated on rayon's pool: the global one, or another around `push` (`ThreadPool::install`). A frame takes
/// milliseconds, one that is followed by a joint estimate of keyframes some 40 ms more.
#[derive(Debug)]
pub struct Odometry {
    params: OdometryParams,
    tracker: Tracker,
    mapper: Mapper,
    /// Memory of the reference that the tracker returned.
    spare: Option<Box<Reference>>,
    /// Pixels of a frame whose black ones were raised.
    raised: Vec<u8>,
    estimate: Option<Estimate>,
    frames: u64,
}

/// A finished joint estimate that waits for its frame.
#[derive(Debug)]
struct Estimate {
    window: Box<Window>,
    /// Frames after which it enters the map.
    due: u64,
    epoch: u32,
    map_revision: u64,
}

impl Odometry {
    /// Odometry for images of `intrinsics`, rectified and without distortion.
    pub fn new(intrinsics: Intrinsics, params: OdometryParams) -> Result<Self, OdometryError> {
        if !intrinsics.is_valid() {
            return Err(OdometryError::Intrinsics(intrinsics));
        }
        Ok(Self {
            tracker: Tracker::new(intrinsics, params.tracker.clone())?,
            mapper: Mapper::new(intrinsics, params.mapper.clone())?,
            params,
            spare: None,
            raised: Vec::new(),
            estimate: None,
            frames: 0,
        })
    }

    /// Tracks the next frame and returns its pose. Sequence and stamp must increase; a frame of another size is not
    /// tracked. Until the camera has moved sideways by some per cent of the distance of the scene there is no map, and
    /// poses are `Initializing`. Grey levels are taken as given: brighten a dim camera's frames with
    /// [`Brightening`](crate::slam::image::brightening::Brightening), and undo a lens' dark corners with
    /// [`Vignette`](crate::slam::vignette::Vignette), first.
    pub fn push(&mut self, frame: &FrameView<'_>) -> PoseEstimate {
        if self.params.zero_is_hidden || !frame.pixels.contains(&NO_DATA) {
            return self.push_marked(frame);
        }
        let mut raised = std::mem::take(&mut self.raised);
        raised.clear();
        raised.extend_from_slice(frame.pixels);
        raise_black(&mut raised);
        let pose = self.push_marked(&FrameView { pixels: &raised, ..*frame });
        self.raised = raised;
        pose
    }

    /// The same for a frame in which 0 marks pixels without data.
    fn push_marked(&mut self, frame: &FrameView<'_>) -> PoseEstimate {
        let pose = self.tracker.track(frame, &mut |_| true);
        let mut outcome = self.mapper.step(frame, &pose, None, &mut || {});
        outcome.keyframe_changed |= self.mapper.finish_keyframe().keyframe_changed;
        self.frames += 1;
        outcome.keyframe_changed |= self.apply_estimate().keyframe_changed;
        self.begin();
        // An estimate may be due with its own frame.
        outcome.keyframe_changed |= self.apply_estimate().keyframe_changed;
        if outcome.needs_publishing() {
            self.pass_keyframe_to_tracker();
        }
        pose
    }

    /// Estimates all keyframes once more and refines their depth, after the last frame. More frames may follow.
    pub fn finish(&mut self) {
        self.end_estimate(false);
        while let Some(window) = self.mapper.begin_last_search() {
            self.estimate(window);
            // One that cannot enter would be solved again and again.
            if self.end_estimate(true).is_none() {
                break;
            }
        }
        if let Some(window) = self.mapper.begin_last_adjustment() {
            self.estimate(window);
            self.end_estimate(true);
        }
        while self.mapper.refine_depth() {}
        self.mapper.store_confirmed_points();
        self.pass_keyframe_to_tracker();
    }

    /// All keyframes, in order of creation: image, inverse depth with variance, pose in the map.
    pub fn keyframes(&self) -> &[Keyframe] {
        &self.mapper.map().keyframes
    }

    /// The keyframe that frames are tracked on; `None` before the first.
    pub fn active_keyframe(&self) -> Option<&Keyframe> {
        self.mapper.keyframe()
    }

    /// The keyframes, and the pose of each frame once its keyframe was estimated.
    pub fn map(&self) -> &Map {
        self.mapper.map()
    }

    /// Makes a joint estimate where one is due. It enters the map later, as if made in parallel with the frames.
    fn begin(&mut self) {
        if self.estimate.is_none()
            && let Some(window) = self.mapper.begin_adjustment(false)
        {
            self.estimate(window);
        }
    }

    fn estimate(&mut self, mut window: Box<Window>) {
        let epoch = self.mapper.keyframe().map_or(0, |keyframe| keyframe.epoch);
        let map_revision = self.mapper.map().revision;
        window.optimise();
        let due = self.frames + self.params.mapper.window.delay_frames as u64;
        self.estimate = Some(Estimate { window, due, epoch, map_revision });
    }

    fn apply_estimate(&mut self) -> StepOutcome {
        match self.estimate.as_ref().is_some_and(|estimate| self.frames >= estimate.due) {
            true => self.end_estimate(false).unwrap_or_default(),
            false => StepOutcome::default(),
        }
    }

    /// Applies the estimate, unless the map it was made from has changed, or is rejected while frames follow; `None`
    /// where it was dropped.
    fn end_estimate(&mut self, is_last: bool) -> Option<StepOutcome> {
        let estimate = self.estimate.take()?;
        let is_same_map = self.mapper.keyframe().is_some_and(|active| {
            active.epoch == estimate.epoch
                && (is_last || active.map_state == MapState::Established)
                && self.mapper.map().revision == estimate.map_revision
        });
        if is_same_map {
            return Some(self.mapper.end_adjustment(estimate.window));
        }
        self.mapper.drop_adjustment(estimate.window);
        None
    }

    /// Hands the mapper's keyframe to the tracker, in the memory of the previous one.
    fn pass_keyframe_to_tracker(&mut self) {
        let Some(keyframe) = self.mapper.keyframe() else { return };
        let new = || Box::new(Reference::new(self.params.tracker.reference.clone()));
        let mut reference = self.spare.take().unwrap_or_else(new);
        reference.prepare_into(keyframe, self.tracker.scratch());
        self.spare = self.tracker.adopt(reference);
    }
}
