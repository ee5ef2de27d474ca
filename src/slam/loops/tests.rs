//! Loops of rendered rooms: true ones are closed, others are not.

use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Twist7;
use crate::slam::graph::constraint::tests::{DepthError, USUAL, keyframe};
use crate::slam::keyframe::MapState;
use crate::slam::keyframe_pose_covariance::{KeyframePoseCovariance, KeyframePoseMatrix};
use crate::slam::loops::chain::Chain;
use crate::slam::map::Correction;
use crate::slam::places::Describer;
use crate::slam::test_scene::{Random, Scene};
use nalgebra::Vector6;

/// Length of the keyframes' units, metres.
const UNIT: f64 = 2.5;

/// The pose of a camera that is rotated by so many degrees about the vertical.
fn turned(at: [f64; 3], degrees: f64) -> SE3 {
    let mut pose = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, degrees.to_radians(), 0.0));
    pose.translation = at.into();
    pose
}

/// A camera that turns full circle in twelve steps and then repeats its first views: true poses.
fn round() -> Vec<SE3> {
    let at = |k: usize| {
        let wander = 0.05 * k as f64;
        turned([0.3 * wander.sin(), 0.1 * (2.0 * wander).sin(), 0.2 * wander], 30.0 * k as f64)
    };
    (0..15).map(at).collect()
}

/// Variance of a keyframe's place in the map.
const IN_MAP: f64 = 0.2;

/// A map of keyframes with the drift of a chain, in which each was estimated against the one before it.
struct Course {
    map: Map,
    loops: Loops,
}

impl Course {
    /// From images and true poses in the map's unit, metres. Each step errs by `drift` standard deviations of the
    /// reported ones: `claimed` of translation, metres, of rotation and of ln s.
    fn new(views: Vec<(Keyframe, SE3)>, claimed: f64, drift: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let mut map = Map::default();
        let params = LoopParams { num_candidates: 3, min_features: 12.0, drift_inflation: 1.0 };
        let mut loops = Loops::new(views[0].0.intrinsics, params);
        let mut error = Sim3::identity();
        for (id, (image, place)) in (0u64..).zip(views) {
            let at = place.translation;
            let variance = if id == 0 { 0.0 } else { claimed * claimed };
            // Rotation errors of a step are about the keyframe; as left increments of the map, about its origin.
            let about = SE3 { translation: at, ..SE3::identity() }.adjoint();
            let mut covariance = KeyframePoseMatrix::identity() * variance;
            let of_pose = about * about.transpose() * variance;
            covariance.fixed_view_mut::<6, 6>(0, 0).copy_from(&of_pose);
            if id > 0 {
                let step = Twist7::from_fn(|_, _| drift * claimed * random.normal());
                let about = Sim3::new(SE3 { translation: at, ..SE3::identity() }, 1.0);
                error = error * about * Sim3::exp(&step) * about.inverse();
                loops.note_estimate(id, &[id - 1], &[]);
            }
            let map_from_keyframe = error * Sim3::new(place, image.map_from_keyframe.scale);
            if id > 0 {
                let relative = KeyframePoseCovariance::bounded(&covariance);
                loops.note_covariance(id, &map_from_keyframe, &relative);
            }
            // Not used for links, which have covariances of their own.
            let in_map = KeyframePoseMatrix::identity() * if id == 0 { 0.0 } else { IN_MAP };
            let place_covariance = KeyframePoseCovariance::bounded(&in_map);
            let keyframe =
                Keyframe { keyframe_id: id, map_from_keyframe, place_covariance, ..image };
            let Intrinsics { width, height, .. } = keyframe.intrinsics;
            let description = Describer::default().describe(&keyframe.image, width, height);
            map.keyframes.push(Keyframe { description: description.map(Arc::new), ..keyframe });
            loops.offer(&map.keyframes);
        }
        Self { map, loops }
    }

    fn of(scene: &Scene, places: &[SE3], claimed: f64, drift: f64, seed: u64) -> Self {
        Self::new(views(scene, places), claimed, drift, seed)
    }

