//! The candidates for a keyframe's points.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::DepthPoint;
use crate::slam::window::Window;
use crate::slam::window::params::WindowParams;
use crate::slam::window::selection::choose_spread;

/// Fewer mature points than this constrain neither a keyframe's pose nor a plane through its depth, which needs 30: the
/// points are then chosen from its depth.
const MIN_MATURE: usize = 40;

/// Points of the interval filter that were mature when their keyframe was left.
#[derive(Debug, Clone, PartialEq)]
pub struct MaturePoints {
    /// Their keyframe.
    pub keyframe_id: u64,
    /// Their depth, in the keyframe's unit, in the order in which their pixels were chosen.
    pub points: Vec<DepthPoint>,
}

/// The candidates for a keyframe's points.
#[derive(Debug, Clone)]
pub(super) struct Candidates {
    pub(super) keyframe_id: u64,
    /// Its depth.
    pub(super) depth: Vec<DepthPoint>,
    /// Its mature points, used where there are enough.
    pub(super) mature: Option<Vec<DepthPoint>>,
}

impl Candidates {
    /// Chooses the points to be estimated, in an order of which every prefix is spread over the image.
    pub(super) fn choose(
        &self,
        pixels: &[u8],
        camera: &Intrinsics,
        params: &WindowParams,
    ) -> Vec<DepthPoint> {
        let choose = |points: &[DepthPoint]| choose_spread(points, pixels, camera, params);
        let of_mature = self.mature.as_deref().map(choose);
        let are_enough = |chosen: &Vec<DepthPoint>| chosen.len() >= MIN_MATURE;
        of_mature.filter(are_enough).unwrap_or_else(|| choose(&self.depth))
    }
}

impl Window {
    /// Takes the mature points of keyframes that were left since the last call, for [`Window::update_from_map`]. A
    /// keyframe without a list, or with too few points to choose from in it, has its points from its depth.
    pub fn take_mature(&mut self, mature: &mut Vec<MaturePoints>) {
        self.mature.append(mature);
    }

    /// Removes the mature points last given for a keyframe.
    pub(super) fn mature_of(&mut self, keyframe_id: u64) -> Option<Vec<DepthPoint>> {
        let place = self.mature.iter().rposition(|of| of.keyframe_id == keyframe_id)?;
        Some(self.mature.remove(place).points)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::Keyframe;
    use crate::slam::map::Map;
    use crate::slam::test_scene::{CAMERA, Scene};
    use crate::slam::window::params::WindowParams;

    /// Two keyframes of a room with exact depth everywhere.
    fn map() -> Map {
        let scene = Scene::new(3);
        let keyframes = [0.0, 0.1].into_iter().enumerate().map(|(k, x)| {
            let place = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            let view = scene.render(&CAMERA, &place);
            let points = view.inverse_depth.pixels().iter().enumerate();
            let points = points.map(|(i, &inverse_depth)| DepthPoint {
                u: (i % CAMERA.width) as u16,
                v: (i / CAMERA.width) as u16,
                inverse_depth,
                variance: 1e-4,
                intensity: 0.0,
            });
            let pixels = view.noisy(1.0, k as u64);
            let keyframe = Keyframe::at(Sim3::new(place, 1.0), CAMERA, points.collect(), pixels);
            Keyframe { keyframe_id: k as u64, ..keyframe }
        });
        Map { keyframes: keyframes.collect(), ..Map::default() }
    }

    /// Pixels of the first keyframe's points after `mature` was given as the list of keyframe `keyframe_id`.
    fn chosen(map: &Map, mature: &[DepthPoint], keyframe_id: u64) -> Vec<(u16, u16)> {
        let mut window = Window::new(CAMERA, WindowParams::default());
        let mut given = vec![MaturePoints { keyframe_id, points: mature.to_vec() }];
        window.take_mature(&mut given);
        assert!(given.is_empty() && window.update_from_map(map, 1));
        window.optimise();
        assert!(window.mature.is_empty() && window.keyframes[0].is_host);
        window.keyframes[0].points.iter().map(|point| (point.u, point.v)).collect()
    }

    #[test]
    fn points_come_from_mature_ones_where_there_are_enough_and_from_depth_otherwise() {
        let map = map();
        let every = |step| map.keyframes[0].points.iter().step_by(step).copied();
        let mature: Vec<DepthPoint> = every(37).collect();
        let is_mature = |of: &(u16, u16)| mature.iter().any(|point| (point.u, point.v) == *of);
        let of_mature = chosen(&map, &mature, 0);
        assert!(of_mature.len() > 300 && of_mature.iter().all(is_mature), "{}", of_mature.len());
        let of_depth = chosen(&map, &mature, 1);
        assert!(of_depth.len() > 300 && !of_depth.iter().all(is_mature));
        // None, and one too few.
        for few in [&[][..], &mature[..MIN_MATURE - 1]] {
            assert_eq!(chosen(&map, few, 0), of_depth, "{}", few.len());
        }
    }
}
