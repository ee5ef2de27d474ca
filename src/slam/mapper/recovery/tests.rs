//! Which poses are accepted after a loss, and how depth is restored.

use nalgebra::Vector6;

use super::*;
use crate::slam::frame::FrameView;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::map::{Correction, KeyframeCorrection, LogPlane};
use crate::slam::mapper::MapperParams;
use crate::slam::mapper::consistency::START_KEYFRAMES;
use crate::slam::mapper::phase::Active;
use crate::slam::pose::upper_triangle;
use crate::slam::test_scene::{CAMERA, Scene};

#[test]
fn a_pose_that_is_rotated_against_a_held_one_is_not_accepted() {
    let scene = Scene::new(3);
    let mapper = mapper_with(&[0.0, 0.1]);
    let pixels = scene.render(&CAMERA, &SE3::identity()).noisy(1.0, 7);
    let turned = |angle: f64| SE3::exp(&Vector6::new(0.0, 0.0, 0.0, angle, 0.0, 0.0));
    let held = |angle: f64, deviation: f64, state: TrackingState| PoseEstimate {
        state,
        keyframe_id: 0,
        map_from_camera: turned(angle),
        covariance: upper_triangle(|row, column| match row == column {
            true => deviation * deviation,
            false => 0.0,
        }),
        ..PoseEstimate::unknown(&FrameView::new(&CAMERA, 5, 0, &pixels))
    };
    let turning = TrackingState::Degraded(DegradedReason::Turning);
    let is_refused = |pose: PoseEstimate| mapper.contradicts_hold(&pose, 1, &SE3::identity());
    assert!(is_refused(held(0.5, 0.02, turning)));
    assert!(!is_refused(held(0.1, 0.02, turning)));
    // With so large an uncertainty any rotation is possible.
    assert!(!is_refused(held(0.5, 0.2, turning)));
    assert!(!is_refused(held(0.5, 0.02, TrackingState::Tracking)));
}

/// A mapper whose keyframes, of exact depth, are at these positions along a line.
fn mapper_with(places: &[f64]) -> Mapper {
    let scene = Scene::new(3);
    let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
    let ids = (0..).zip(places);
    mapper.map.keyframes = ids.map(|(id, &x)| scene.keyframe(id, sideways(x), 1.0)).collect();
    mapper.active = Some(Active::new(0));
    mapper
}

fn sideways(x: f64) -> SE3 {
    SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() }
}

#[test]
fn a_view_that_does_not_resemble_its_keyframe_is_not_accepted() {
    let mut mapper = mapper_with(&[0.0]);
    mapper.finder.index_new(&mut mapper.map.keyframes, 1);
    let mut accepts = |pixels: &[u8]| {
        let lost = PoseEstimate::unknown(&FrameView::new(&CAMERA, 5, 0, pixels));
        mapper.accepted(Some((0, SE3::identity())), &lost, pixels).is_some()
    };
    let view = Scene::new(3).render(&CAMERA, &SE3::identity()).noisy(2.0, 9);
    assert!(accepts(&view));
    // In a map of one keyframe nothing else would refuse it.
    let negative: Vec<u8> = view.iter().map(|grey| 255 - grey).collect();
    assert!(!accepts(&negative));
}

#[test]
fn a_pose_is_accepted_where_another_keyframe_confirms_it() {
    let pixels = Scene::new(3).render(&CAMERA, &sideways(0.1)).noisy(2.0, 9);
    let mut mapper = mapper_with(&[0.0, 0.15]);
    assert!(mapper.is_confirmed(0, &sideways(0.1), &pixels, &Confirmation::after_loss()));
    let turned = SE3::exp(&Vector6::new(0.1, 0.05, 0.0, 0.1, 0.25, 0.0));
    assert!(
        !mapper.is_confirmed(0, &turned, &pixels, &Confirmation::after_loss()),
        "the other one sees something else"
    );
    // There is no other keyframe to confirm it, or only a rejected one.
    assert!(mapper_with(&[0.0]).is_confirmed(0, &turned, &pixels, &Confirmation::after_loss()));
    mapper.map.keyframes[1].map_state = MapState::Rejected;
    assert!(mapper.is_confirmed(0, &turned, &pixels, &Confirmation::after_loss()));
}

#[test]
fn an_excluded_keyframe_and_one_that_disagrees_confirm_nothing() {
    let here = sideways(0.1);
    let pixels = Scene::new(3).render(&CAMERA, &here).noisy(2.0, 9);
    let elsewhere = (0..START_KEYFRAMES).map(|k| 30.0 + 0.3 * k as f64);
    let places: Vec<f64> = [0.0, 0.15].into_iter().chain(elsewhere).collect();
    let is_confirmed = |by: Confirmation| mapper_with(&places).is_confirmed(0, &here, &pixels, &by);
    assert!(is_confirmed(Confirmation::after_loss()));
    assert!(!is_confirmed(Confirmation { except: Some(1), ..Confirmation::after_loss() }));
    assert!(!is_confirmed(Confirmation { max_disagreement: 0.0, ..Confirmation::after_loss() }));
}

#[test]
fn in_a_map_of_many_keyframes_an_unconfirmed_pose_is_not_accepted() {
    let here = sideways(0.1);
    let pixels = Scene::new(3).render(&CAMERA, &here).noisy(2.0, 9);
    let confirms = |elsewhere: usize| {
        let places = (0..elsewhere).map(|k| 30.0 + 0.3 * k as f64);
        let places: Vec<f64> = std::iter::once(0.0).chain(places).collect();
        mapper_with(&places).is_confirmed(0, &here, &pixels, &Confirmation::after_loss())
    };
    assert!(confirms(START_KEYFRAMES - 1), "the map is young");
    assert!(!confirms(START_KEYFRAMES));
}

