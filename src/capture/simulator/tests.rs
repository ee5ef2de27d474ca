//! Tests of whole simulated sequences.

use nalgebra::{Vector2, Vector3};

use super::*;
use crate::capture::simulator::params::MotionKind;
use crate::capture::simulator::scene::Block;
use crate::capture::simulator::scene_kind::SceneKind;
use crate::capture::simulator::summary::{gradient_share, summarize};

fn small(scene: SceneKind) -> SimulatorParams {
    SimulatorParams { scene, frames: 12, ..SimulatorParams::half_size() }
}

fn noiseless(mut params: SimulatorParams) -> SimulatorParams {
    params.sensor.noise_std_dev = 0.0;
    params
}

/// All bytes of a sequence and its stamps, through the trait.
fn play(mut source: Simulator) -> (Vec<u8>, Vec<FrameStamp>) {
    source.prepare(&mut |_, _| true).unwrap();
    let k = source.intrinsics();
    let mut pixels = vec![0; k.width * k.height];
    let (mut bytes, mut stamps) = (Vec::new(), Vec::new());
    while let Some(stamp) = source.next_into(&mut pixels).unwrap() {
        bytes.extend_from_slice(&pixels);
        stamps.push(stamp);
    }
    (bytes, stamps)
}

/// Distance from a point to the surface of a block.
pub fn distance(block: &Block, point: &Vector3<f64>) -> f64 {
    let (sin, cos) = (f64::from(block.turn.0), f64::from(block.turn.1));
    let d = point - Vector3::from(block.centre.map(f64::from));
    let local = [cos * d.x + sin * d.y, cos * d.y - sin * d.x, d.z];
    let outside: [f64; 3] = std::array::from_fn(|k| local[k].abs() - f64::from(block.half[k]));
    if block.is_hollow {
        return -outside.into_iter().fold(f64::NEG_INFINITY, f64::max);
    }
    outside.iter().map(|o| o.max(0.0).powi(2)).sum::<f64>().sqrt()
}

#[test]
fn every_seed_gives_a_path_as_the_default_rig_promises() {
    for seed in 0..40 {
        let room = furnish::furnish(SceneKind::Room, seed);
        let params = SimulatorParams { seed, ..Default::default() };
        let path = Trajectory::new(room.stage, &params.motion, seed);
        let poses: Vec<StampedPose> = (0..600)
            .map(|i| i64::from(i) * 1_000_000_000 / 30)
            .map(|nanos| StampedPose {
                nanos,
                world_from_camera: path.world_from_camera(nanos as f64 * 1e-9),
            })
            .collect();
        let summary = summarize(&poses);
        assert!(summary.path_length_m >= 8.0, "{seed}: {summary:?}");
        assert!(summary.extent_m >= 2.0, "{seed}: {summary:?}");
        assert!(summary.rotation_deg >= 180.0, "{seed}: {summary:?}");
        assert!((0.4..=0.6).contains(&summary.mean_speed_m_s), "{seed}: {summary:?}");
        for pose in &poses {
            let camera_in_world = pose.world_from_camera.translation;
            let nearest =
                room.blocks.iter().map(|b| distance(b, &camera_in_world)).fold(9.0, f64::min);
            assert!(nearest > 0.45, "{seed}: {nearest} m from a surface at {camera_in_world}");
        }
        // A hand does not jerk: the acceleration of every frame stays below a third of gravity.
        for three in poses.windows(3) {
            let [a, b, c] = [0, 1, 2].map(|i| three[i].world_from_camera.translation);
            let acceleration = (a - b * 2.0 + c).norm() * 900.0;
            assert!(acceleration < 3.3, "{seed}: {acceleration} m/s²");
        }
    }
}

#[test]
fn the_default_rig_sees_the_promised_texture_and_depth() {
    let params = SimulatorParams::default();
    assert_eq!((params.width, params.height, params.frames), (640, 480, 600));
    assert_eq!((params.focal_px, params.rate_hz, params.sensor.noise_std_dev), (525.0, 30.0, 2.0));
    let noisy = Simulator::new(params.clone()).unwrap();
    assert_eq!((noisy.intrinsics().cx, noisy.intrinsics().cy), (319.5, 239.5));
    let clean = Simulator::new(noiseless(params)).unwrap();
    let frames: Vec<usize> = (0..600).step_by(40).collect();
    let (mut noisy_sum, mut clean_sum) = (0.0, 0.0);
    for &frame in &frames {
        let pixels = noisy.raw_frame(frame).unwrap();
        let share = gradient_share(&pixels, 640, 5.0);
        assert!((0.12..0.6).contains(&share), "frame {frame}: {share}");
        let saturated = pixels.iter().filter(|&&p| p == 0 || p == 255).count();
        assert!(saturated < 3000, "frame {frame}: {saturated} saturated pixels");
        noisy_sum += share;
        clean_sum += gradient_share(&clean.raw_frame(frame).unwrap(), 640, 5.0);
        let depth = noisy.raw_depth(frame).unwrap();
        let nearest = depth.pixels().iter().fold(f32::INFINITY, |a, &b| a.min(b));
        let farthest = depth.pixels().iter().fold(0.0f32, |a, &b| a.max(b));
        assert!(nearest > 0.5 && farthest < 6.5, "frame {frame}: {nearest} to {farthest} m");
        assert!(farthest > 1.5 * nearest, "frame {frame} is flat: {nearest} to {farthest} m");
    }
    let (noisy_share, clean_share) =
        (noisy_sum / frames.len() as f64, clean_sum / frames.len() as f64);
    assert!((0.20..=0.40).contains(&noisy_share), "{noisy_share}");
    assert!((0.20..=0.40).contains(&clean_share), "{clean_share}");
}

