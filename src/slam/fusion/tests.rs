//! Walls seen by several keyframes, with wrong points.

use nalgebra::Vector3;

use super::*;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::MapState;

const CAMERA: Intrinsics = Intrinsics::pinhole(96, 64, 80.0);
/// Distance of the wall, map units.
const DEPTH: f64 = 2.0;
const UNIT: f64 = 2.0;
/// σ/d of all points.
const NOISE: f64 = 0.01;

/// A keyframe at `x` that faces the wall, with `depth` of each pixel, in map units; NaN for no depth.
fn keyframe(keyframe_id: u64, x: f64, depth: impl Fn(u16, u16) -> f64) -> Keyframe {
    let pixels =
        (0..CAMERA.height as u16).flat_map(|v| (0..CAMERA.width as u16).map(move |u| (u, v)));
    let known = pixels.map(|(u, v)| (u, v, UNIT / depth(u, v))).filter(|(_, _, d)| !d.is_nan());
    let point = |(u, v, d): (u16, u16, f64)| DepthPoint {
        u,
        v,
        inverse_depth: d as f32,
        variance: (NOISE * d * NOISE * d) as f32,
        intensity: f32::from(u),
    };
    let place = SE3 { translation: Vector3::new(x, 0.0, 0.0), ..SE3::identity() };
    Keyframe {
        keyframe_id,
        ..Keyframe::at(Sim3::new(place, UNIT), CAMERA, known.map(point).collect(), Vec::new())
    }
}

/// Five of them in a row, the first with `depth`.
fn row(depth: impl Fn(u16, u16) -> f64) -> Vec<Keyframe> {
    let others = (1..5).map(|i| keyframe(i, 0.02 * i as f64, |_, _| DEPTH));
    std::iter::once(keyframe(0, 0.0, depth)).chain(others).collect()
}

fn fused_of(keyframes: &[Keyframe]) -> Vec<SurfacePoint> {
    let keyframes: Vec<&Keyframe> = keyframes.iter().collect();
    fuse(&keyframes, &FusionParams::default(), &mut |_, _| ())
}

fn depth_range(points: &[SurfacePoint]) -> [f32; 2] {
    let depths = || points.iter().map(|point| point.position[2]);
    [depths().fold(f32::INFINITY, f32::min), depths().fold(f32::NEG_INFINITY, f32::max)]
}

#[test]
fn a_wall_seen_by_five_keyframes_is_one_layer_with_normals() {
    // Off by half of σ to either side: the mean is nearer.
    let off = |i: u64| DEPTH * (1.0 + 0.5 * NOISE * [-1.0, 1.0, 0.0, 1.0, -1.0][i as usize]);
    let row: Vec<Keyframe> =
        (0..5).map(|i| keyframe(i, 0.02 * i as f64, move |_, _| off(i))).collect();
    let points = fused_of(&row);
    let count = points.len();
    // One for each pixel of one of them, or a few more at the sides.
    assert!((3500..7500).contains(&count), "{count}");
    let confirmed = points.iter().filter(|point| point.keyframes == 5).count();
    assert!(confirmed * 10 > count * 9, "{confirmed} of {count}");
    // At the sides not all of them see it.
    let [near, far] =
        depth_range(&points.iter().filter(|p| p.keyframes == 5).copied().collect::<Vec<_>>());
    assert!(near > 1.997 && far < 2.003, "{near} to {far}");
    let towards = points.iter().filter(|point| point.normal[2] < -0.99).count();
    assert!(towards * 10 > count * 9, "{towards} of {count}");
    for point in &points {
        let distance = Vector3::from(point.position.map(f64::from)).norm();
        assert!((f64::from(point.sigma) / distance / NOISE - 1.0).abs() < 0.1, "{point:?}");
    }
}

