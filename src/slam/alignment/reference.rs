//! The keyframe prepared for alignment: all work done per keyframe rather than per frame.

use serde::{Deserialize, Serialize};

use crate::slam::alignment::fusion::{DepthFusion, LevelPoint};
use crate::slam::alignment::points::{LevelPoints, Point};
use crate::slam::alignment::selection::{Selection, SelectionParams};
use crate::slam::alignment::surroundings::Surroundings;
use crate::slam::alignment::tiles::tile_of;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::sums::{MAX_LEVELS, SumPyramid, grey_per_sum};
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};
use crate::slam::keyframe_pose_covariance::UncertainPose;
use crate::slam::modes::ModeCovariance;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::NO_KEYFRAME;

/// Which points of a keyframe are aligned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReferenceParams {
    /// Finest pyramid level that is aligned, 0 or 1. Level 1 has half the noise at a quarter of
    /// the pixels; level 0 costs another pyramid level and more iterations.
    pub finest_level: usize,
    /// Maximum number of points of each level, finest first. A level with more keeps the most informative ones, evenly
    /// spread; these determine the time per frame.
    pub point_budget: [usize; MAX_LEVELS],
    /// How the points of a level are chosen.
    pub selection: SelectionParams,
}

impl Default for ReferenceParams {
    fn default() -> Self {
        Self {
            finest_level: 1,
            point_budget: [12_000, 8_000, 5_000, 2_500, 1_200],
            selection: SelectionParams::default(),
        }
    }
}

impl ReferenceParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("finest_level", self.finest_level, 0..=1)?;
        for (level, &budget) in self.point_budget.iter().enumerate() {
            check_range(&format!("point_budget[{level}]"), budget, 100..=100_000)?;
        }
        self.selection.validate().map_err(|error| error.within("selection"))
    }
}

/// A side shorter than this many pixels contains too little to align.
const SHORTEST_SIDE_PX: usize = 24;

/// Number of pyramid levels for images of this size, at most [`MAX_LEVELS`].
pub fn num_levels(width: usize, height: usize) -> usize {
    let fits = |&level: &usize| width.min(height) >> level >= SHORTEST_SIDE_PX;
    (0..MAX_LEVELS).take_while(fits).count().max(1)
}

/// The finest of `num_levels` levels that is aligned: an image so small that it only has level 0 is aligned there,
/// regardless of the parameters.
pub fn finest_level(num_levels: usize, params: &ReferenceParams) -> usize {
    params.finest_level.min(num_levels.saturating_sub(1))
}

/// A keyframe prepared for alignment, point clouds by pyramid level.
#[derive(Debug, Clone)]
pub struct Reference {
    params: ReferenceParams,
    keyframe_id: u64,
    epoch: u32,
    revision: u64,
    sequence: u64,
    map_state: MapState,
    world_from_keyframe: Sim3,
    place: UncertainPose,
    map_revision: u64,
    intrinsics: Intrinsics,
    mean_inverse_depth: f64,
    mean_grey: f64,
    mode_covariance: ModeCovariance,
    translation_information: f64,
    finest_level: usize,
    levels: Vec<LevelPoints>,
    pyramid: SumPyramid,
}

/// Working memory of a preparation, not needed by frames; references can share it.
#[derive(Debug, Clone, Default)]
pub struct ReferenceScratch {
    fusion: DepthFusion,
    selection: Selection,
    surroundings: Surroundings,
}

impl ReferenceScratch {
    /// The candidates of one level of the last usable keyframe prepared, before selection; on levels that are not
    /// aligned they include those behind a jump in depth.
    pub fn candidates(&self, level: usize) -> &[LevelPoint] {
        self.fusion.level(level)
    }
}