/// Bilinear value of an image at a position; `None` at the border.
fn interpolate(image: &[u8], width: usize, at: &Vector2<f64>) -> Option<f64> {
    let height = image.len() / width;
    let inside = |x: f64, size: usize| x >= 1.0 && x < (size - 2) as f64;
    if !inside(at.x, width) || !inside(at.y, height) {
        return None;
    }
    let (u, v) = (at.x as usize, at.y as usize);
    let (a, b) = (at.x.fract(), at.y.fract());
    let grey = |du: usize, dv: usize| f64::from(image[(v + dv) * width + u + du]);
    let row = |dv: usize| grey(0, dv) * (1.0 - a) + grey(1, dv) * a;
    Some(row(0) * (1.0 - b) + row(1) * b)
}

/// Mean absolute difference between frame `to` and frame `from` warped by exact depth and poses, over pixels whose
/// neighbourhood is smooth in depth and unoccluded; and the number of these pixels.
fn warp_difference(
    source: &mut Simulator,
    frames: &[Vec<u8>],
    from: usize,
    to: usize,
) -> (f64, usize) {
    let k = source.intrinsics();
    let truth = source.ground_truth();
    let (stamp_from, stamp_to) = (truth[from].nanos, truth[to].nanos);
    let to_from_from = truth[to].world_from_camera.inverse() * truth[from].world_from_camera;
    let depth_from = source.depth_at(stamp_from).unwrap().unwrap();
    let depth_to = source.depth_at(stamp_to).unwrap().unwrap();
    let (mut sum, mut count) = (0.0, 0);
    for v in 2..k.height - 2 {
        for u in 2..k.width - 2 {
            let z = f64::from(depth_from.at(u, v));
            let smooth = |depth: &Image<f32>, u: usize, v: usize, z: f64| {
                let near = |du: usize, dv: usize| {
                    (f64::from(depth.at(u + du - 1, v + dv - 1)) - z).abs() < 0.03 * z
                };
                (0..4).all(|du| (0..4).all(|dv| near(du, dv)))
            };
            if !smooth(&depth_from, u, v, z) {
                continue;
            }
            let ray = k.ray(u as f64, v as f64);
            let point = to_from_from * (ray * z);
            if point.z < 0.1 {
                continue;
            }
            let pixel =
                Vector2::new(k.fx * point.x / point.z + k.cx, k.fy * point.y / point.z + k.cy);
            let Some(seen) = interpolate(&frames[to], k.width, &pixel) else { continue };
            if !smooth(&depth_to, pixel.x as usize, pixel.y as usize, point.z) {
                continue;
            }
            sum += (seen - f64::from(frames[from][v * k.width + u])).abs();
            count += 1;
        }
    }
    (sum / f64::from(count.max(1)), count as usize)
}

fn rectified_frames(source: &mut Simulator, wanted: &[usize]) -> Vec<Vec<u8>> {
    let mut frames = vec![Vec::new(); source.params().frames];
    for &frame in wanted {
        let k = source.intrinsics();
        frames[frame] = vec![0; k.width * k.height];
        let raw = source.raw_frame(frame).unwrap().into_owned();
        assert!(source.rectification.rectify_into(&raw, &mut frames[frame]));
    }
    frames
}

#[test]
fn exact_depth_and_poses_warp_one_frame_onto_another() {
    // The twins' wallpaper, seen from 0.9 m, has more detail between two pixels.
    for (scene, detail) in [
        (SceneKind::Room, 1.0),
        (SceneKind::Plane, 1.0),
        (SceneKind::Corridor, 1.0),
        (SceneKind::Flat, 1.0),
        (SceneKind::Twins, 1.2),
    ] {
        let mut source =
            Simulator::new(noiseless(SimulatorParams { scene, ..Default::default() })).unwrap();
        let frames = rectified_frames(&mut source, &[100, 101, 105, 120]);
        for (to, tolerance) in [(101, 1.0), (105, 1.0), (120, 1.1)] {
            let (difference, count) = warp_difference(&mut source, &frames, 100, to);
            assert!(difference < detail * tolerance, "{scene:?} 100 to {to}: {difference}");
            assert!(count > 60_000, "{scene:?} 100 to {to}: {count} pixels");
        }
    }
}

