//! What a loop does to the map that goes on meanwhile.

use crate::slam::keyframe::Keyframe;
use crate::slam::loops::Closure;
use crate::slam::map::{Correction, KeyframeCorrection, LogPlane};
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::window::Window;

impl Mapper {
    /// The keyframes to be given back with [`Mapper::end_adjustment`] after [`Window::optimise`] has looked for places
    /// that one of them shows, where no more frames come; `None` where all have been looked for.
    pub fn begin_last_search(&mut self) -> Option<Box<Window>> {
        let mut window = self.window.take()?;
        let is_begun = window.begin_search(&self.map, true);
        if is_begun {
            return Some(window);
        }
        self.window = Some(window);
        None
    }

    /// Moves the map as a loop has it; odometry stays where it is and keeps its unit.
    pub(super) fn close_loop(&mut self, closure: &Closure, window: &mut Window) -> StepOutcome {
        let epoch = self.keyframe().map(|keyframe| keyframe.epoch);
        let unit = closure.moves.last().map(|(_, by)| by.scale).filter(|_| closure.join.is_none());
        let moved = |keyframe: &Keyframe| {
            let by = closure.of(keyframe.keyframe_id)?;
            Some(KeyframeCorrection {
                keyframe_id: keyframe.keyframe_id,
                map_from_keyframe: *by * keyframe.map_from_keyframe,
                depth: LogPlane::default(),
                modes: None,
                place: Some(keyframe.place_covariance.transported(by)),
            })
        };
        let of_epoch = self.map.keyframes.iter().filter(|keyframe| Some(keyframe.epoch) == epoch);
        let keyframes = match closure.join {
            Some(_) => Vec::new(),
            None => of_epoch.filter_map(moved).collect(),
        };
        let joins = closure.join.into_iter().collect();
        match self.apply(&Correction { keyframes, joins, unit }) {
            Ok(outcome) => {
                window.follow(closure);
                outcome
            }
            // A number is broken: the map stays as it is.
            Err(_) => StepOutcome::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::map::EpochJoin;
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::phase::Active;
    use crate::slam::test_scene::{CAMERA, Scene};
    use crate::slam::window::params::WindowParams;

    fn sideways(x: f64) -> SE3 {
        SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() }
    }

    /// A camera beside the second of two keyframes, that the map has at 1.
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

    /// Where odometry has a camera beside the active keyframe.
    fn in_world(mapper: &Mapper, x: f64) -> f64 {
        mapper.keyframe().unwrap().world_from_keyframe.place(&sideways(x)).translation.x
    }

    #[test]
    fn a_loop_moves_the_map_and_leaves_odometry_and_its_unit() {
        let mut mapper = mapper();
        let by = Sim3::new(sideways(0.5), 1.2);
        let closure = Closure { moves: vec![(0, Sim3::identity()), (1, by)], join: None };
        let before = mapper.map.revision;
        let outcome = mapper.close_loop(&closure, &mut window());
        assert!(outcome.graph_changed && outcome.keyframe_changed);
        assert_eq!(mapper.map.revision, before + 1);
        let active = mapper.keyframe().unwrap();
        assert_eq!(active.map_revision, before + 1);
        assert!((active.map_from_keyframe.rigid.translation.x - 1.7).abs() < 1e-12);
        assert!((active.map_from_keyframe.scale - 1.2).abs() < 1e-12);
        // The camera stands still, and a way of the keyframe's unit is as long as before.
        assert!((in_world(&mapper, 0.1) - 1.1).abs() < 1e-12);
        assert!((in_world(&mapper, 0.4) - 1.4).abs() < 1e-12);
        assert_eq!(mapper.map.keyframes[0].map_from_keyframe, Sim3::identity());
    }

    #[test]
    fn an_epoch_that_is_joined_gets_the_older_number_and_odometry_stands_still() {
        let mut mapper = mapper();
        mapper.map.keyframes[1].epoch = 4;
        let into_from_epoch = Sim3::new(sideways(-3.0), 0.5);
        let join = Some(EpochJoin { epoch: 4, into: 0, into_from_epoch });
        let outcome = mapper.close_loop(&Closure { moves: Vec::new(), join }, &mut window());
        assert!(outcome.graph_changed && outcome.keyframe_changed);
        let active = mapper.keyframe().unwrap();
        assert_eq!((active.epoch, active.map_from_keyframe.scale), (0, 0.5));
        assert!((in_world(&mapper, 0.1) - 1.1).abs() < 1e-12);
        assert!((in_world(&mapper, 0.4) - 1.4).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_similarity_leaves_the_map_as_it_is() {
        let mut mapper = mapper();
        let broken = Sim3 { scale: f64::NAN, ..Sim3::identity() };
        let closure = Closure { moves: vec![(0, broken)], join: None };
        assert_eq!(mapper.close_loop(&closure, &mut window()), StepOutcome::default());
        assert_eq!(mapper.map.revision, 0);
    }
}
