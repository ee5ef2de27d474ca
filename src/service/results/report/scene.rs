//! A finished map for the 3D view of a page: points by keyframe, keyframes and trajectory in one block of bytes.
//!
//! The block is the length of a JSON header (u32, little-endian), the header, and eight bytes per point: its position
//! in its cluster's box (three u16), its brightness and the code of its relative deviation.

use std::collections::HashMap;

use serde_json::{Value, json};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::trajectory::StampedPose;

/// The 3D view itself: plain WebGL without dependencies.
pub const VIEWER: &str = include_str!("viewer.js");
/// Its time slider.
pub const PLAYER: &str = include_str!("player.js");

/// Bytes of a point.
pub const POINT_BYTES: usize = 8;
/// Most poses of the trajectory: a line on a screen shows no more.
const MAX_POSES: usize = 6000;
/// Most keyframes that are checked for the first view of a point: more cost seconds and move no point by much.
const MAX_ASKED: usize = 400;
/// Largest depth at which a keyframe is taken to have seen a point, in its own units: its mean inverse depth is 1.
const FURTHEST: f64 = 4.0;
/// Smallest such depth.
const NEAREST: f64 = 0.1;
/// A pause between poses this many times the usual one is a gap in the line.
const GAP_STEPS: f64 = 6.0;
/// Relative deviations of the codes 1 and 255.
const DEVIATION_RANGE: [f64; 2] = [1e-3, 1.0];

/// A point of the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScenePoint {
    /// Its position, map units.
    pub position: [f32; 3],
    /// Its brightness.
    pub grey: u8,
    /// Standard deviation along the ray, map units; NaN where it is unknown.
    pub std_dev: f32,
    /// Its keyframe; `None` for the first that saw it.
    pub keyframe_id: Option<u64>,
}

/// A keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneKeyframe {
    /// Its id.
    pub keyframe_id: u64,
    /// Stamp of its frame, nanoseconds.
    pub nanos: i64,
    /// Its pose in the map.
    pub place: Sim3,
}

/// The input to be packed.
#[derive(Debug, Clone, Copy)]
pub struct SceneInput<'a> {
    /// The points; any even part of them represents all.
    pub points: &'a [ScenePoint],
    /// The keyframes in order of their stamps.
    pub keyframes: &'a [SceneKeyframe],
    /// The trajectory.
    pub path: &'a [StampedPose],
    /// Indices in it before which the line has a gap, in ascending order; a pause is a gap too.
    pub gaps: &'a [usize],
    /// The camera.
    pub intrinsics: &'a Intrinsics,
    /// The up direction, if it is known; else the page uses that of the cameras.
    pub up: Option<[f64; 3]>,
    /// Most points that are packed.
    pub max_points: usize,
}

/// The code of a relative deviation: 0 where it is unknown, else 1 to 255 on a logarithmic scale.
pub fn deviation_code(relative: f64) -> u8 {
    let [low, high] = DEVIATION_RANGE;
    // NaN has no code.
    if !(relative > 0.0) {
        return 0;
    }
    (1.0 + 254.0 * ((relative / low).ln() / (high / low).ln()).clamp(0.0, 1.0)) as u8
}

