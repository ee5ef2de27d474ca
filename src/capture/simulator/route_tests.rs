//! Tests of the scenes with rooms: the camera's path, and that its rounds see the same.

use nalgebra::Vector3;

use super::flat::{HEIGHT_M, ROOM_M, ROOMS_M};
use super::tests::distance;
use super::*;
use crate::capture::simulator::scene_kind::SceneKind;
use crate::capture::simulator::summary::summarize;
use crate::capture::simulator::twins::PERIOD_M;

/// Seeds with which the paths are checked.
const SEEDS: std::ops::Range<u64> = 1..13;

/// Poses of a walk through a whole scene.
fn walked(scene: SceneKind, seed: u64) -> Vec<StampedPose> {
    let params = SimulatorParams { seed, ..SimulatorParams::default() }.with_scene(scene);
    Simulator::unpainted(params).unwrap().ground_truth
}

/// Index of the room of the flat that contains a position.
fn room_of(place: &Vector3<f64>) -> Option<usize> {
    ROOMS_M.iter().position(|room| {
        (0..2).all(|k| (0.0..f64::from(ROOM_M[k])).contains(&(place[k] - f64::from(room[k]))))
    })
}

#[test]
fn the_flat_is_walked_through_twice_and_every_room_is_entered_twice() {
    for seed in SEEDS {
        let poses = walked(SceneKind::Flat, seed);
        let summary = summarize(&poses);
        assert!(summary.path_length_m >= 60.0, "{seed}: {summary:?}");
        assert!((0.4..0.6).contains(&summary.mean_speed_m_s), "{seed}: {summary:?}");
        let mut entered = [0; 4];
        let mut before = None;
        for pose in &poses {
            let room = room_of(&pose.world_from_camera.translation);
            if let Some(room) = room.filter(|_| room != before) {
                entered[room] += 1;
            }
            before = room;
        }
        // The walk ends in the room where it started.
        assert_eq!(entered, [3, 2, 2, 2], "{seed}");
    }
}

#[test]
fn a_walk_is_smooth_and_keeps_clear_of_all_surfaces() {
    for (scene, seed) in SEEDS.flat_map(|seed| [(SceneKind::Flat, seed), (SceneKind::Twins, seed)])
    {
        let blocks = furnish::furnish(scene, seed).blocks;
        let poses: Vec<SE3> = walked(scene, seed).iter().map(|p| p.world_from_camera).collect();
        let said = format!("{scene:?} {seed}");
        for pose in &poses {
            let place = pose.translation;
            assert!((0.9..f64::from(HEIGHT_M) - 0.6).contains(&place.z), "{said}: {place}");
            let nearest = blocks.iter().map(|b| distance(b, &place)).fold(9.0, f64::min);
            assert!(nearest > 0.2, "{said}: {nearest} m from a surface at {place}");
        }
        for two in poses.windows(2) {
            let speed = (two[1].translation - two[0].translation).norm() * 30.0;
            assert!(speed < 1.0, "{said}: {speed} m/s");
            let turn_deg_s = two[0].rotation.angle_to(&two[1].rotation).to_degrees() * 30.0;
            assert!(turn_deg_s < 45.0, "{said}: {turn_deg_s} °/s at {}", two[0].translation);
        }
        // It never turns without moving: it moves farther than this in every second.
        for second in poses.windows(31) {
            let steps =
                second.windows(2).map(|two| (two[1].translation - two[0].translation).norm());
            let moved: f64 = steps.sum();
            assert!(moved > 0.1, "{said}: {moved} m in a second at {}", second[0].translation);
        }
        for three in poses.windows(3) {
            let [a, b, c] = [0, 1, 2].map(|i| three[i].translation);
            let acceleration = (a - b * 2.0 + c).norm() * 900.0;
            assert!(acceleration < 3.3, "{said}: {acceleration} m/s²");
        }
    }
}

