//! A map of earlier runs: its keyframes are searched for the camera; once it is found, the map is extended, or left
//! unchanged and only used to locate the camera.

use crate::slam::frame::FrameView;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;
use crate::slam::mapper::phase::{Active, Loss, Phase};
use crate::slam::mapper::situation::Certainty;
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::pose::PoseEstimate;

/// How a map of earlier runs is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapUse {
    /// It is extended.
    Extend,
    /// It is left unchanged: no keyframe is added, and no depth or pose changes.
    Locate,
}

/// Why a mapper cannot start in a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PriorError {
    /// A keyframe was taken with another camera.
    #[error("keyframe {0} was taken with another camera")]
    Camera(u64),
    /// There is no keyframe with depth.
    #[error("the map has no keyframe with depth to relocalise against")]
    Empty,
}

/// The map that a mapper has started in.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prior {
    map_use: MapUse,
    /// Ids below this belong to its keyframes.
    first_own: u64,
    /// Certainty of the last pose.
    certainty: Certainty,
}

impl Map {
    /// Combines `self`, the checkpoint of a mapper that died, with the map on the disk: adds the keyframes that only
    /// the older map has, and takes its depth for those that have none here.
    pub fn merged_over(mut self, older: Self) -> Self {
        self.free_epoch = self.free_epoch.max(older.free_epoch);
        self.revision = self.revision.max(older.revision);
        if self.loops.is_empty() {
            self.loops = older.loops;
        }
        for keyframe in older.keyframes {
            match self.keyframes.iter_mut().find(|of| of.keyframe_id == keyframe.keyframe_id) {
                None => self.keyframes.push(keyframe),
                Some(known) if !known.is_same(&keyframe) => {}
                Some(known) if known.has_depth() => known.description = keyframe.description,
                Some(known) => {
                    (known.image, known.points) = (keyframe.image, keyframe.points);
                    known.is_refined = keyframe.is_refined;
                    known.description = keyframe.description;
                }
            }
        }
        self.keyframes.sort_by_key(|keyframe| keyframe.keyframe_id);
        self
    }
}

impl Mapper {
    /// Starts in a map of earlier runs, before the first frame: its epochs, ids and revisions continue, and its
    /// keyframes are searched for the camera in each frame. Odometry starts from the camera's pose in the map.
    pub fn start_in_map(&mut self, map: Map, map_use: MapUse) -> Result<(), PriorError> {
        let foreign = map.keyframes.iter().find(|of| of.intrinsics != self.intrinsics);
        if let Some(foreign) = foreign {
            return Err(PriorError::Camera(foreign.keyframe_id));
        }
        let is_empty = !map.keyframes.iter().any(Keyframe::is_usable);
        let newest = |number: fn(&Keyframe) -> u64| map.keyframes.iter().map(number).max();
        self.revision = newest(|keyframe| keyframe.revision).unwrap_or(0);
        self.next_keyframe_id = newest(|keyframe| keyframe.keyframe_id).map_or(0, |id| id + 1);
        self.first_free_epoch = map.free_epoch;
        if map_use == MapUse::Locate {
            // Nothing is estimated.
            self.window = None;
            self.params.window.num_free = 0;
        } else if is_empty {
            self.map.revision = map.revision;
            return Ok(());
        }
        if is_empty {
            return Err(PriorError::Empty);
        }
        self.map = map;
        for keyframe in &mut self.map.keyframes {
            keyframe.world_from_keyframe = keyframe.map_from_keyframe;
        }
        self.index_map();
        self.phase = Phase::Lost(Loss::default());
        let certainty = Certainty::default();
        self.prior = Some(Prior { map_use, first_own: self.next_keyframe_id, certainty });
        Ok(())
    }

    /// Whether the map is left unchanged.
    pub(super) fn is_locating(&self) -> bool {
        self.prior.is_some_and(|prior| prior.map_use == MapUse::Locate)
    }

    /// Whether the camera has not been found yet in the map of earlier runs.
    pub(super) fn is_localising(&self) -> bool {
        self.prior.is_some() && self.active.is_none()
    }

