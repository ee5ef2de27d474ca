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