#[test]
fn the_second_round_passes_near_the_first_but_not_on_it() {
    for seed in SEEDS {
        let poses = walked(SceneKind::Flat, seed);
        let (first, second) = poses.split_at(poses.len() / 2);
        let distances: Vec<(f64, f64)> = second
            .iter()
            .map(|pose| {
                let of = |other: &StampedPose| {
                    let (a, b) = (&pose.world_from_camera, &other.world_from_camera);
                    ((a.translation - b.translation).norm(), a.rotation.angle_to(&b.rotation))
                };
                first.iter().map(of).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap()
            })
            .collect();
        let farthest = distances.iter().map(|d| d.0).fold(0.0, f64::max);
        let turned = distances.iter().map(|d| d.1).fold(0.0, f64::max).to_degrees();
        let mean = distances.iter().map(|d| d.0).sum::<f64>() / distances.len() as f64;
        assert!(farthest < 0.4 && turned < 20.0, "{seed}: {farthest} m, {turned}°");
        assert!(mean > 0.03, "{seed}: {mean} m");
    }
}

#[test]
fn a_route_is_endless_and_a_longer_sequence_starts_alike() {
    let whole = walked(SceneKind::Flat, 3);
    let params = SimulatorParams { seed: 3, frames: 20_000, ..Default::default() };
    let longer = Simulator::unpainted(params.with_scene(SceneKind::Flat)).unwrap();
    assert_eq!(longer.ground_truth[..whole.len()], whole);
    let last = longer.ground_truth.last().unwrap().world_from_camera.translation;
    assert!((0.0..9.0).contains(&last.x) && (0.0..10.0).contains(&last.y), "{last}");
    let short = SimulatorParams { frames: 7, ..Default::default() }.with_scene(SceneKind::Flat);
    assert_eq!(short.frames, 7);
    let mut still = SimulatorParams::default();
    still.motion.mean_speed_m_s = 0.0;
    assert!(still.with_scene(SceneKind::Flat).validate().is_ok());
}

#[test]
fn the_twin_rooms_look_exactly_alike() {
    let params = SimulatorParams { frames: 4, ..SimulatorParams::half_size() };
    let mut params = params.with_scene(SceneKind::Twins);
    params.sensor.noise_std_dev = 0.0;
    let simulator = Simulator::new(params).unwrap();
    let renderer = simulator.renderer(&simulator.lens);
    let image = |x: f64, y: f64, heading_deg: f64| {
        let mut grey = vec![0.0; 320 * 240];
        let pose = SE3 {
            rotation: trajectory::looking(heading_deg.to_radians(), -0.1, 0.0),
            translation: Vector3::new(x, y, 1.4),
        };
        renderer.add_grey(&|_| pose, true, 1.0, &mut RenderScratch::default(), &mut grey);
        grey
    };
    let difference = |a: &[f32], b: &[f32]| {
        a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / a.len() as f64
    };
    let period = f64::from(PERIOD_M);
    for (x, y, heading_deg) in [(2.0, 2.0, -80.0), (2.4, 1.2, 170.0), (2.9, 3.0, -120.0)] {
        let (one, other) = (image(x, y, heading_deg), image(x + period, y, heading_deg));
        // Rounding of the positions moves an edge by less than a thousandth of a pixel.
        assert!(difference(&one, &other) < 0.05, "room: {}", difference(&one, &other));
        assert!(difference(&one, &image(x, y, heading_deg + 5.0)) > 3.0);
    }
    // Across the corridor all three bays look alike.
    for heading_deg in [90.0, 60.0] {
        let bays = [0.0, 1.0, 2.0].map(|bay| image(2.0 + bay * period, 4.8, heading_deg));
        assert!(difference(&bays[0], &bays[1]) < 0.05, "{}", difference(&bays[0], &bays[1]));
        assert!(difference(&bays[1], &bays[2]) < 0.05, "{}", difference(&bays[1], &bays[2]));
    }
}