    /// Certainty of the camera's pose, as long as the active keyframe is one of the map of earlier runs.
    pub(super) fn certainty(&self) -> Option<Certainty> {
        let (prior, keyframe) = (self.prior?, self.keyframe()?);
        let is_known = prior.map_use == MapUse::Locate || keyframe.keyframe_id < prior.first_own;
        is_known.then_some(prior.certainty)
    }

    /// Stores the certainty of a tracked pose.
    pub(super) fn note_certainty(&mut self, pose: &PoseEstimate) {
        if let Some(prior) = &mut self.prior {
            prior.certainty = Certainty::of(pose);
        }
    }

    /// Uses a tracked frame without changing the map: another keyframe near the camera may become active.
    pub(super) fn locate_frame(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
    ) -> StepOutcome {
        /// Distance at which the tracker proposes another keyframe: any nearer one will do.
        const MAX_DISTANCE: f64 = 1.0;
        let Some(active) = &mut self.active else { return StepOutcome::default() };
        active.frames += 1;
        if !pose.proposes_keyframe || active.frames < self.params.min_keyframe_interval {
            return StepOutcome::default();
        }
        let agrees = self.params.reuse.max_disagreement;
        match self.near_keyframe(frame, pose, MAX_DISTANCE, agrees) {
            Some(near) => {
                self.anchor(near.keyframe_id, &near.located.keyframe_from_camera);
                self.enter_unchanged(near.index)
            }
            None => StepOutcome::default(),
        }
    }

    /// Makes a keyframe of the map the active one, its depth and its pose in the map unchanged.
    pub(super) fn enter_unchanged(&mut self, index: usize) -> StepOutcome {
        let is_first = self.active.is_none();
        self.active = Some(Active::new(index));
        if let Some(keyframe) = self.map.keyframes.get(index) {
            self.modes.enter(&keyframe.mode_covariance, &self.params.modes);
        }
        self.revision += 1;
        self.publish_pose();
        StepOutcome::keyframe_restored(is_first)
    }

    /// Pose of a keyframe's map in odometry's world, as last published with the keyframe.
    pub(super) fn world_from_map_of(keyframe: &Keyframe) -> Sim3 {
        keyframe.world_from_keyframe * keyframe.map_from_keyframe.inverse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::situation::Situation;
    use crate::slam::pose::TrackingState;
    use crate::slam::test_scene::{CAMERA, Scene};

    fn sideways(x: f64) -> SE3 {
        SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() }
    }

    fn map(scene: &Scene) -> Map {
        let keyframes =
            vec![scene.keyframe(4, sideways(0.0), 1.0), scene.keyframe(7, sideways(0.3), 1.0)];
        Map { keyframes, free_epoch: 3, ..Map::default() }
    }

    fn mapper_in(map: Map, map_use: MapUse) -> Mapper {
        let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
        mapper.start_in_map(map, map_use).unwrap();
        mapper
    }

    /// Steps with a frame taken at `x`, and the pose that the tracker would report.
    fn step(mapper: &mut Mapper, scene: &Scene, sequence: u64, x: f64) -> StepOutcome {
        let pixels = scene.render(&CAMERA, &sideways(x)).noisy(2.0, sequence);
        let frame = FrameView::new(&CAMERA, sequence, sequence as i64 * 33_333_333, &pixels);
        let unknown = PoseEstimate::unknown(&frame);
        let pose = mapper.keyframe().map_or(unknown, |keyframe| PoseEstimate {
            state: TrackingState::Tracking,
            keyframe_id: keyframe.keyframe_id,
            world_from_camera: sideways(x),
            keyframe_from_camera: keyframe.map_from_keyframe.inverse_transform_pose(&sideways(x)),
            alignment_covariance: [1e-9; 21],
            proposes_keyframe: true,
            ..unknown
        });
        mapper.step(&frame, &pose, None, &mut || {})
    }

