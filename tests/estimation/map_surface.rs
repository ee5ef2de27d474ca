//! The map as one surface compared with the true one, in a simulated room with exact depth: fewer points, fewer wrong
//! ones, and no loss of correct surface.

use nalgebra::Vector3;
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::service::replay::{PoseOrigin, ReplayConfig, replay};
use semidense::slam::evaluation::surface_error::{SeenPoint, TrueSurface};
use semidense::slam::fusion::{FusionParams, fuse};
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::kernel::SimdMode;
use semidense::slam::keyframe::Keyframe;
use semidense::slam::trajectory::StampedPose;

/// Four seconds: a dozen keyframes.
const FRAMES: usize = 120;

#[test]
fn the_surface_of_a_room_has_fewer_points_and_a_smaller_share_of_outliers() {
    let params = SimulatorParams { frames: FRAMES, ..SimulatorParams::half_size() };
    let mut source = Simulator::new(params).unwrap();
    // The map is at the true poses, so that only the error of its depth remains.
    let mut config = ReplayConfig { poses: PoseOrigin::GroundTruth, ..ReplayConfig::default() };
    config.tracker.alignment.simd = SimdMode::Portable;
    let record = replay(&mut source, "room", &config, &mut |_| true).unwrap();
    let poses: Vec<StampedPose> = source.ground_truth().to_vec();
    let true_pose = |keyframe: &Keyframe| {
        *poses.iter().find(|pose| pose.nanos == keyframe.capture_nanos).unwrap()
    };
    let k = source.intrinsics();
    let first = &record.map.keyframes[0];
    // The map starts at its first keyframe.
    let at_first = Sim3::new(true_pose(first).world_from_camera, 1.0);
    let world_from_map = at_first * Sim3::new(first.map_from_keyframe.rigid, 1.0).inverse();
    let (mut truth, mut cameras, mut all) = (TrueSurface::default(), Vec::new(), Vec::new());
    for keyframe in &record.map.keyframes {
        let pose = true_pose(keyframe);
        let depth = source.depth_at(keyframe.capture_nanos).unwrap().unwrap();
        truth.add(&depth, &k, &pose.world_from_camera);
        let place = world_from_map * keyframe.map_from_keyframe;
        let off = (place.rigid.translation - pose.world_from_camera.translation).norm();
        assert!(off < 1e-6, "the poses were given: {off} m");
        cameras.push(place.rigid.translation);
        let known = |variance: f32, d: f32| d > 0.0 && variance.sqrt() <= 0.1 * d;
        for p in keyframe.points.iter().filter(|p| known(p.variance, p.inverse_depth)) {
            let ray = k.ray(f64::from(p.u), f64::from(p.v));
            all.push(place * (ray / f64::from(p.inverse_depth)));
        }
    }
    let seen = |position: Vector3<f64>| {
        let distances = cameras.iter().map(|camera| (position - camera).norm());
        SeenPoint { position, distance: distances.fold(f64::INFINITY, f64::min) }
    };
    let keyframes: Vec<&Keyframe> = record.map.keyframes.iter().collect();
    let surface = fuse(&keyframes, &FusionParams::default(), &mut |_, _| ());
    let after: Vec<SeenPoint> = surface
        .iter()
        .map(|p| seen(world_from_map * Vector3::from(p.position.map(f64::from))))
        .collect();
    let before: Vec<SeenPoint> = all.iter().map(|&at| seen(at)).collect();
    let (of_all, of_surface) = (truth.errors(&before).unwrap(), truth.errors(&after).unwrap());
    let shown = truth.shown(&before, &after);
    let first = truth.errors(&after[..after.len() / 10]).unwrap();
    println!(
        "{} keyframes: {} points, {of_all:?}; surface: {} points, {of_surface:?}, the first tenth {first:?}, shows {shown}",
        keyframes.len(),
        before.len(),
        after.len()
    );
    // Six keyframes overlap less than the twenty of a whole run.
    assert!(after.len() * 4 < before.len(), "{} of {}", after.len(), before.len());
    assert!(of_surface.median_ratio < 0.006 && of_surface.off < 0.05, "{of_surface:?}");
    // Correct points are seen many times, wrong ones once: the same share with one point per cell is better.
    assert!(of_surface.off < 1.2 * of_all.off, "{of_surface:?}, before {of_all:?}");
    assert!(shown > 0.97, "{shown}");
    let normals = surface.iter().filter(|point| point.normal != [0.0; 3]).count();
    assert!(normals * 2 > surface.len(), "{normals} of {}", surface.len());
}