    /// Searches all keyframes and applies the results.
    fn run(&mut self) -> Vec<SearchReport> {
        let mut reports = Vec::new();
        loop {
            let known = self.map.keyframes.iter().filter(|k| k.has_depth());
            let known: Vec<u64> = known.map(|k| k.keyframe_id).collect();
            self.loops.plan(&known, known.len());
            if !self.loops.begin(&self.map) {
                return reports;
            }
            self.loops.run();
            reports.extend(self.loops.take_report());
            if let Some(closure) = self.loops.take_closure() {
                for keyframe in &mut self.map.keyframes {
                    let Some(by) = closure.of(keyframe.keyframe_id, keyframe.epoch) else {
                        continue;
                    };
                    keyframe.map_from_keyframe = *by * keyframe.map_from_keyframe;
                }
                let joins = closure.join.into_iter().collect();
                self.map.correct(&Correction { joins, ..Correction::default() }, 0).unwrap();
            }
        }
    }

    /// Error of a keyframe's position relative to the first one, metres.
    fn error(&self, index: usize, places: &[SE3]) -> f64 {
        let found = self.map.keyframes[0].map_from_keyframe.inverse()
            * self.map.keyframes[index].map_from_keyframe;
        let truth = places[0].inverse() * places[index];
        (found.rigid.translation * UNIT - truth.translation).norm()
    }
}

fn views(scene: &Scene, places: &[SE3]) -> Vec<(Keyframe, SE3)> {
    let view = |(seed, place): (u64, &SE3)| (keyframe(scene, place, UNIT, &USUAL, seed), *place);
    (0u64..).zip(places).map(view).collect()
}

fn count(reports: &[SearchReport], is: impl Fn(&SearchOutcome) -> bool) -> usize {
    reports.iter().filter(|report| is(&report.outcome)).count()
}

fn moves_nothing(reports: &[SearchReport]) -> bool {
    count(reports, |outcome| {
        matches!(
            outcome,
            SearchOutcome::Closed | SearchOutcome::AlreadyConsistent | SearchOutcome::Joined
        )
    }) == 0
}

#[test]
fn a_loop_removes_the_drift_from_the_map() {
    let places = round();
    for seed in 0..3 {
        let mut course = Course::of(&Scene::new(seed), &places, 0.02, 1.0, seed);
        let before = course.error(13, &places);
        let reports = course.run();
        assert!(count(&reports, |outcome| *outcome == SearchOutcome::Closed) > 0, "{reports:?}");
        let after = course.error(13, &places);
        assert!(after < 0.05 && after < 0.5 * before, "{seed}: {before} {after} {reports:?}");
        // Far from both ends at most half of it is gone, and nothing is torn.
        for pair in course.map.keyframes.windows(2) {
            let step = pair[0].map_from_keyframe.inverse() * pair[1].map_from_keyframe;
            assert!((step.scale - 1.0).abs() < 0.1 && step.rigid.translation.norm() < 0.2);
        }
    }
}

#[test]
fn a_map_that_agrees_with_its_loop_stays_unchanged() {
    let places = round();
    let mut course = Course::of(&Scene::new(1), &places, 0.02, 0.0, 0);
    let before: Vec<Sim3> = course.map.keyframes.iter().map(|k| k.map_from_keyframe).collect();
    let reports = course.run();
    assert!(
        count(&reports, |outcome| *outcome == SearchOutcome::AlreadyConsistent) > 0,
        "{reports:?}"
    );
    assert_eq!(count(&reports, |outcome| *outcome == SearchOutcome::Closed), 0, "{reports:?}");
    let after: Vec<Sim3> = course.map.keyframes.iter().map(|k| k.map_from_keyframe).collect();
    assert_eq!(before, after);
}

#[test]
fn an_identical_room_is_a_different_one_if_the_map_cannot_have_drifted_so_far() {
    // The same images; in the chain the last ones are six metres to the side.
    let mut views = views(&Scene::new(2), &round());
    views.iter_mut().skip(9).for_each(|(_, place)| place.translation.x += 6.0);
    let mut course = Course::new(views, 0.02, 1.0, 4);
    let reports = course.run();
    assert!(moves_nothing(&reports), "{reports:?}");
    assert!(
        count(&reports, |outcome| matches!(outcome, SearchOutcome::AgainstDrift(_))) > 0,
        "{reports:?}"
    );
}