    #[test]
    fn the_camera_is_found_in_a_map_that_is_left_unchanged() {
        let scene = Scene::new(3);
        let mut mapper = mapper_in(map(&scene), MapUse::Locate);
        assert_eq!(mapper.situation(), Situation::Localising(2));
        let found = step(&mut mapper, &scene, 0, 0.05);
        assert!(found.keyframe_restored && found.graph_changed);
        assert_eq!(mapper.keyframe().unwrap().keyframe_id, 4);
        // The camera moves on to where the other keyframe is nearer.
        let outcomes: Vec<StepOutcome> =
            (1..20).map(|k| step(&mut mapper, &scene, k, 0.05 + 0.0125 * k as f64)).collect();
        assert!(outcomes.iter().all(|outcome| !outcome.keyframe_created));
        assert!(outcomes.iter().any(|outcome| outcome.keyframe_restored));
        assert_eq!(mapper.keyframe().unwrap().keyframe_id, 7);
        assert!(matches!(mapper.situation(), Situation::Localised(_)));
        for (now, before) in mapper.map().keyframes.iter().zip(map(&scene).keyframes) {
            assert!(now.points == before.points && now.image == before.image);
            assert_eq!(now.map_from_keyframe, before.map_from_keyframe);
        }
        assert_eq!(mapper.map().keyframes.len(), 2);
        // A lost camera is searched for, and no epoch is started.
        let noise: Vec<u8> =
            (0..CAMERA.width * CAMERA.height).map(|i| (i * i * 31 % 253) as u8).collect();
        for sequence in 20..40 {
            let frame = FrameView::new(&CAMERA, sequence, sequence as i64 * 1_000_000_000, &noise);
            let keyframe_id = mapper.keyframe().unwrap().keyframe_id;
            let lost = PoseEstimate { keyframe_id, ..PoseEstimate::unknown(&frame) };
            assert!(!mapper.step(&frame, &lost, None, &mut || {}).keyframe_created);
        }
    }

    #[test]
    fn an_extended_map_continues_with_new_numbers() {
        let scene = Scene::new(3);
        let mut mapper = mapper_in(map(&scene), MapUse::Extend);
        assert_eq!((mapper.free_epoch(), mapper.next_keyframe_id), (3, 8));
        let found = step(&mut mapper, &scene, 0, 0.05);
        assert!(found.keyframe_restored && found.graph_changed);
        assert_eq!(mapper.keyframe().unwrap().epoch, 0);
        assert!(matches!(mapper.situation(), Situation::Localised(_)));
    }

    #[test]
    fn a_map_of_another_camera_and_an_empty_map_to_locate_in_are_refused() {
        let scene = Scene::new(3);
        let begin = |map: Map, map_use| {
            Mapper::new(CAMERA, MapperParams::default()).unwrap().start_in_map(map, map_use)
        };
        let mut foreign = map(&scene);
        foreign.keyframes[1].intrinsics = Intrinsics { fx: CAMERA.fx + 1.0, ..CAMERA };
        assert_eq!(begin(foreign, MapUse::Extend), Err(PriorError::Camera(7)));
        assert_eq!(begin(Map::default(), MapUse::Locate), Err(PriorError::Empty));
        assert_eq!(begin(Map::default(), MapUse::Extend), Ok(()));
    }

    #[test]
    fn a_checkpoint_takes_precedence_over_the_map_on_the_disk() {
        let scene = Scene::new(3);
        let on_disk = map(&scene);
        let mut moved = scene.keyframe(7, sideways(0.4), 1.0).without_depth();
        moved.revision = 9;
        let checkpoint = Map {
            keyframes: vec![moved, scene.keyframe(8, sideways(0.5), 1.0)],
            free_epoch: 20,
            ..Map::default()
        };
        let both = checkpoint.merged_over(on_disk.clone());
        let ids: Vec<u64> = both.keyframes.iter().map(|of| of.keyframe_id).collect();
        assert_eq!((ids, both.free_epoch), (vec![4, 7, 8], 20));
        assert_eq!(both.keyframes[1].map_from_keyframe.rigid, sideways(0.4));
        assert!(both.keyframes[1].points == on_disk.keyframes[1].points);
    }
}
