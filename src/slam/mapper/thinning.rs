//! Thinning: a keyframe whose points several others show at least as well drops its image and depth, so that a map of
//! rooms that are seen again and again grows only with the rooms.
//!
//! It keeps its pose, which moves with that of a neighbour: frames tracked on it stay placed in the map.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use crate::slam::depth::matching::is_inside;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::{Correction, KeyframeCorrection, Map};
use crate::slam::mapper::Mapper;
use crate::slam::mapper::reuse::ReuseParams;

/// Newest keyframes that are left alone: recovery tries twenty, and estimates free the last seven.
const NUM_NEWEST: usize = 24;
/// Keyframes that are examined with each new one: more than are added, in about a millisecond.
const NUM_EXAMINED: usize = 4;
/// Other keyframes that must show a point: as many as an estimate needs to hold one in place, and one to spare.
const NUM_OTHERS: usize = 3;
/// Share of the points that this many others must show.
const MIN_SHARE: f64 = 0.9;
/// Points that are checked: they determine the share to 0.02.
const MAX_CHECKED_POINTS: usize = 256;
/// Another keyframe shows a point as well if it is at most this many times as far from it.
const MAX_DISTANCE_RATIO: f64 = 1.25;
/// Least cosine of the angle between their directions to it, 20°: beyond, alignment meets different texture.
const MIN_COSINE: f64 = 0.94;
/// Keyframes further away than this many mean depths see common points from other directions.
const REACH: f64 = 0.5;

/// Keyframes that have lost their depth, and the keyframes that they move with.
#[derive(Debug, Default)]
pub(super) struct Thinning {
    /// For each keyframe without depth, the one that it moves with.
    attached: BTreeMap<u64, u64>,
    /// The keyframe examined last: the next is the one before.
    examined: Option<u64>,
}

impl Thinning {
    /// Extends a correction by the keyframes that move with those in it, from their current poses in the map: another
    /// correction may have moved the two independently.
    pub fn follow(&self, map: &Map, correction: &Correction) -> Correction {
        let mut extended = correction.clone();
        let places: BTreeMap<u64, Sim3> =
            correction.keyframes.iter().map(|k| (k.keyframe_id, k.map_from_keyframe)).collect();
        // They follow nothing else: two leaders would move them twice.
        extended.keyframes.retain(|k| !self.attached.contains_key(&k.keyframe_id));
        extended.keyframes.extend(self.attached.iter().filter_map(|(&id, to)| {
            // Most leaders stay, and looking up a keyframe costs more.
            let place = *places.get(to)?;
            let (was, keyframe) = (map.get(*to)?, map.get(id)?);
            let by = place * was.map_from_keyframe.inverse();
            Some(KeyframeCorrection::of_pose(id, by * keyframe.map_from_keyframe))
        }));
        extended
    }

    /// Attaches a keyframe to another, along with the keyframes attached to it.
    fn attach(&mut self, keyframe_id: u64, to: u64) {
        self.attached.values_mut().filter(|of| **of == keyframe_id).for_each(|of| *of = to);
        self.attached.insert(keyframe_id, to);
    }

    /// Indices of the next keyframes to be examined, newest first, cyclically.
    fn next(&mut self, map: &Map, may_go: impl Fn(&Keyframe) -> bool) -> Vec<usize> {
        let eligible: Vec<usize> =
            (0..map.keyframes.len()).rev().filter(|&k| may_go(&map.keyframes[k])).collect();
        let id = |place: usize| map.keyframes[place].keyframe_id;
        let start = eligible.partition_point(|&k| self.examined.is_some_and(|of| id(k) >= of));
        let (before, after) = eligible.split_at(start);
        let next: Vec<usize> = after.iter().chain(before).copied().take(NUM_EXAMINED).collect();
        self.examined = next.last().map(|&last| id(last)).or(self.examined);
        next
    }
}