/// An order of `count` items of which any beginning is an even sample: steps of the golden ratio.
pub fn even_order(count: usize) -> impl Iterator<Item = usize> {
    const GOLDEN: f64 = 0.618_033_988_749_895;
    let gcd = |mut a: usize, mut b: usize| {
        while b != 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let mut step = ((count as f64 * GOLDEN) as usize).max(1);
    while count > 0 && gcd(step, count) != 1 {
        step += 1;
    }
    (0..count).map(move |i| (i as u128 * step as u128 % count as u128) as usize)
}

/// Packs the block of bytes.
pub fn pack(input: &SceneInput<'_>) -> Vec<u8> {
    let first_keyframe = input.keyframes.first().map(|k| k.nanos);
    let start = input.path.first().map(|pose| pose.nanos).or(first_keyframe).unwrap_or(0);
    let secs = |nanos: i64| rounded((nanos.saturating_sub(start)) as f64 * 1e-9);
    let grouped = group(input);
    let mut bytes = Vec::new();
    let mut clusters = Vec::new();
    for (keyframe, points) in input.keyframes.iter().zip(&grouped) {
        clusters.push(cluster(keyframe, points, secs(keyframe.nanos), &mut bytes));
    }
    let every = input.path.len().div_ceil(MAX_POSES).max(1);
    let path: Vec<Value> = input
        .path
        .iter()
        .step_by(every)
        .map(|pose| {
            let p = &pose.world_from_camera;
            let numbers = p.translation.iter().copied().chain(p.quaternion_xyzw()).map(rounded);
            Value::from([secs(pose.nanos)].into_iter().chain(numbers).collect::<Vec<f64>>())
        })
        .collect();
    let k = input.intrinsics;
    let header = json!({
        "k": [k.fx, k.fy, k.cx, k.cy],
        "size": [k.width, k.height],
        "up": input.up,
        "end": path.last().and_then(|pose| pose[0].as_f64()).unwrap_or(0.0),
        "gap": gap(input.path) * every as f64,
        // A gap between two packed poses is marked at the second.
        "gaps": input.gaps.iter().map(|place| place.div_ceil(every)).collect::<Vec<usize>>(),
        "points": input.points.len(),
        "shown": bytes.len() / POINT_BYTES,
        "clusters": clusters,
        "path": path,
    });
    framed(&header, &bytes)
}

/// A JSON header and bytes in one block; the bytes begin at a multiple of eight.
pub fn framed(header: &Value, bytes: &[u8]) -> Vec<u8> {
    const ALIGNMENT: usize = 8;
    let mut text = header.to_string();
    while !(4 + text.len()).is_multiple_of(ALIGNMENT) {
        text.push(' ');
    }
    let mut block = Vec::with_capacity(4 + text.len() + bytes.len());
    block.extend_from_slice(&(text.len() as u32).to_le_bytes());
    block.extend_from_slice(text.as_bytes());
    block.extend_from_slice(bytes);
    block
}

/// Six decimals are more than a screen shows.
fn rounded(number: f64) -> f64 {
    if number.is_finite() { (number * 1e6).round() / 1e6 } else { 0.0 }
}

/// A similarity as the seven numbers of its pose, and its scale.
pub fn place_numbers(place: &Sim3) -> [f64; 8] {
    let [qx, qy, qz, qw] = place.rigid.quaternion_xyzw();
    let t = &place.rigid.translation;
    [t.x, t.y, t.z, qx, qy, qz, qw, place.scale]
}

/// The shortest pause between two poses that is a gap in the line, seconds.
fn gap(path: &[StampedPose]) -> f64 {
    let mut steps: Vec<i64> = path.windows(2).map(|pair| pair[1].nanos - pair[0].nanos).collect();
    steps.sort_unstable();
    steps.get(steps.len() / 2).map_or(1.0, |&usual| usual as f64 * 1e-9 * GAP_STEPS)
}

/// The points of each keyframe, thinned.
fn group<'a>(input: &SceneInput<'a>) -> Vec<Vec<&'a ScenePoint>> {
    let mut groups = vec![Vec::new(); input.keyframes.len()];
    let index: HashMap<u64, usize> =
        input.keyframes.iter().enumerate().map(|(i, k)| (k.keyframe_id, i)).collect();
    let asked = input.keyframes.len().div_ceil(MAX_ASKED).max(1);
    let views = input.keyframes.iter().enumerate().step_by(asked);
    let views: Vec<(usize, Sim3)> = views.map(|(i, k)| (i, k.place.inverse())).collect();
    let shown = input.points.len().min(input.max_points);
    for i in 0..shown {
        let point = &input.points[i * input.points.len() / shown];
        if !point.position.iter().all(|x| x.is_finite()) {
            continue;
        }
        let of = match point.keyframe_id {
            Some(id) => index.get(&id).copied(),
            // A point without a known viewer belongs to the last keyframe: it exists in the end.
            None => first_viewer(&views, input.intrinsics, point).or(groups.len().checked_sub(1)),
        };
        if let Some(group) = of {
            groups[group].push(point);
        }
    }
    groups
}

