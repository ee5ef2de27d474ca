//! Loop closures, applied to a map that has continued to grow since the search began.

use std::sync::Arc;

use crate::slam::keyframe::Keyframe;
use crate::slam::loops::Closure;
use crate::slam::map::{Correction, KeyframeCorrection};
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::window::Window;

impl Mapper {
    /// Takes out the window for a loop search after the last frame: run [`Window::optimise`] on it and give it back
    /// with [`Mapper::end_adjustment`]. `None` once every keyframe has been searched.
    pub fn begin_last_search(&mut self) -> Option<Box<Window>> {
        let mut window = self.window.take()?;
        let is_begun = window.begin_search(&self.map, true);
        if is_begun {
            return Some(window);
        }
        self.window = Some(window);
        None
    }

    /// The map comes from an earlier mapper: index its keyframes so that their places can be recognised.
    pub(super) fn index_map(&mut self) {
        self.finder.index_new(&mut self.map.keyframes, usize::MAX);
        self.resume_loops();
    }

    /// Continues the search for loops from those stored in the map.
    pub(super) fn resume_loops(&mut self) {
        if let Some(window) = &mut self.window {
            window.loops.resume_from(Arc::clone(&self.map.loops), &self.map.keyframes);
        }
    }

    /// Takes the window back after an estimate or a search and hands its loops to the map.
    pub(super) fn return_window(&mut self, window: Box<Window>) {
        self.map.loops = Arc::clone(window.loops.record());
        self.window = Some(window);
    }