#[test]
fn the_points_of_the_joint_estimate_must_confirm_the_pose() {
    let here = sideways(0.1);
    let pixels = Scene::new(3).render(&CAMERA, &here).noisy(2.0, 9);
    let mut mapper = mapper_with(&[0.0, 0.15, 0.3, 0.4]);
    mapper.active = Some(Active::new(3));
    let elsewhere = Scene::new(8).render(&CAMERA, &here).noisy(2.0, 9);
    assert!(mapper.points_agree(0, &here, &elsewhere), "no points yet");
    let mut window = mapper.begin_adjustment(false).unwrap();
    window.optimise().unwrap();
    assert!(mapper.points_agree(0, &here, &elsewhere), "they are away");
    mapper.end_adjustment(window);
    assert!(mapper.points_agree(0, &here, &pixels));
    assert!(!mapper.points_agree(0, &here, &elsewhere));
    assert!(!mapper.points_agree(0, &sideways(0.4), &pixels), "they fit elsewhere");
}

#[test]
fn a_correction_right_after_relocalisation_keeps_the_odometry_pose() {
    let mut mapper = mapper_with(&[0.0, 1.0]);
    let last = sideways(0.1);
    mapper.last_world_from_camera = Some(last);
    mapper.last_tracked = Some((0, last));
    let found = sideways(0.2);
    mapper.restore_keyframe(1, &found);
    let in_world = |mapper: &Mapper| {
        mapper.keyframe().unwrap().world_from_keyframe.transform_pose(&found).translation.x
    };
    assert!((in_world(&mapper) - 0.1).abs() < 1e-12, "{}", in_world(&mapper));
    // The two keyframes move apart.
    let correction = Correction {
        keyframes: vec![KeyframeCorrection {
            keyframe_id: 1,
            map_from_keyframe: Sim3::new(sideways(1.5), 1.1),
            depth: LogPlane::default(),
            modes: None,
            place: None,
            relative_place: None,
        }],
        ..Correction::default()
    };
    mapper.apply(&correction).unwrap();
    assert!((in_world(&mapper) - 0.1).abs() < 1e-12, "{}", in_world(&mapper));
}

#[test]
fn a_found_camera_keeps_its_last_pose_on_an_earlier_keyframe() {
    let mut mapper = mapper_with(&[0.0, 1.0]);
    let pixels = Scene::new(3).render(&CAMERA, &sideways(1.0)).noisy(2.0, 9);
    let frame = FrameView::new(&CAMERA, 5, 0, &pixels);
    let at = |x: f64, keyframe_id: u64, epoch: u32| PoseEstimate {
        state: TrackingState::Tracking,
        world_from_camera: sideways(x),
        keyframe_id,
        epoch,
        ..PoseEstimate::unknown(&frame)
    };
    // The mapper has made keyframe 1 the active one, which the tracker has not received.
    mapper.active = Some(Active::new(1));
    mapper.last_world_from_camera = Some(sideways(0.1));
    for pose in [at(0.3, 0, 0), at(0.7, 9, 1)] {
        mapper.step(&frame, &pose, None, &mut || {});
    }
    assert_eq!(mapper.last_world_from_camera, Some(sideways(0.3)), "not that of another epoch");
}

#[test]
fn invalid_points_are_not_restored() {
    let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
    let point = DepthPoint { u: 50, v: 40, inverse_depth: 1.0, variance: 1e-4, intensity: 0.0 };
    let right = CAMERA.width as u16 - 1;
    let points = [
        point,
        DepthPoint { u: 51, variance: 0.0, ..point },
        DepthPoint { u: 52, variance: f32::NAN, ..point },
        DepthPoint { u: 53, inverse_depth: -1.0, ..point },
        DepthPoint { u: right, ..point },
        DepthPoint { v: 0, ..point },
        DepthPoint { v: u16::MAX, ..point },
    ];
    restore_points(&mut map, &points);
    assert_eq!(map.num_hypotheses(), 1);
    assert!(map.hypotheses.row(40)[50].is_some());
}

#[test]
fn restored_points_that_are_no_candidates_have_the_gradients_of_their_image() {
    let keyframe = Scene::new(4).keyframe(0, SE3::identity(), 1.0);
    let restored = |before: u64| {
        let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
        map.restart(&Scene::new(before).keyframe(0, SE3::identity(), 1.0).image, 1.0, 100_000);
        // Hardly any point is a candidate.
        map.restart(&keyframe.image, 100.0, 100_000);
        restore_points(&mut map, &keyframe.points);
        map
    };
    let (one, other) = (restored(5), restored(6));
    for point in &keyframe.points {
        let at = |map: &DepthMap| map.structure.at(usize::from(point.u), usize::from(point.v));
        assert_eq!(at(&one), at(&other), "{} {}", point.u, point.v);
    }
}

#[test]
fn a_depth_map_is_restored_from_its_points() {
    let scene = Scene::new(4);
    let keyframe = scene.keyframe(0, SE3::identity(), 1.0);
    let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
    map.restart(&keyframe.image, 5.0, 100_000);
    restore_points(&mut map, &keyframe.points);
    assert_eq!(map.num_hypotheses(), keyframe.points.len());
    let point = keyframe.points[77];
    let hypothesis = map.hypotheses.at(usize::from(point.u), usize::from(point.v));
    assert_eq!(hypothesis.smoothed, point.inverse_depth);
    assert_eq!(hypothesis.variance, point.variance);
}