#[test]
fn a_rectified_lens_reprojects_as_well() {
    let mut params = noiseless(SimulatorParams::default());
    params.sensor.distortion = vec![-0.28, 0.07, 0.0002, 0.00002];
    let mut source = Simulator::new(params).unwrap();
    assert_ne!(source.intrinsics().fx, 525.0);
    let frames = rectified_frames(&mut source, &[100, 105]);
    let (difference, count) = warp_difference(&mut source, &frames, 100, 105);
    assert!(difference < 1.1, "{difference}");
    assert!(count > 60_000, "{count}");
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let mut params = small(SceneKind::Room);
    params.frames = 9;
    params.sensor.exposure_ms = 8.0;
    params.sensor.row_time_us = 30.0;
    params.sensor.vignette = 0.3;
    params.sensor.gain_amplitude = 0.2;
    params.sensor.distortion = vec![-0.2, 0.05, 0.0, 0.0];
    let render = |threads: usize, params: &SimulatorParams| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let params = params.clone();
        pool.install(|| play(Simulator::new(params).unwrap()))
    };
    let one = render(1, &params);
    assert!(one == render(3, &params));
    params.seed = 2;
    assert!(one.0 != render(1, &params).0);
}

#[test]
fn frames_are_the_same_on_every_processor() {
    let mut sharp = small(SceneKind::Room);
    sharp.frames = 3;
    let mut blurred = sharp.clone();
    blurred.sensor.exposure_ms = 8.0;
    blurred.sensor.distortion = vec![-0.2, 0.05, 0.0, 0.0];
    for params in [sharp, blurred] {
        let render = |kernel: Kernel| {
            let mut source = Simulator::new(params.clone()).unwrap();
            source.kernel = kernel;
            let mut scratch = RenderScratch::default();
            let (pixels, depth) = source.raw_frame_and_depth(1, &mut scratch).unwrap();
            let depth: Vec<u32> = depth.pixels().iter().map(|depth| depth.to_bits()).collect();
            (pixels.to_vec(), depth)
        };
        let portable = render(Kernel::Portable);
        for kernel in Kernel::available() {
            assert!(render(kernel) == portable, "{kernel:?}");
        }
    }
}

#[test]
fn frames_are_the_same_whether_prepared_or_not() {
    let params = SimulatorParams { frames: 10, ..small(SceneKind::Corridor) };
    let mut stopped = Simulator::new(params.clone()).unwrap();
    stopped.prepare(&mut |done, _| done < 8).unwrap();
    assert_eq!(stopped.frames.len(), 8);
    let mut pixels = vec![0; 320 * 240];
    let mut bytes = Vec::new();
    while stopped.next_into(&mut pixels).unwrap().is_some() {
        bytes.extend_from_slice(&pixels);
    }
    let (prepared, stamps) = play(Simulator::new(params).unwrap());
    assert!(bytes == prepared);
    assert_eq!(stamps.len(), 10);
    assert_eq!(stamps[1].capture_nanos, 1_033_333_333);
    assert!(stamps.windows(2).all(|s| s[0].capture_nanos < s[1].capture_nanos));
    assert!(matches!(stopped.next_into(&mut pixels[1..]), Err(SourceError::Buffer { .. })));
}

#[test]
fn a_frame_and_its_depth_are_the_same_alone_and_together() {
    let sharp = SimulatorParams { world_scale: 2.0, ..small(SceneKind::Flat) };
    let (mut rolling, mut blurred) = (sharp.clone(), sharp.clone());
    rolling.sensor.row_time_us = 50.0;
    blurred.sensor.exposure_ms = 10.0;
    // A width that is not a multiple of the lanes; the scratch memory is reused from one to the next.
    let odd = SimulatorParams { width: 101, height: 35, ..sharp.clone() };
    let mut scratch = RenderScratch::default();
    for params in [sharp, rolling, odd, blurred] {
        let source = Simulator::new(params).unwrap();
        let (pixels, depth) = source.raw_frame_and_depth(7, &mut scratch).unwrap();
        assert!(pixels == *source.raw_frame(7).unwrap());
        assert!(depth.pixels() == source.raw_depth(7).unwrap().pixels());
        assert!(source.raw_frame_and_depth(12, &mut scratch).is_none());
    }
}