    /// Applies a loop closure to the map; odometry keeps the camera's pose and its unit.
    pub(super) fn close_loop(&mut self, closure: &Closure, window: &mut Window) -> StepOutcome {
        let active = self.keyframe().filter(|active| active.epoch == closure.epoch);
        let is_active = active.is_some();
        // Not necessarily of the newest keyframe: the camera may have returned to an older one.
        let by = active.and_then(|active| closure.of(active.keyframe_id, active.epoch));
        let unit = by.map(|by| by.scale);
        let moved = |keyframe: &Keyframe| {
            let by = closure.of(keyframe.keyframe_id, keyframe.epoch)?;
            Some(KeyframeCorrection {
                place: Some(keyframe.place_covariance.transported(by)),
                ..KeyframeCorrection::of_pose(
                    keyframe.keyframe_id,
                    *by * keyframe.map_from_keyframe,
                )
            })
        };
        let keyframes = self.map.keyframes.iter().filter_map(moved).collect();
        let joins = closure.join.into_iter().collect();
        match self.apply(&Correction { keyframes, joins, unit }) {
            Ok(outcome) => {
                if let (Some((_, by)), false) = (closure.moves.last(), is_active)
                    && let Some(world) = self.left_worlds.get_mut(&closure.epoch)
                {
                    world.scale /= by.scale;
                }
                window.apply_closure(closure);
                outcome
            }
            // Non-finite values: leave the map unchanged.
            Err(_) => StepOutcome::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::{Matrix7, Sim3};
    use crate::slam::loops::LoopParams;
    use crate::slam::loops::record::{Link, LoopRecord};
    use crate::slam::map::{EpochJoin, Map};
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::phase::Active;
    use crate::slam::test_scene::{CAMERA, Scene};
    use crate::slam::window::params::WindowParams;

    fn sideways(x: f64) -> SE3 {
        SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() }
    }

    /// A mapper with keyframes at x = 0 and 1, and a camera next to the second.
    fn mapper() -> Mapper {
        let scene = Scene::new(3);
        let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
        let ids = (0..).zip([0.0, 1.0]);
        mapper.map.keyframes = ids.map(|(id, x)| scene.keyframe(id, sideways(x), 1.0)).collect();
        mapper.active = Some(Active::new(1));
        mapper.last_tracked = Some((1, sideways(0.1)));
        mapper.last_world_from_camera = Some(sideways(1.1));
        mapper
    }

    fn window() -> Window {
        Window::new(CAMERA, WindowParams::default())
    }

    /// The world's x of a camera that is `x` away from the active keyframe.
    fn in_world(mapper: &Mapper, x: f64) -> f64 {
        mapper.keyframe().unwrap().world_from_keyframe.transform_pose(&sideways(x)).translation.x
    }

    #[test]
    fn a_loop_moves_the_map_and_leaves_odometry_and_its_unit_unchanged() {
        let mut mapper = mapper();
        let by = Sim3::new(sideways(0.5), 1.2);
        // A newer keyframe that was left again is stretched more.
        let newer = Sim3::new(sideways(0.5), 1.5);
        let scene = Scene::new(3);
        mapper.map.keyframes.push(scene.keyframe(2, sideways(2.0), 1.0));
        let moves = vec![(0, Sim3::identity()), (1, by), (2, newer)];
        let closure = Closure { epoch: 0, moves, join: None };
        let before = mapper.map.revision;
        let outcome = mapper.close_loop(&closure, &mut window());
        assert!(outcome.graph_changed && outcome.keyframe_changed);
        assert_eq!(mapper.map.revision, before + 1);
        let active = mapper.keyframe().unwrap();
        assert_eq!(active.map_revision, before + 1);
        assert!((active.map_from_keyframe.rigid.translation.x - 1.7).abs() < 1e-12);
        assert!((active.map_from_keyframe.scale - 1.2).abs() < 1e-12);
        // The camera does not move, and the keyframe's unit is as long as before.
        assert!((in_world(&mapper, 0.1) - 1.1).abs() < 1e-12);
        assert!((in_world(&mapper, 0.4) - 1.4).abs() < 1e-12);
        assert_eq!(mapper.map.keyframes[0].map_from_keyframe, Sim3::identity());
    }

    #[test]
    fn a_loop_in_an_inactive_epoch_moves_only_that_epoch() {
        let mut mapper = mapper();
        let scene = Scene::new(3);
        for (id, epoch) in [(2, 1), (3, 0), (4, 1)] {
            let keyframe = scene.keyframe(id, sideways(id as f64), 1.0);
            mapper.map.keyframes.push(Keyframe { epoch, ..keyframe });
        }
        mapper.active = Some(Active::new(4));
        mapper.left_worlds.insert(0, Sim3::identity());
        let by = Sim3::new(SE3::identity(), 1.2);
        let moves = vec![(0, Sim3::identity()), (1, by)];
        let world = mapper.world_from_map;
        mapper.close_loop(&Closure { epoch: 0, moves, join: None }, &mut window());
        let units = mapper.map.keyframes.iter().map(|of| of.map_from_keyframe.scale);
        assert_eq!(units.collect::<Vec<_>>(), [1.0, 1.2, 1.0, 1.2, 1.0]);
        assert_eq!(mapper.world_from_map, world);
        // A keyframe's unit is as long in odometry as before.
        let left = mapper.left_worlds[&0].scale * mapper.map.keyframes[3].map_from_keyframe.scale;
        assert!((left - 1.0).abs() < 1e-12, "{left}");
    }

    #[test]
    fn a_keyframe_that_changes_its_epoch_publishes_its_image_again() {
        for of_active in [0, 1] {
            let mut mapper = mapper();
            mapper.map.keyframes[1].epoch = of_active;
            let join = EpochJoin::exact(1, 0, Sim3::identity());
            let closure = Closure { epoch: 0, moves: Vec::new(), join: Some(join) };
            let outcome = mapper.close_loop(&closure, &mut window());
            assert_eq!(mapper.keyframe().unwrap().epoch, 0);
            assert_eq!(outcome.needs_image(), of_active == 1, "its epoch was {of_active}");
        }
    }

    #[test]
    fn an_epoch_that_is_resumed_has_the_unit_of_odometry_on_whichever_keyframe_the_camera_is_found()
    {
        for found_on in 0..2 {
            let mut mapper = mapper();
            let other = mapper.map.keyframes[0].clone();
            mapper.map.keyframes.push(Keyframe { keyframe_id: 2, epoch: 1, ..other });
            // An estimate changes the unit of one of the two after odometry has used it.
            let map_from_keyframe = Sim3::new(SE3::identity(), 1.2);
            let keyframes = vec![KeyframeCorrection::of_pose(0, map_from_keyframe)];
            mapper.apply(&Correction { keyframes, ..Correction::default() }).unwrap();
            mapper.restore_keyframe(2, &SE3::identity());
            mapper.restore_keyframe(found_on, &SE3::identity());
            assert_eq!(mapper.world_from_map.scale, 1.0, "found on {found_on}");
        }
    }

    #[test]
    fn the_search_shares_descriptions_with_the_finder_and_skips_the_keyframes_of_an_earlier_mapper()
    {
        let scene = Scene::new(3);
        let loops = LoopParams { num_candidates: 3, ..LoopParams::default() };
        let params = MapperParams { loops, ..MapperParams::default() };
        let mut mapper = Mapper::new(CAMERA, params).unwrap();
        let places = (0..).zip([0.0, 0.1, 0.2]);
        let keyframes = places.map(|(id, x)| scene.keyframe(id, sideways(x), 1.0)).collect();
        mapper.resume(Map { keyframes, active: Some(2), free_epoch: 1, ..Map::default() });
        let users = |mapper: &Mapper| -> Vec<usize> {
            let held = mapper.map.keyframes.iter();
            held.map(|of| of.description.as_ref().map_or(0, Arc::strong_count)).collect()
        };
        assert_eq!(users(&mapper), [1, 1, 1]);
        mapper.depth.is_unit_open = false;
        let (mut window, _) = mapper.take_window().unwrap();
        assert_eq!(users(&mapper), [2, 2, 2], "offered");
        assert!(!window.begin_search(&mapper.map, true), "they are entered and not searched");
        assert_eq!(users(&mapper), [1, 1, 1]);
    }

    #[test]
    fn loops_are_stored_in_the_checkpoint_and_restored_from_it() {
        let mut mapper = mapper();
        let link = Link { i: 1, j: 0, j_from_i: Sim3::identity(), covariance: Matrix7::identity() };
        let loops = Arc::new(LoopRecord { links: vec![link], ..LoopRecord::default() });
        mapper.map.loops = loops;
        mapper.resume_loops();
        let window = mapper.window.take().unwrap();
        mapper.map.loops = Arc::default();
        mapper.return_window(window);
        let checkpoint = mapper.checkpoint().unwrap();
        assert_eq!(checkpoint.loops.links, [link]);
        let mut other = Mapper::new(CAMERA, MapperParams::default()).unwrap();
        other.resume(checkpoint.merged_over(Map::default()));
        assert_eq!(other.window.as_ref().unwrap().loops.record().links, [link]);
    }

    #[test]
    fn a_joined_epoch_gets_the_older_number_and_odometry_does_not_move() {
        let mut mapper = mapper();
        mapper.map.keyframes[1].epoch = 4;
        let into_from_epoch = Sim3::new(sideways(-3.0), 0.5);
        let join = Some(EpochJoin::exact(4, 0, into_from_epoch));
        let outcome =
            mapper.close_loop(&Closure { epoch: 4, moves: Vec::new(), join }, &mut window());
        assert!(outcome.graph_changed && outcome.keyframe_changed);
        let active = mapper.keyframe().unwrap();
        assert_eq!((active.epoch, active.map_from_keyframe.scale), (0, 0.5));
        assert!((in_world(&mapper, 0.1) - 1.1).abs() < 1e-12);
        assert!((in_world(&mapper, 0.4) - 1.4).abs() < 1e-12);
    }

    #[test]
    fn an_invalid_similarity_leaves_the_map_unchanged() {
        let mut mapper = mapper();
        let broken = Sim3 { scale: f64::NAN, ..Sim3::identity() };
        let closure = Closure { epoch: 0, moves: vec![(0, broken)], join: None };
        assert_eq!(mapper.close_loop(&closure, &mut window()), StepOutcome::default());
        assert_eq!(mapper.map.revision, 0);
    }
}