/// The first of some keyframes (`keyframe_from_map`, each with its index) that had a point in its image and not too far
/// away; else the first that had it in its image at all.
fn first_viewer(views: &[(usize, Sim3)], k: &Intrinsics, point: &ScenePoint) -> Option<usize> {
    let position = nalgebra::Vector3::from(point.position.map(f64::from));
    let mut far = None;
    for &(index, keyframe_from_map) in views {
        let p = keyframe_from_map * position;
        if !(p.z > NEAREST) {
            continue;
        }
        let (u, v) = (k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
        if u < 0.0 || v < 0.0 || u >= k.width as f64 || v >= k.height as f64 {
            continue;
        }
        if p.z < FURTHEST {
            return Some(index);
        }
        far = far.or(Some(index));
    }
    far
}

/// Appends a keyframe's points to `bytes` and describes them.
fn cluster(
    keyframe: &SceneKeyframe,
    points: &[&ScenePoint],
    secs: f64,
    bytes: &mut Vec<u8>,
) -> Value {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for point in points {
        for axis in 0..3 {
            low[axis] = low[axis].min(point.position[axis]);
            high[axis] = high[axis].max(point.position[axis]);
        }
    }
    if points.is_empty() {
        (low, high) = ([0.0; 3], [0.0; 3]);
    }
    let step: [f64; 3] = std::array::from_fn(|axis| {
        (f64::from(high[axis]) - f64::from(low[axis])).max(1e-9) / f64::from(u16::MAX)
    });
    let keyframe_from_map = keyframe.place.inverse();
    let mut inverse_depths = Vec::with_capacity(points.len());
    let offset = bytes.len();
    // Fused points are in an order of which any beginning represents all; those of one keyframe are row by row.
    let is_ordered = points.first().is_some_and(|point| point.keyframe_id.is_none());
    let mut push = |point: &ScenePoint| {
        for axis in 0..3 {
            let q = (f64::from(point.position[axis]) - f64::from(low[axis])) / step[axis];
            bytes.extend_from_slice(&(q.round() as u16).to_le_bytes());
        }
        let seen = keyframe_from_map * nalgebra::Vector3::from(point.position.map(f64::from));
        if seen.z > NEAREST {
            inverse_depths.push(1.0 / seen.z);
        }
        // σ is along the ray.
        let relative = f64::from(point.std_dev) / (seen.norm() * keyframe.place.scale);
        bytes.extend_from_slice(&[point.grey, deviation_code(relative)]);
    };
    match is_ordered {
        true => points.iter().for_each(|point| push(point)),
        false => even_order(points.len()).for_each(|i| push(points[i])),
    }
    inverse_depths.sort_unstable_by(f64::total_cmp);
    let near = inverse_depths.get(inverse_depths.len() * 19 / 20).copied().unwrap_or(1.0);
    json!({
        "id": keyframe.keyframe_id,
        "t": secs,
        "place": place_numbers(&keyframe.place).map(rounded),
        "near": rounded(near),
        "min": low,
        "step": step,
        "count": points.len(),
        "offset": offset,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use nalgebra::Vector3;

    fn unpack(block: &[u8]) -> (Value, &[u8]) {
        let length = u32::from_le_bytes(block[..4].try_into().unwrap()) as usize;
        (serde_json::from_slice(&block[4..4 + length]).unwrap(), &block[4 + length..])
    }

    fn keyframe(keyframe_id: u64, x: f64) -> SceneKeyframe {
        let rigid = SE3 { translation: Vector3::new(x, 0.0, 0.0), ..SE3::identity() };
        SceneKeyframe {
            keyframe_id,
            nanos: keyframe_id as i64 * 1_000_000_000,
            place: Sim3::new(rigid, 2.0),
        }
    }

    fn pack_points(points: &[ScenePoint], max_points: usize) -> Vec<u8> {
        pack(&SceneInput {
            points,
            keyframes: &[keyframe(3, 0.0), keyframe(5, 10.0)],
            path: &[],
            gaps: &[],
            intrinsics: &Intrinsics::pinhole(64, 48, 50.0),
            up: None,
            max_points,
        })
    }

    fn point(x: f32, keyframe_id: Option<u64>) -> ScenePoint {
        ScenePoint { position: [x, 0.0, 2.0], grey: 7, std_dev: 0.02, keyframe_id }
    }

    #[test]
    fn a_point_is_restored_to_a_hundred_thousandth_of_its_box() {
        let block =
            pack_points(&[point(0.0, Some(5)), point(1.0, Some(5)), point(0.25, Some(5))], 10);
        let (header, bytes) = unpack(&block);
        let cluster = &header["clusters"][1];
        assert_eq!(
            (cluster["count"].as_u64(), header["clusters"][0]["count"].as_u64()),
            (Some(3), Some(0))
        );
        let at = |i: usize| f64::from(u16::from_le_bytes([bytes[8 * i], bytes[8 * i + 1]]));
        let xs = [0, 1, 2].map(|i| at(i) * cluster["step"][0].as_f64().unwrap());
        let found = xs.iter().any(|x| (x - 0.25).abs() < 1e-5);
        assert!(found && bytes[6] == 7, "{xs:?}");
        assert_eq!((block.len() - bytes.len()) % 8, 0);
    }

    #[test]
    fn a_standard_deviation_is_a_share_of_the_distance_along_the_ray() {
        // As far to the side as it is deep, in a keyframe whose unit is two of the map's.
        let block = pack_points(&[point(2.0, Some(3))], 10);
        let (_, bytes) = unpack(&block);
        let (distance, depth) = (8.0f64.sqrt(), 2.0);
        assert_eq!(bytes[7], deviation_code(0.02 / distance));
        assert_ne!(bytes[7], deviation_code(0.02 / depth));
    }

    #[test]
    fn a_fused_point_belongs_to_the_first_keyframe_that_saw_it() {
        let (header, _) =
            unpack(&pack_points(&[point(0.0, None), point(10.0, None), point(500.0, None)], 10))
                .clone();
        assert_eq!(header["clusters"][0]["count"], 1);
        assert_eq!(header["clusters"][1]["count"], 2, "nobody saw the last");
    }

    #[test]
    fn a_large_map_is_thinned_evenly_and_non_finite_points_are_left_out() {
        let mut points: Vec<ScenePoint> =
            (0..1000).map(|i| point(i as f32 * 1e-3, Some(3))).collect();
        points[0].position[1] = f32::NAN;
        let (header, bytes) = {
            let block = pack_points(&points, 100);
            let (h, b) = unpack(&block);
            (h, b.to_vec())
        };
        assert_eq!((bytes.len() / POINT_BYTES, &header["points"]), (99, &json!(1000)));
        assert!(header["clusters"][0]["min"][0].as_f64().unwrap() > 0.0);
    }

    #[test]
    fn a_gap_in_the_path_survives_thinning() {
        let pose =
            |i: i64| StampedPose { nanos: i * 33_333_333, world_from_camera: SE3::identity() };
        for (count, places) in [(6000, [1, 2999]), (18_000, [1, 1000])] {
            let path: Vec<StampedPose> = (0..count).map(pose).collect();
            let block = pack(&SceneInput {
                points: &[],
                keyframes: &[],
                path: &path,
                gaps: &[1, 2999],
                intrinsics: &Intrinsics::pinhole(64, 48, 50.0),
                up: None,
                max_points: 0,
            });
            assert_eq!(unpack(&block).0["gaps"], json!(places), "{count}");
        }
    }

    #[test]
    fn the_order_is_a_permutation_and_codes_increase() {
        for count in [0, 1, 2, 7, 100, 1001] {
            let mut order: Vec<usize> = even_order(count).collect();
            order.sort_unstable();
            assert_eq!(order, (0..count).collect::<Vec<_>>());
        }
        assert_eq!(
            [f64::NAN, -1.0, 1e-9, 1e-3, 1.0, 9.0].map(deviation_code),
            [0, 0, 1, 1, 255, 255]
        );
        assert!(deviation_code(0.01) < deviation_code(0.1));
    }
}
