//! Results do not depend on the unit of the world: the simulated room a tenth and ten times as large gives the same
//! trajectory and the same depth up to that factor, for every kind of start and for given poses.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::service::replay::{DepthOrigin, PoseOrigin, ReplayConfig, replay};
use semidense::service::results::record::RunRecord;
use semidense::slam::mapper::MapperParams;
use semidense::slam::window::params::WindowParams;

/// Relative deviation of trajectories, by length of path, where a sensor's metres enter as f32.
const TOLERANCE: f64 = 1e-3;
/// The same where keyframes are estimated jointly: that rounding may end an iteration a step earlier or later. 2.0e-3
/// was measured.
const JOINT_TOLERANCE: f64 = 3e-3;

fn record(world_scale: f64, poses: PoseOrigin, initial_depth: DepthOrigin) -> RunRecord {
    record_with(world_scale, poses, initial_depth, MapperParams::default())
}

fn record_with(
    world_scale: f64,
    poses: PoseOrigin,
    initial_depth: DepthOrigin,
    mapper: MapperParams,
) -> RunRecord {
    let params = SimulatorParams {
        seed: 2,
        frames: 45,
        width: 240,
        height: 180,
        focal_px: 197.0,
        world_scale,
        ..SimulatorParams::default()
    };
    let mut source = Simulator::new(params).unwrap();
    let config = ReplayConfig { poses, initial_depth, mapper, ..ReplayConfig::default() };
    replay(&mut source, "sim", &config, &mut |_| true).unwrap()
}

/// Positions of the claimed poses, with the number of the frame.
fn positions(record: &RunRecord) -> Vec<(u64, nalgebra::Vector3<f64>)> {
    let poses = record.poses.iter().map(|pose| pose.estimate);
    let tracked = poses.filter(|pose| pose.state.is_tracked());
    tracked.map(|pose| (pose.sequence, pose.world_from_camera.translation)).collect()
}

/// Median depth over the points of all keyframes, world units.
fn median_depth(record: &RunRecord) -> f64 {
    let of_keyframe = record.map.keyframes.iter().flat_map(|keyframe| {
        let scale = keyframe.map_from_keyframe.scale;
        keyframe.points.iter().map(move |point| scale / f64::from(point.inverse_depth))
    });
    let mut depths: Vec<f64> = of_keyframe.collect();
    depths.sort_by(f64::total_cmp);
    depths[depths.len() / 2]
}

/// Compares the room of another scale with the original; `unit` is the factor on its lengths.
fn assert_same(name: &str, one: &RunRecord, other: &RunRecord, unit: f64) {
    assert_same_within(TOLERANCE, name, one, other, unit);
}

fn assert_same_within(tolerance: f64, name: &str, one: &RunRecord, other: &RunRecord, unit: f64) {
    let (expected, found) = (positions(one), positions(other));
    assert!(expected.len() > 20, "{name}: {} poses", expected.len());
    let points = |record: &RunRecord| -> usize {
        record.map.keyframes.iter().map(|keyframe| keyframe.points.len()).sum()
    };
    println!(
        "{name}: {} and {} poses, {} and {} keyframes, {} and {} points, median depth {:.4} and {:.4}",
        expected.len(),
        found.len(),
        one.map.keyframes.len(),
        other.map.keyframes.len(),
        points(one),
        points(other),
        median_depth(one),
        median_depth(other) / unit
    );
    assert_eq!(expected.len(), found.len(), "{name}");
    let path: f64 = expected.windows(2).map(|pair| (pair[1].1 - pair[0].1).norm()).sum();
    for ((sequence, expected), (other_sequence, found)) in expected.iter().zip(&found) {
        assert_eq!(sequence, other_sequence, "{name}");
        let off = (found / unit - expected).norm();
        assert!(off <= tolerance * path, "{name}, frame {sequence}: {off} of {path}");
    }
    let ratio = median_depth(other) / unit / median_depth(one);
    assert!((ratio - 1.0).abs() < 0.01, "{name}: depth {ratio}");
    let (few, many) = (points(one).min(points(other)), points(one).max(points(other)));
    assert!(few as f64 > 0.99 * many as f64, "{name}: {few} and {many} points");
}

#[test]
fn poses_from_images_alone_are_bit_identical() {
    let (poses, depth) = (PoseOrigin::Tracker, DepthOrigin::Images);
    let one = record(1.0, poses, depth);
    for scale in [0.1, 10.0] {
        let other = record(scale, poses, depth);
        // A map from images has its own unit.
        assert_same(&format!("images, {scale}"), &one, &other, 1.0);
        assert_eq!(positions(&one), positions(&other), "{scale}");
    }
}

#[test]
fn with_sensor_depth_everything_has_the_unit_of_the_sensor() {
    let (poses, depth) = (PoseOrigin::Tracker, DepthOrigin::Sensor);
    let alone = WindowParams { num_free: 0, ..WindowParams::default() };
    for (window, tolerance) in [(alone, TOLERANCE), (WindowParams::default(), JOINT_TOLERANCE)] {
        let mapper = MapperParams { window, ..MapperParams::default() };
        let one = record_with(1.0, poses, depth, mapper.clone());
        for scale in [0.1, 10.0] {
            let other = record_with(scale, poses, depth, mapper.clone());
            assert_same_within(tolerance, &format!("sensor, {scale}"), &one, &other, scale);
        }
    }
}

#[test]
fn with_given_poses_depth_has_their_unit() {
    for depth in [DepthOrigin::Sensor, DepthOrigin::Images] {
        let one = record(1.0, PoseOrigin::GroundTruth, depth);
        for scale in [0.1, 10.0] {
            let other = record(scale, PoseOrigin::GroundTruth, depth);
            assert_same(&format!("given poses, {depth:?}, {scale}"), &one, &other, scale);
        }
    }
}