#[test]
fn a_scaled_world_looks_the_same() {
    let metres = Simulator::new(small(SceneKind::Room)).unwrap();
    let tenths = SimulatorParams { world_scale: 10.0, ..small(SceneKind::Room) };
    let tenths = Simulator::new(tenths).unwrap();
    assert_eq!(metres.raw_frame(5).unwrap(), tenths.raw_frame(5).unwrap());
    let (a, b) = (metres.raw_depth(5).unwrap(), tenths.raw_depth(5).unwrap());
    assert!(a.pixels().iter().zip(b.pixels()).all(|(a, b)| (a * 10.0 - b).abs() < 1e-4));
    let place = |s: &Simulator| s.ground_truth()[5].world_from_camera.translation;
    assert!((place(&metres) * 10.0 - place(&tenths)).norm() < 1e-12);
}

#[test]
fn the_depth_of_the_plane_matches_geometry() {
    let source = Simulator::new(small(SceneKind::Plane)).unwrap();
    let k = source.params().intrinsics();
    let depth = source.raw_depth(7).unwrap();
    let pose = source.ground_truth()[7].world_from_camera;
    for v in (0..k.height).step_by(7) {
        for u in (0..k.width).step_by(7) {
            let ray = k.ray(u as f64, v as f64);
            // The plane is z = 0 of the world.
            let exact = -pose.translation.z / (pose.rotation * ray).z;
            let found = f64::from(depth.at(u, v));
            assert!((found - exact).abs() < 1e-5 * exact, "{u} {v}: {found} {exact}");
        }
    }
}

#[test]
fn a_rolling_shutter_takes_every_row_at_its_own_time() {
    let mut params = noiseless(small(SceneKind::Room));
    params.motion.mean_turn_deg_s = 40.0;
    params.sensor.row_time_us = 100.0;
    let rolling = Simulator::new(params.clone()).unwrap();
    params.sensor.row_time_us = 0.0;
    let global = Simulator::new(params).unwrap();
    let image = rolling.raw_frame(4).unwrap();
    let renderer = global.renderer(&global.lens);
    for row in [3usize, 120, 236] {
        let time_s = global.time_s(4) + (row as f64 - 119.5) * 1e-4;
        let pose = global.pose(time_s);
        let mut still = vec![0.0; 320 * 240];
        renderer.add_grey(&|_| pose, true, 1.0, &mut RenderScratch::default(), &mut still);
        let range = row * 320..(row + 1) * 320;
        let mean = |other: &[f32]| {
            let pairs = image[range.clone()].iter().zip(&other[range.clone()]);
            pairs.map(|(&a, &b)| (f32::from(a) - b).abs()).sum::<f32>() / 320.0
        };
        assert!(mean(&still) < 0.6, "row {row}: {}", mean(&still));
        let frozen: Vec<f32> = global.raw_frame(4).unwrap().iter().map(|&p| f32::from(p)).collect();
        assert!(row == 120 || mean(&frozen) > 1.0, "row {row} does not move: {}", mean(&frozen));
    }
}

#[test]
fn motion_blur_softens_only_what_moves() {
    let mut params = noiseless(small(SceneKind::Room));
    params.motion.mean_turn_deg_s = 60.0;
    let share = |params: &SimulatorParams| {
        let source = Simulator::new(params.clone()).unwrap();
        gradient_share(&source.raw_frame(3).unwrap(), 320, 12.0)
    };
    let sharp = share(&params);
    params.sensor.exposure_ms = 25.0;
    let blurred = share(&params);
    assert!(blurred < 0.75 * sharp, "{blurred} of {sharp}");
    params.motion.kind = MotionKind::Standing;
    let standing = share(&params);
    params.sensor.exposure_ms = 0.0;
    assert!((standing - share(&params)).abs() < 1e-3);
}

#[test]
fn simple_motions_match_their_names() {
    let poses = |kind: MotionKind| {
        let mut params = SimulatorParams { frames: 300, ..small(SceneKind::Plane) };
        params.motion.kind = kind;
        Simulator::new(params).unwrap().ground_truth().to_vec()
    };
    let standing = summarize(&poses(MotionKind::Standing));
    assert!(standing.path_length_m == 0.0 && standing.rotation_deg < 1e-9, "{standing:?}");
    let rotation = summarize(&poses(MotionKind::Rotation));
    assert_eq!(rotation.path_length_m, 0.0);
    assert!(rotation.rotation_deg > 90.0, "{rotation:?}");
    let straight = poses(MotionKind::Straight);
    assert!(summarize(&straight).rotation_deg < 1e-6);
    assert!((0.4..0.6).contains(&summarize(&straight).mean_speed_m_s));
    let start = straight[0].world_from_camera.translation;
    let along = (straight[30].world_from_camera.translation - start).normalize();
    for pose in &straight {
        let d = pose.world_from_camera.translation - start;
        assert!((d - along * along.dot(&d)).norm() < 1e-9);
    }
}