#[test]
fn a_view_that_its_neighbours_contradict_is_rejected() {
    // One image of the first room, in the middle of another; the map may have drifted by anything.
    let places = round();
    let mut views = views(&Scene::new(3), &places);
    let others = self::views(&Scene::new(8), &places);
    for (index, other) in others.into_iter().enumerate().skip(9) {
        if index != 13 {
            views[index] = other;
        }
    }
    let mut course = Course::new(views, 0.05, 0.3, 5);
    let reports = course.run();
    assert!(moves_nothing(&reports), "{reports:?}");
    assert!(count(&reports, |outcome| *outcome == SearchOutcome::Unconfirmed) > 0, "{reports:?}");
}

#[test]
fn a_repeating_corridor_and_a_blank_wall_close_nothing() {
    let along: Vec<SE3> = (0..14).map(|k| turned([0.0, 0.0, 0.6 * f64::from(k)], 0.0)).collect();
    for claimed in [0.02, 0.1] {
        let corridor = Scene::corridor(2, 1.2);
        let mut course = Course::of(&corridor, &along, claimed, 1.0, 6);
        let reports = course.run();
        assert!(!reports.is_empty() && moves_nothing(&reports), "{reports:?}");
    }
    let wall = Scene::new(1).with_contrast(0.15);
    let beside: Vec<SE3> = (0..14).map(|k| turned([0.4 * f64::from(k), 0.0, 0.0], 0.0)).collect();
    let mut blank = views(&wall, &vec![turned([0.0; 3], 0.0); 14]);
    blank.iter_mut().zip(&beside).for_each(|((_, place), beside)| *place = *beside);
    let reports = Course::new(blank, 0.02, 1.0, 7).run();
    assert!(moves_nothing(&reports), "{reports:?}");
}

#[test]
fn two_epochs_that_see_the_same_become_one() {
    let places: Vec<SE3> = (0..5).map(|k| turned([0.15 * f64::from(k), 0.0, 0.0], 0.0)).collect();
    let scene = Scene::new(3);
    let exact = DepthError { noise: 0.0, modes: 0.0 };
    // The second epoch has another origin, and a unit of 2.5 m.
    let origin = turned([0.3, -0.1, 0.2], 20.0);
    let mut views = views(&scene, &places);
    for (seed, place) in (50u64..).zip(&places) {
        let view = keyframe(&scene, place, UNIT, &exact, seed);
        let mut moved = origin * *place;
        moved.translation /= 2.5;
        let at = Sim3::new(moved, UNIT / 2.5);
        views.push((Keyframe { epoch: 1, map_from_keyframe: at, ..view }, moved));
    }
    let far = views.split_off(5);
    // Views with nothing in common, so that the epochs are not adjacent in the list.
    let between = self::views(&Scene::new(9), &round()[4..12]);
    views.extend(between);
    views.extend(far);
    let mut course = Course::new(views, 0.01, 0.0, 8);
    let into_epoch = Sim3::new(origin, 2.5);
    let reports = course.run();
    assert_eq!(count(&reports, |outcome| *outcome == SearchOutcome::Joined), 1, "{reports:?}");
    assert!(course.map.keyframes.iter().all(|keyframe| keyframe.epoch == 0));
    let last = &course.map.keyframes[course.map.keyframes.len() - 1].map_from_keyframe;
    let truth = places[4];
    assert!((last.rigid.translation - truth.translation).norm() < 0.03, "{last:?} {into_epoch:?}");
    assert!((last.scale / UNIT).ln().abs() < 0.02, "{last:?}");
    // Its own, those of both keyframes that the epochs are joined by, of which the first is exact, and the link's.
    let of_unit = course.map.keyframes.last().unwrap().place_covariance.matrix()[(6, 6)];
    let link = &course.loops.record().links[0];
    let terms = if link.i.min(link.j) == 0 { 2.0 } else { 3.0 };
    let expected = terms * IN_MAP + link.covariance[(6, 6)];
    assert!((of_unit - expected).abs() < 1e-9, "{of_unit} {expected}");
}

