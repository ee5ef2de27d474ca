//! Tuning of the mapper.

use crate::slam::depth::candidate::CandidateParams;
use crate::slam::depth::gaussian::GaussianParams;
use crate::slam::depth::immature::IntervalParams;
use crate::slam::depth::line_noise::LineNoiseParams;
use crate::slam::depth::matching::MatchingParams;
use crate::slam::depth::propagation::PropagationParams;
use crate::slam::depth::regularisation::RegularisationParams;
use crate::slam::keyframe::MAX_KEYFRAME_POINTS;
use crate::slam::loops::LoopParams;
use crate::slam::mapper::consistency::ConsistencyParams;
use crate::slam::mapper::modes::ModeParams;
use crate::slam::mapper::observation::DepthFilter;
use crate::slam::mapper::recovery::RecoveryParams;
use crate::slam::mapper::reuse::ReuseParams;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::two_frame::TwoFrameParams;
use crate::slam::window::params::WindowParams;
use serde::{Deserialize, Serialize};

/// Tuning of the mapper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapperParams {
    /// Smallest gradient of a pixel that may carry depth, grey levels a pixel.
    pub min_gradient: f32,
    /// Most pixels that may carry depth; the strongest gradients are kept. Bounds time and memory.
    pub max_candidates: usize,
    /// Frames before a new keyframe that give depth to its new pixels in the Gaussian filter; with 0 they wait for the
    /// frames that follow. In the simulated room 1 lowers the median error by a quarter (0.7 instead of 1.0 %), 4 no
    /// further, and each is a search over all depths for every new pixel.
    pub num_seed_frames: usize,
    /// Frames kept for that, newest first, besides the active keyframe: bounds the memory (one byte a pixel each).
    pub max_past_frames: usize,
    /// Share of the depth that must have changed before it is smoothed and published again: a map that hardly changed
    /// costs the tracker as much to prepare as a new one.
    pub publish_change_ratio: f64,
    /// Most memory for images and depth of the keyframes of the map, megabytes: about 1.7 a keyframe at
    /// 640×480. Beyond it the oldest keep only their poses.
    pub max_map_megabytes: usize,
    /// Number of keyframes up to which all keep image and depth. Beyond it, those whose points three others show as
    /// well keep only their poses, so that a map of rooms that are seen again and again does not grow.
    pub redundant_above: usize,
    /// Fewest frames between two keyframes.
    pub min_keyframe_interval: u64,
    /// Which filter estimates depth: `gaussian`, `interval` (sparse) or `both`. The Gaussian filter is
    /// the cheaper of the two that make a semi-dense map; `docs/depth-filters.md` compares them.
    pub depth_filter: DepthFilter,
    /// Search along the epipolar line.
    pub matching: MatchingParams,
    /// The misplacement of epipolar lines, from the matches.
    pub line_noise: LineNoiseParams,
    /// The Gaussian filter.
    pub gaussian: GaussianParams,
    /// The interval filter.
    pub interval: IntervalParams,
    /// The points of the interval filter where it runs alone; with the Gaussian filter it traces every pixel with
    /// gradient that has no depth yet.
    pub candidates: CandidateParams,
    /// Propagation of depth to a new keyframe.
    pub propagation: PropagationParams,
    /// Uncertainty of the errors that all depth of a keyframe shares.
    pub modes: ModeParams,
    /// Smoothing.
    pub regularisation: RegularisationParams,
    /// The start of a map.
    pub two_frame: TwoFrameParams,
    /// When the map is rejected.
    pub consistency: ConsistencyParams,
    /// When an earlier keyframe becomes active again.
    pub reuse: ReuseParams,
    /// Recovery of a lost camera.
    pub recovery: RecoveryParams,
    /// The joint estimation of keyframes.
    pub window: WindowParams,
    /// The search for loops.
    pub loops: LoopParams,
}

impl Default for MapperParams {
    fn default() -> Self {
        Self {
            min_gradient: 5.0,
            max_candidates: MAX_KEYFRAME_POINTS,
            num_seed_frames: 1,
            max_past_frames: 40,
            publish_change_ratio: 0.2,
            max_map_megabytes: 512,
            redundant_above: 120,
            min_keyframe_interval: 2,
            depth_filter: DepthFilter::default(),
            matching: MatchingParams::default(),
            line_noise: LineNoiseParams::default(),
            gaussian: GaussianParams::default(),
            interval: IntervalParams::default(),
            candidates: CandidateParams::default(),
            propagation: PropagationParams::default(),
            modes: ModeParams::default(),
            regularisation: RegularisationParams::default(),
            two_frame: TwoFrameParams::default(),
            consistency: ConsistencyParams::default(),
            reuse: ReuseParams::default(),
            recovery: RecoveryParams::default(),
            window: WindowParams::default(),
            loops: LoopParams::default(),
        }
    }
}

/// Bytes per megabyte in the configuration.
const BYTES_PER_MEGABYTE: usize = 1_000_000;

impl MapperParams {
    /// Bytes of image and depth that the map may hold.
    pub fn max_map_bytes(&self) -> usize {
        self.max_map_megabytes * BYTES_PER_MEGABYTE
    }

    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("min_gradient", self.min_gradient, 0.5..=100.0)?;
        check_range("max_candidates", self.max_candidates, 100..=MAX_KEYFRAME_POINTS)?;
        check_range("num_seed_frames", self.num_seed_frames, 0..=20)?;
        check_range("max_past_frames", self.max_past_frames, 1..=200)?;
        check_range("publish_change_ratio", self.publish_change_ratio, 0.0..=10.0)?;
        check_range("max_map_megabytes", self.max_map_megabytes, 16..=1_000_000)?;
        check_range("redundant_above", self.redundant_above, 1..=1_000_000)?;
        check_range("min_keyframe_interval", self.min_keyframe_interval, 1..=1000)?;
        self.matching.validate().map_err(|e| e.within("matching"))?;
        self.line_noise.validate().map_err(|e| e.within("line_noise"))?;
        self.gaussian.validate().map_err(|e| e.within("gaussian"))?;
        self.interval.validate().map_err(|e| e.within("interval"))?;
        self.candidates.validate().map_err(|e| e.within("candidates"))?;
        self.propagation.validate().map_err(|e| e.within("propagation"))?;
        self.modes.validate().map_err(|e| e.within("modes"))?;
        self.regularisation.validate().map_err(|e| e.within("regularisation"))?;
        self.two_frame.validate().map_err(|e| e.within("two_frame"))?;
        self.consistency.validate().map_err(|e| e.within("consistency"))?;
        self.reuse.validate().map_err(|e| e.within("reuse"))?;
        self.recovery.validate().map_err(|e| e.within("recovery"))?;
        self.window.validate().map_err(|e| e.within("window"))?;
        self.loops.validate().map_err(|e| e.within("loops"))
    }
}