impl Mapper {
    /// Drops image and depth of keyframes of the active epoch that others show as well, where there are more than
    /// allowed. Examines a bounded number with each new keyframe. Keyframes of a measured loop stay: another loop is
    /// confirmed next to it.
    pub(super) fn thin(&mut self) {
        let Some(active) = self.keyframe() else { return };
        let (active_id, epoch) = (active.keyframe_id, active.epoch);
        let is_held = |of: &Keyframe| of.epoch == epoch && of.has_depth();
        let held = self.map.keyframes.iter().filter(|of| is_held(of));
        let mut ids: Vec<u64> = held.map(|of| of.keyframe_id).collect();
        if ids.len() <= self.params.redundant_above.max(NUM_NEWEST) {
            return;
        }
        ids.sort_unstable();
        let oldest_of_newest = ids[ids.len() - NUM_NEWEST];
        let kept = self.map.loops.keyframe_ids();
        let may_go = |of: &Keyframe| {
            is_held(of)
                && of.map_state == MapState::Established
                && of.keyframe_id < oldest_of_newest
                && of.keyframe_id != active_id
                && !kept.contains(&of.keyframe_id)
        };
        let mut excess = ids.len() - self.params.redundant_above;
        for index in self.thinning.next(&self.map, may_go) {
            if excess == 0 {
                break;
            }
            let Some(to) = shown_by(&self.map, index, &self.params.reuse) else { continue };
            let keyframe = &mut self.map.keyframes[index];
            keyframe.forget_depth();
            self.thinning.attach(keyframe.keyframe_id, to);
            excess -= 1;
        }
    }
}

/// The nearest keyframe that can be reused in place of one whose points enough others show as well; `None` where too
/// few show them, or no other is near enough.
fn shown_by(map: &Map, index: usize, reuse: &ReuseParams) -> Option<u64> {
    let keyframe = &map.keyframes[index];
    let place = keyframe.map_from_keyframe;
    let forward = place.rigid.rotation * Vector3::z();
    let distance =
        |of: &Keyframe| (of.map_from_keyframe.rigid.translation - place.rigid.translation).norm();
    let is_near = |of: &&Keyframe| {
        of.keyframe_id != keyframe.keyframe_id
            && of.epoch == keyframe.epoch
            && of.is_usable()
            && distance(of) < REACH * place.scale
            && (of.map_from_keyframe.rigid.rotation * Vector3::z()).dot(&forward) > 0.0
    };
    let others: Vec<&Keyframe> = map.keyframes.iter().filter(is_near).collect();
    if others.len() < NUM_OTHERS {
        return None;
    }
    let views: Vec<Sim3> = others.iter().map(|of| of.map_from_keyframe.inverse() * place).collect();
    let stride = keyframe.points.len().div_ceil(MAX_CHECKED_POINTS).max(1);
    let (mut shown, mut all) = (0u32, 0u32);
    for point in keyframe.points.iter().step_by(stride) {
        let ray = keyframe.intrinsics.ray(f64::from(point.u), f64::from(point.v));
        let at = ray / f64::from(point.inverse_depth);
        let num_showing =
            others.iter().zip(&views).filter(|(of, view)| shows(of, view, &at)).count();
        shown += u32::from(num_showing >= NUM_OTHERS);
        all += 1;
    }
    if f64::from(shown) < MIN_SHARE * f64::from(all) {
        return None;
    }
    // A camera that returns here must find another keyframe to be tracked on, measured by that one's unit and points as
    // reuse does: otherwise the path back is mapped anew, and drifts.
    let stands_in = |of: &Keyframe| {
        let at = of.map_from_keyframe.inverse_transform_pose(&place.rigid);
        reuse.distance.distance(at.translation.norm(), of.usage(&at)) < reuse.max_distance
    };
    let nearest = others.iter().filter(|of| stands_in(of)).min_by(|one, other| {
        distance(one).total_cmp(&distance(other)).then(one.keyframe_id.cmp(&other.keyframe_id))
    });
    nearest.map(|of| of.keyframe_id)
}