#[test]
fn points_that_others_see_through_are_removed_and_unseen_ones_stay() {
    // A patch hangs in front of the wall in one of them, large enough to have company.
    let is_patch = |u: u16, v: u16| (30..60).contains(&u) && (20..45).contains(&v);
    let hanging = |u, v| if is_patch(u, v) { 0.7 * DEPTH } else { DEPTH };
    let in_front = |points: &[SurfacePoint]| {
        points.iter().filter(|point| point.position[2] < 0.8 * DEPTH as f32).count()
    };
    assert_eq!(in_front(&fused_of(&row(hanging))), 0, "four see through it");
    let few: Vec<Keyframe> = row(hanging).into_iter().take(2).collect();
    assert!(in_front(&fused_of(&few)) > 300, "one may be wrong itself");
    let blind = (0..5).map(|i| {
        let unknown = move |u, v| if is_patch(u, v) { f64::NAN } else { DEPTH };
        keyframe(i, 0.02 * i as f64, move |u, v| if i == 0 { hanging(u, v) } else { unknown(u, v) })
    });
    let blind: Vec<Keyframe> = blind.collect();
    assert!(in_front(&fused_of(&blind)) > 100, "nobody sees through it");
    let agreed = (0..5).map(|i| keyframe(i, 0.0, hanging));
    assert!(in_front(&fused_of(&agreed.collect::<Vec<_>>())) > 300, "all see it");
}

#[test]
fn depth_that_is_too_uncertain_confirms_nothing() {
    let mut keyframes = row(|_, _| DEPTH);
    let most = FusionParams::default().max_relative_std_dev as f32;
    for point in keyframes[1..].iter_mut().flat_map(|keyframe| &mut keyframe.points) {
        point.variance = (1.01 * most * point.inverse_depth).powi(2);
    }
    let points = fused_of(&keyframes);
    assert!(!points.is_empty() && points.iter().all(|point| point.keyframes == 1));
}

#[test]
fn isolated_depths_are_removed() {
    let wrong = |u: u16, v: u16| u.is_multiple_of(16) && v.is_multiple_of(16) && u > 0 && v > 0;
    let lone = [keyframe(0, 0.0, |u, v| if wrong(u, v) { 1.3 * DEPTH } else { DEPTH })];
    let [near, far] = depth_range(&fused_of(&lone));
    assert!((near - 2.0).abs() < 1e-3 && (far - 2.0).abs() < 1e-3, "{near} to {far}");
}

#[test]
fn the_bits_do_not_depend_on_the_number_of_threads() {
    let wave = |u: u16, v: u16| DEPTH * (1.0 + 0.004 * f64::from((u * 7 + v * 13) % 11));
    let row: Vec<Keyframe> =
        (0..20).map(|i| keyframe(i, 0.003 * i as f64, |u, v| wave(u + i as u16, v))).collect();
    let of = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let points = pool.install(|| fused_of(&row));
        points.iter().map(|p| format!("{p:?}")).collect::<Vec<String>>()
    };
    let one = of(1);
    assert!(one.len() > 3000);
    assert!([2, 3, 8].into_iter().all(|threads| of(threads) == one));
}

#[test]
fn a_coarser_resolution_has_fewer_points_and_progress_reaches_its_end() {
    let row = row(|_, _| DEPTH);
    let keyframes: Vec<&Keyframe> = row.iter().collect();
    let mut last = (0, 0);
    let mut count = |resolution: &str| {
        let resolution = resolution.parse().unwrap();
        let params = FusionParams { resolution, ..FusionParams::default() };
        fuse(&keyframes, &params, &mut |done, all| last = (done, all)).len()
    };
    let counts = ["0.5%", "3%", "0.1", "0.3"].map(&mut count);
    assert!(
        counts[0] > 2 * counts[1] && counts[1] > 2 * counts[2] && counts[2] > 3 * counts[3],
        "{counts:?}"
    );
    assert!(counts[3] > 10, "{counts:?}");
    assert_eq!(last, (5, 5));
}

#[test]
fn invalid_keyframes_are_left_out() {
    assert!(fused_of(&[]).is_empty());
    let mut row = row(|_, _| DEPTH);
    for (i, point) in row[0].points.iter_mut().enumerate() {
        match i % 5 {
            0 => point.inverse_depth = f32::NAN,
            1 => point.variance = f32::INFINITY,
            2 => point.inverse_depth = f32::INFINITY,
            3 => (point.inverse_depth, point.variance) = (f32::MIN_POSITIVE, 0.0),
            _ => point.variance = -1.0,
        }
    }
    row[1].map_from_keyframe.scale = f64::NAN;
    row[2].map_state = MapState::Rejected;
    row[3].points.reverse();
    row[4].map_from_keyframe.scale = 1e300;
    assert!(fused_of(&row).is_empty());
}