impl Reference {
    /// An empty reference: memory for [`Reference::prepare_into`].
    pub fn new(params: ReferenceParams) -> Self {
        Self {
            finest_level: params.finest_level,
            params,
            keyframe_id: NO_KEYFRAME,
            epoch: 0,
            revision: 0,
            sequence: 0,
            map_state: MapState::Established,
            world_from_keyframe: Sim3::identity(),
            place: UncertainPose::exact(Sim3::identity()),
            map_revision: 0,
            intrinsics: Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 0, height: 0 },
            mean_inverse_depth: 1.0,
            mean_grey: 0.0,
            mode_covariance: ModeCovariance::ZERO,
            translation_information: 0.0,
            levels: vec![LevelPoints::default(); MAX_LEVELS],
            pyramid: SumPyramid::default(),
        }
    }

    /// Prepares `keyframe` with the default parameters.
    pub fn prepare(keyframe: &Keyframe) -> Self {
        let mut reference = Self::new(ReferenceParams::default());
        reference.prepare_into(keyframe, &mut ReferenceScratch::default());
        reference
    }

    /// Prepares `keyframe` in the memory of this reference. An unusable keyframe (image of another size than its
    /// intrinsics, no valid point) leaves a reference without points.
    pub fn prepare_into(&mut self, keyframe: &Keyframe, scratch: &mut ReferenceScratch) {
        self.keyframe_id = keyframe.keyframe_id;
        self.epoch = keyframe.epoch;
        self.revision = keyframe.revision;
        self.sequence = keyframe.sequence;
        self.map_state = keyframe.map_state;
        let placed =
            keyframe.world_from_keyframe.is_valid() && keyframe.map_from_keyframe.is_valid();
        let or_identity = |place: Sim3| if placed { place } else { Sim3::identity() };
        self.world_from_keyframe = or_identity(keyframe.world_from_keyframe);
        self.place = keyframe.uncertain_pose();
        self.place.map_from_keyframe = or_identity(keyframe.map_from_keyframe);
        self.map_revision = keyframe.map_revision;
        self.intrinsics = keyframe.intrinsics;
        self.mean_inverse_depth = 1.0;
        self.mean_grey = 0.0;
        self.mode_covariance = keyframe.mode_covariance;
        self.translation_information = 0.0;
        self.levels.iter_mut().for_each(LevelPoints::clear);
        let Intrinsics { width, height, .. } = keyframe.intrinsics;
        let usable =
            placed && keyframe.intrinsics.is_valid() && width * height == keyframe.image.len();
        if !usable {
            return;
        }
        let levels = num_levels(width, height);
        let finest = finest_level(levels, &self.params);
        self.finest_level = finest;
        if !self.pyramid.has_size(width, height, levels, finest) {
            self.pyramid = SumPyramid::with_size(width, height, levels, finest);
        }
        self.pyramid.fill(&keyframe.image);
        self.pack(&keyframe.points, scratch);
    }

    /// Prepares a view with these points at the identity pose, in the memory of this reference. Takes over `pyramid`,
    /// which has the levels of this camera, and leaves the previous one in its place.
    pub(super) fn prepare_view(
        &mut self,
        intrinsics: &Intrinsics,
        pyramid: &mut SumPyramid,
        points: &[DepthPoint],
        mode_covariance: ModeCovariance,
        scratch: &mut ReferenceScratch,
    ) {
        self.keyframe_id = NO_KEYFRAME;
        self.map_state = MapState::Established;
        self.world_from_keyframe = Sim3::identity();
        self.place = UncertainPose::exact(Sim3::identity());
        self.intrinsics = *intrinsics;
        self.mean_inverse_depth = 1.0;
        self.mode_covariance = mode_covariance;
        self.levels.iter_mut().for_each(LevelPoints::clear);
        self.finest_level = pyramid.finest_level();
        let Intrinsics { width, height, .. } = *intrinsics;
        let (levels, finest) = (pyramid.num_levels(), pyramid.finest_level());
        if !self.pyramid.has_size(width, height, levels, finest) {
            self.pyramid = SumPyramid::with_size(width, height, levels, finest);
        }
        std::mem::swap(&mut self.pyramid, pyramid);
        self.pack(points, scratch);
    }

    /// Places the view in world and map, with the standard deviation of the distance of frames from it, in its units.
    pub fn place_view(&mut self, world_from_view: &Sim3, expected_distance: f64) {
        self.world_from_keyframe = *world_from_view;
        self.place.map_from_keyframe = *world_from_view;
        self.translation_information = 1.0 / (expected_distance * expected_distance);
    }

    /// Information of the prior that frames are at the keyframe's position, per axis, 1/keyframe units²; 0 for a
    /// keyframe with depth.
    pub fn translation_information(&self) -> f64 {
        self.translation_information
    }

    /// Fuses points of the image into the pyramid and packs those of every level.
    fn pack(&mut self, points: &[DepthPoint], scratch: &mut ReferenceScratch) {
        let greys: f64 = points.iter().map(|point| f64::from(point.intensity)).sum();
        self.mean_grey = greys / points.len().max(1) as f64;
        let Intrinsics { width, height, .. } = self.intrinsics;
        let (levels, finest) = (self.pyramid.num_levels(), self.finest_level);
        let mean_inverse_depth = scratch.fusion.fuse(points, width, height, levels, finest);
        self.mean_inverse_depth = mean_inverse_depth.unwrap_or(1.0);
        for level in finest..levels {
            self.pack_level(level, scratch);
        }
    }

    /// Chooses the points of one level and packs them for the loop over points.
    fn pack_level(&mut self, level: usize, scratch: &mut ReferenceScratch) {
        let ReferenceScratch { fusion, selection, surroundings } = scratch;
        let intrinsics = self.intrinsics.at_level(level);
        let image = self.pyramid.level(level);
        let candidates = fusion.level(level);
        let budget = self.params.point_budget[level];
        self.levels[level].reserve(budget.min(candidates.len()));
        let chosen = selection.choose(
            &self.params.selection,
            candidates,
            image,
            level,
            intrinsics.fx / self.mean_inverse_depth,
            budget,
        );
        // Coarser levels only initialise the finer ones, and their depth has less noise to bias them.
        let is_finest = level == self.finest_level;
        if is_finest {
            surroundings.measure(candidates, image.width(), image.height());
        }
        let (inverse_fx, inverse_fy) = (1.0 / intrinsics.fx, 1.0 / intrinsics.fy);
        for &index in chosen {
            let candidate = candidates[index as usize];
            let (u, v) = (usize::from(candidate.u), usize::from(candidate.v));
            if u == 0 || v == 0 || u + 1 >= image.width() || v + 1 >= image.height() {
                continue;
            }
            let at = |u: usize, v: usize| f32::from(image.at(u, v)) * grey_per_sum(level);
            let (beside, across) = ([at(u - 1, v), at(u + 1, v)], [at(u, v - 1), at(u, v + 1)]);
            if at(u, v).min(beside[0]).min(beside[1]).min(across[0]).min(across[1]) == 0.0 {
                // No data.
                continue;
            }
            let tile = tile_of(u, v, image.width(), image.height());
            let point = Point {
                ray_x: ((u as f64 - intrinsics.cx) * inverse_fx) as f32,
                ray_y: ((v as f64 - intrinsics.cy) * inverse_fy) as f32,
                inverse_depth: candidate.inverse_depth,
                variance: candidate.variance,
                surrounding_inverse_depth: if is_finest {
                    surroundings.mean_excluding(&candidate)
                } else {
                    candidate.inverse_depth
                },
                intensity: at(u, v),
                gradient_x: 0.5 * (beside[1] - beside[0]),
                gradient_y: 0.5 * (across[1] - across[0]),
            };
            self.levels[level].push(point, tile);
        }
    }

    /// Mean grey value of the keyframe's points; 0 without any.
    pub fn mean_grey(&self) -> f64 {
        self.mean_grey
    }

    /// The keyframe it was prepared from; [`NO_KEYFRAME`] before the first.
    pub fn keyframe_id(&self) -> u64 {
        self.keyframe_id
    }

    /// Epoch of the keyframe.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// Revision of the keyframe.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// Sequence of the frame that became the keyframe.
    pub fn sequence(&self) -> u64 {
        self.sequence
    }

    /// Whether the depth can be trusted.
    pub fn map_state(&self) -> MapState {
        self.map_state
    }

    /// The keyframe's pose with the scale of its depth.
    pub fn world_from_keyframe(&self) -> &Sim3 {
        &self.world_from_keyframe
    }

    /// The keyframe's pose in the map.
    pub fn map_from_keyframe(&self) -> &Sim3 {
        &self.place.map_from_keyframe
    }

    /// The keyframe's pose in the map with its uncertainty.
    pub fn uncertain_pose(&self) -> UncertainPose {
        self.place
    }

    /// Revision of the map at that time.
    pub fn map_revision(&self) -> u64 {
        self.map_revision
    }

    /// Intrinsics of level 0.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Mean inverse depth of all points of the keyframe, 1/keyframe units.
    pub fn mean_inverse_depth(&self) -> f64 {
        self.mean_inverse_depth
    }

    /// The same as a depth, in world units.
    pub fn mean_depth_in_world(&self) -> f64 {
        self.world_from_keyframe().scale / self.mean_inverse_depth()
    }

    /// Covariance of the errors that all depth of the keyframe shares.
    pub fn mode_covariance(&self) -> &ModeCovariance {
        &self.mode_covariance
    }

    /// Finest level with prepared points.
    pub fn finest_level(&self) -> usize {
        self.finest_level
    }

    /// The points of one level; empty if the level is not aligned.
    pub fn level(&self, level: usize) -> &LevelPoints {
        &self.levels[level]
    }
}