/// Whether a keyframe shows a point as well as another, in whose frame and unit the point is; `view` maps these into
/// the keyframe's. An occluder would have to fit between two rays at most 20° apart.
fn shows(keyframe: &Keyframe, view: &Sim3, at: &Vector3<f64>) -> bool {
    let seen = *view * *at;
    let from_other = seen - view.rigid.translation;
    let (distance, other) = (seen.norm(), from_other.norm());
    if seen.z <= 0.0
        || distance > MAX_DISTANCE_RATIO * other
        || seen.dot(&from_other) < MIN_COSINE * distance * other
    {
        return false;
    }
    let Intrinsics { fx, fy, cx, cy, width, height } = keyframe.intrinsics;
    let (u, v) = (fx * seen.x / seen.z + cx, fy * seen.y / seen.z + cy);
    is_inside(width, height, u as f32, v as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    use nalgebra::Vector6;

    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Matrix7;
    use crate::slam::keyframe::{DepthPoint, DistanceWeights};
    use crate::slam::loops::record::{Link, LoopRecord};
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::phase::Active;
    use crate::slam::test_scene::CAMERA;

    /// A keyframe at `x`, turned by `turn_rad` about the vertical, in front of a wall a unit away.
    fn keyframe(keyframe_id: u64, x: f64, turn_rad: f64) -> Keyframe {
        let rotation = SE3::exp(&[0.0, 0.0, 0.0, 0.0, turn_rad, 0.0].into()).rotation;
        let place = SE3 { rotation, translation: Vector3::new(x, 0.0, 0.0) };
        let point = |u: u16, v: u16| {
            let ray = CAMERA.ray(f64::from(u), f64::from(v));
            // The wall is z = 1 of the map.
            let inverse_depth = (rotation * ray).z as f32;
            DepthPoint { u, v, inverse_depth, variance: 1e-4, intensity: 100.0 }
        };
        let sides = (CAMERA.width as u16, CAMERA.height as u16);
        let rows = (8..sides.1 - 8).step_by(8);
        let points = rows.flat_map(|v| (8..sides.0 - 8).step_by(8).map(move |u| point(u, v)));
        let image = vec![100; CAMERA.width * CAMERA.height];
        let place = Sim3::new(place, 1.0);
        Keyframe { keyframe_id, ..Keyframe::at(place, CAMERA, points.collect(), image) }
    }

    /// A mapper whose camera has passed ten places in front of a wall `rounds` times.
    fn mapper(rounds: u64, redundant_above: usize) -> Mapper {
        let params = MapperParams { redundant_above, ..MapperParams::default() };
        let mut mapper = Mapper::new(CAMERA, params).unwrap();
        let ids = 0..10 * rounds;
        mapper.map.keyframes = ids.map(|k| keyframe(k, 0.2 * (k % 10) as f64, 0.0)).collect();
        mapper.active = Some(Active::new(mapper.map.keyframes.len() - 1));
        mapper
    }

    #[test]
    fn a_keyframe_is_redundant_where_three_others_show_its_points_as_well() {
        let near = |x: &[f64]| {
            let at = x.iter().enumerate().map(|(k, x)| keyframe(k as u64, *x, 0.0));
            Map { keyframes: at.collect(), ..Map::default() }
        };
        let found = shown_by(&near(&[0.0, 0.02, -0.01, 0.03]), 0, &ReuseParams::default());
        assert_eq!(found, Some(2));
        assert!(
            shown_by(&near(&[0.0, 0.02, -0.01]), 0, &ReuseParams::default()).is_none(),
            "two others"
        );
        assert!(
            shown_by(&near(&[0.0, 0.02, -0.01, 0.45]), 0, &ReuseParams::default()).is_none(),
            "one from aside"
        );
        let mut map = near(&[0.0, 0.02, -0.01, 0.03]);
        map.keyframes[3] = keyframe(3, 0.03, 0.4);
        assert!(shown_by(&map, 0, &ReuseParams::default()).is_none(), "one looks elsewhere");
        let mut map = near(&[0.0, 0.02, -0.01, 0.03]);
        // From further away the same place shows less detail.
        map.keyframes[3].map_from_keyframe.rigid.translation.z = -0.4;
        assert!(shown_by(&map, 0, &ReuseParams::default()).is_none(), "one from further away");
        let mut map = near(&[0.0, 0.02, -0.01, 0.03]);
        map.keyframes[1].epoch = 1;
        assert!(shown_by(&map, 0, &ReuseParams::default()).is_none(), "one of another epoch");
    }

    #[test]
    fn a_keyframe_keeps_its_depth_where_no_other_can_be_reused_instead() {
        let at = [0.0, 0.02, -0.01, 0.03].iter().enumerate();
        let keyframes = at.map(|(k, x)| keyframe(k as u64, *x, 0.0)).collect();
        let map = Map { keyframes, ..Map::default() };
        let stands_in = |max_distance: f64| {
            shown_by(&map, 0, &ReuseParams { max_distance, ..ReuseParams::default() })
        };
        // All its points are shown: only the distance, a hundredth of a mean depth, remains.
        let weight = DistanceWeights::default().translation;
        let nearest = (0.01 * weight).powi(2);
        assert_eq!(stands_in(1.01 * nearest + 1e-3), Some(2));
        assert!(stands_in(0.5 * nearest).is_none());
    }

    /// A keyframe behind the others has border points that they do not show: what it sees of their points counts.
    #[test]
    fn a_substitute_is_measured_in_its_own_unit_and_by_its_own_points() {
        const BEHIND: f64 = 0.04;
        let at = [0.0, 0.02, -0.01, 0.03].iter().enumerate();
        let keyframes = at.map(|(k, x)| keyframe(k as u64, *x, 0.0)).collect();
        let mut map = Map { keyframes, ..Map::default() };
        // Its unit is the distance of the wall from there.
        let translation = Vector3::new(0.0, 0.0, -BEHIND);
        map.keyframes[0].map_from_keyframe =
            Sim3::new(SE3 { translation, ..SE3::identity() }, 1.0 + BEHIND);
        let weight = DistanceWeights::default().translation;
        let nearest = (weight * 0.01f64.hypot(BEHIND)).powi(2);
        let stands_in = |max_distance: f64| {
            shown_by(&map, 0, &ReuseParams { max_distance, ..ReuseParams::default() })
        };
        assert_eq!(stands_in(1.01 * nearest), Some(2));
        assert!(stands_in(0.99 * nearest).is_none());
    }

    fn loop_between(i: u64, j: u64) -> Link {
        Link { i, j, j_from_i: Sim3::identity(), covariance: Matrix7::identity() }
    }

    #[test]
    fn repeated_rounds_keep_only_as_many_keyframes_as_the_places_need() {
        let mut mapper = mapper(12, 30);
        mapper.map.loops =
            Arc::new(LoopRecord { links: vec![loop_between(7, 12)], ..Default::default() });
        for _ in 0..200 {
            mapper.thin();
        }
        let held = mapper.map.num_with_depth();
        assert!((30..=60).contains(&held), "{held} of 120");
        let has_depth = |id: usize| mapper.map.keyframes[id].has_depth();
        assert!(has_depth(7) && has_depth(12), "keyframes with a loop");
        assert!(mapper.map.keyframes[120 - NUM_NEWEST..].iter().all(Keyframe::has_depth));
        assert_eq!(mapper.map.keyframes.len(), 120, "poses stay");
        // A map within the limit is left unchanged.
        let mut small = self::mapper(12, 120);
        small.thin();
        assert_eq!(small.map.num_with_depth(), 120);
    }

    #[test]
    fn a_keyframe_without_depth_moves_with_a_neighbour() {
        let mut mapper = mapper(12, 30);
        for _ in 0..200 {
            mapper.thin();
        }
        // A loop moves every keyframe differently.
        let by_its_own = |of: &Keyframe| {
            let by = Sim3::new(
                SE3::exp(&(Vector6::repeat(1e-3) * of.keyframe_id as f64)),
                1.0 + 1e-3 * of.keyframe_id as f64,
            );
            KeyframeCorrection::of_pose(of.keyframe_id, by * of.map_from_keyframe)
        };
        let keyframes = mapper.map.keyframes.iter().map(by_its_own).collect();
        mapper.apply(&Correction { keyframes, ..Correction::default() }).unwrap();
        // All that have depth are rotated, moved and scaled alike: the others must follow.
        let moved = Sim3::new(SE3::exp(&[0.3, -0.1, 0.2, 0.1, 0.4, -0.2].into()), 1.3);
        let held = mapper.map.keyframes.iter().filter(|of| of.has_depth());
        let keyframes = held
            .map(|of| KeyframeCorrection::of_pose(of.keyframe_id, moved * of.map_from_keyframe));
        let correction = Correction { keyframes: keyframes.collect(), ..Correction::default() };
        let before = mapper.map.clone();
        assert!(before.num_with_depth() < before.keyframes.len());
        mapper.apply(&correction).unwrap();
        for (was, is) in before.keyframes.iter().zip(&mapper.map.keyframes) {
            let expected = moved * was.map_from_keyframe;
            let error = (expected.inverse() * is.map_from_keyframe).log().norm();
            assert!(error < 1e-9, "keyframe {}: {error}", was.keyframe_id);
        }
    }

    /// The window treats it as a follower of the keyframe before it.
    #[test]
    fn a_keyframe_without_depth_does_not_follow_two_leaders() {
        let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
        mapper.map.keyframes = (0..3).map(|id| keyframe(id, 0.1 * id as f64, 0.0)).collect();
        mapper.active = Some(Active::new(2));
        mapper.thinning.attach(1, 2);
        let x = |mapper: &Mapper, id: usize| {
            mapper.map.keyframes[id].map_from_keyframe.rigid.translation.x
        };
        let by = Sim3::new(SE3::exp(&[0.01, 0.0, 0.0, 0.0, 0.0, 0.0].into()), 1.0);
        for moved in [&[0, 1][..], &[2]] {
            let of_place = |&id: &u64| {
                let of = mapper.map.get(id).unwrap();
                KeyframeCorrection::of_pose(id, by * of.map_from_keyframe)
            };
            let keyframes = moved.iter().map(of_place).collect();
            mapper.apply(&Correction { keyframes, ..Correction::default() }).unwrap();
        }
        assert!((x(&mapper, 1) - 0.11).abs() < 1e-9, "{}", x(&mapper, 1));
    }
}