#[test]
fn a_search_that_continues_from_stored_loops_has_the_same_pose_graph() {
    let places = round();
    let mut course = Course::of(&Scene::new(0), &places, 0.02, 1.0, 0);
    course.run();
    let kept = course.loops.record().clone();
    assert!(!kept.links.is_empty() && kept.held_by.len() == 14, "{kept:?}");
    let keyframes = &course.map.keyframes;
    let nodes: Vec<Keyframe> = keyframes.iter().map(Keyframe::without_depth).collect();
    let predicted = |loops: &Loops| {
        Chain::new(loops, &nodes, 0).unwrap().into_predictions().unwrap().of(0, 13).unwrap()
    };
    let fresh = || Loops::new(course.loops.intrinsics, course.loops.params.clone());
    let mut resumed = fresh();
    resumed.resume_from(kept.clone(), keyframes);
    assert_eq!(predicted(&resumed), predicted(&course.loops));
    assert_ne!(predicted(&resumed), predicted(&fresh()));
    assert_eq!(resumed.record(), &kept);
    // Searched keyframes are not searched again, but can be found.
    let known: Vec<u64> = (0..15).collect();
    resumed.offer(keyframes);
    resumed.plan(&known, known.len());
    assert!(!resumed.begin(&course.map));
    // Keyframes without a record of what they were estimated with are not searched.
    let mut lost = fresh();
    lost.resume_from(Arc::default(), keyframes);
    assert_eq!(lost.record().searched_to, Some(14));
}

#[test]
fn a_closure_that_was_not_applied_is_repeated() {
    let places = round();
    let mut course = Course::of(&Scene::new(0), &places, 0.02, 1.0, 0);
    let known: Vec<u64> = (0..15).collect();
    let mut closed = None;
    while closed.is_none() {
        course.loops.plan(&known, known.len());
        assert!(course.loops.begin(&course.map));
        course.loops.run();
        closed = course.loops.closure.clone();
    }
    course.loops.repeat_closure();
    assert_eq!(course.loops.take_closure(), None);
    assert!(course.loops.begin(&course.map));
    course.loops.run();
    assert_eq!(course.loops.take_closure(), closed);
    // The map was rejected meanwhile.
    course.loops.closure = closed;
    course.loops.repeat_closure();
    course.map.keyframes.iter_mut().for_each(|of| of.map_state = MapState::Rejected);
    assert!(course.loops.begin(&course.map));
    course.loops.run();
    assert_eq!(course.loops.take_closure(), None);
    assert_eq!(course.loops.record().links, []);
}

#[test]
fn a_loop_is_confirmed_where_the_keyframes_next_to_it_lost_their_depth() {
    // Each view twice; the second is thinned.
    let places: Vec<SE3> = round().into_iter().flat_map(|place| [place, place]).collect();
    for seed in 0..2 {
        let mut course = Course::of(&Scene::new(seed), &places, 0.02, 1.0, seed);
        course.map.keyframes.iter_mut().skip(1).step_by(2).for_each(Keyframe::forget_depth);
        let before = course.error(26, &places);
        let reports = course.run();
        assert!(count(&reports, |outcome| *outcome == SearchOutcome::Closed) > 0, "{reports:?}");
        let after = course.error(26, &places);
        assert!(after < 0.5 * before, "{seed}: {before} {after} {reports:?}");
    }
}

#[test]
fn links_are_as_uncertain_as_their_estimates() {
    const CLAIMED: f64 = 0.02;
    let mut course = Course::of(&Scene::new(0), &round()[..3], CLAIMED, 0.0, 0);
    let nodes: Vec<Keyframe> = course.map.keyframes.iter().map(Keyframe::without_depth).collect();
    let of_unit = |loops: &Loops| {
        let mut predictions = Chain::new(loops, &nodes, 0).unwrap().into_predictions().unwrap();
        [1, 2].map(|to| predictions.of(0, to).unwrap().1[(6, 6)].sqrt())
    };
    let near = |found: [f64; 2], one: f64| {
        let expected = [one, one * 2.0_f64.sqrt()];
        found.iter().zip(expected).all(|(found, expected)| (found / expected - 1.0).abs() < 0.01)
    };
    let found = of_unit(&course.loops);
    assert!(near(found, CLAIMED), "{found:?}");
    // Where the estimate gave no covariance, as those of the tracker alone.
    Arc::make_mut(&mut course.loops.record).relative_covariances.clear();
    let found = of_unit(&course.loops);
    assert!(near(found, 0.05), "{found:?}");
}
