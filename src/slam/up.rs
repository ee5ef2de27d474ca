//! The upward direction of a map: the mean of the cameras' up vectors, refined with the horizontal surfaces of the map.
//!
//! A single camera does not measure gravity. It is carried more or less upright, so the mean of its up vectors is right
//! to some tens of degrees; floors and tables, where the map has them, give the rest.

use nalgebra::Vector3;

use crate::slam::trajectory::StampedPose;

/// Length of the mean of the cameras' up vectors below which they agree on no direction.
const SHORTEST_MEAN: f64 = 0.3;

/// Largest angle of up from the cameras' mean, radians, and least share of the normals that must point there or
/// opposite. A camera that looks at a table is tilted by 30° or so, one that looks at the floor before its feet by 40°;
/// further off a wall could be taken for a floor. Of evenly spread directions 1.5 % are within the last cone.
const LIMITS: [(f64, f64); 2] = [(35.0 * DEGREE, 0.05), (50.0 * DEGREE, 0.12)];

/// Angles below which the normal of a surface agrees with a direction, from the first rounds to the last: normals of
/// neighbouring points scatter by some ten degrees. Radians.
const CONES: [f64; 4] = [20.0 * DEGREE, 15.0 * DEGREE, 10.0 * DEGREE, 10.0 * DEGREE];

/// Rounds within each cone.
const ROUNDS: usize = 4;

/// Most normals that are used: more do not change the direction.
const MAX_NORMALS: usize = 20_000;

/// Most normals that are tried as the initial direction.
const MAX_STARTS: usize = 200;

/// Fewest normals of a surface.
const MIN_NORMALS: usize = 100;

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// The upward direction, a unit vector in the coordinates of `poses` and `normals`; `None` where the cameras agree on
/// none.
///
/// Of the directions near the mean of the cameras' up vectors it is the one that most normals share, pointing up or
/// down, and the mean itself where too few do. Zero and non-finite normals do not count.
pub fn up_direction<'a>(
    poses: impl Iterator<Item = &'a StampedPose>,
    normals: impl ExactSizeIterator<Item = [f32; 3]>,
) -> Option<Vector3<f64>> {
    let mean = mean_up(poses)?;
    let every = normals.len().div_ceil(MAX_NORMALS).max(1);
    let normals: Vec<Vector3<f64>> = normals
        .step_by(every)
        .filter_map(|normal| Vector3::from(normal.map(f64::from)).try_normalize(0.5))
        .filter(|normal| normal.iter().all(|c| c.is_finite()))
        .collect();
    let shared = LIMITS
        .into_iter()
        .find_map(|(most_tilt, share)| shared_normal(&mean, &normals, most_tilt.cos(), share));
    Some(shared.unwrap_or(mean))
}

/// The mean of the cameras' up vectors.
fn mean_up<'a>(poses: impl Iterator<Item = &'a StampedPose>) -> Option<Vector3<f64>> {
    let ups = poses.map(|pose| pose.world_from_camera.rotation * -Vector3::y());
    let (sum, count) = ups
        .filter(|up: &Vector3<f64>| up.iter().all(|c| c.is_finite()))
        .fold((Vector3::zeros(), 0.0f64), |(sum, count), up| (sum + up, count + 1.0));
    let mean: Vector3<f64> = sum / count.max(1.0);
    (mean.norm() > SHORTEST_MEAN).then(|| mean.normalize())
}

/// The normal that most have in common, at least `share` of them; its product with `mean` is more than `least`.
fn shared_normal(
    mean: &Vector3<f64>,
    normals: &[Vector3<f64>],
    least: f64,
    share: f64,
) -> Option<Vector3<f64>> {
    let upright: Vec<Vector3<f64>> = normals
        .iter()
        .map(|normal| if normal.dot(mean) < 0.0 { -normal } else { *normal })
        .filter(|normal| normal.dot(mean) > least)
        .collect();
    let [.., cone] = CONES;
    let every = upright.len().div_ceil(MAX_STARTS).max(1);
    let starts = upright.iter().step_by(every);
    let start = starts.max_by_key(|start| within(normals, start, cone).count())?;
    let mut up = *start;
    for cone in CONES.into_iter().flat_map(|cone| [cone; ROUNDS]) {
        let edge = cone.cos();
        // Normals in the middle of the cone count most, so that its edge does not matter.
        let sum: Vector3<f64> = within(normals, &up, cone)
            .map(|dot| (dot.0.abs() - edge) * dot.0.signum() * dot.1)
            .sum();
        up = sum.try_normalize(f64::EPSILON)?;
    }
    let count = within(normals, &up, cone).count();
    let is_shared = count >= MIN_NORMALS && count as f64 >= share * normals.len() as f64;
    (is_shared && up.dot(mean) > least).then_some(up)
}

/// The normals, of either sign, that differ from a direction by less than `cone`, each preceded by its product with it.
fn within<'a>(
    normals: &'a [Vector3<f64>],
    direction: &'a Vector3<f64>,
    cone: f64,
) -> impl Iterator<Item = (f64, &'a Vector3<f64>)> {
    let edge = cone.cos();
    let dots = normals.iter().map(move |normal| (normal.dot(direction), normal));
    dots.filter(move |(dot, _)| dot.abs() > edge)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use nalgebra::UnitQuaternion;

    /// Evenly spread numbers from -1 to 1.
    fn noise(i: usize) -> f64 {
        2.0 * (i as f64 * 0.618_033_988_75).fract() - 1.0
    }

    /// A surface of `count` points, its normals scattered by some degrees.
    fn surface(normal: Vector3<f64>, count: usize) -> Vec<[f32; 3]> {
        let of = |i: usize| {
            let scatter = Vector3::new(noise(i), noise(7 * i + 3), noise(13 * i + 5)) * 0.15;
            (normal + scatter).normalize().map(|c| c as f32).into()
        };
        (0..count).map(of).collect()
    }

    /// Cameras that look down by this angle, one hundred along an arc.
    fn cameras(tilt: f64) -> Vec<StampedPose> {
        let of = |i: i64| {
            let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.005 * i as f64, 0.0));
            let rotation = turn * UnitQuaternion::from_scaled_axis(Vector3::new(-tilt, 0.0, 0.0));
            StampedPose { nanos: i, world_from_camera: SE3 { rotation, ..SE3::identity() } }
        };
        (0..100).map(of).collect()
    }

    fn degrees(found: Vector3<f64>, truth: Vector3<f64>) -> f64 {
        found.dot(&truth).clamp(-1.0, 1.0).acos().to_degrees()
    }

    #[test]
    fn a_tilted_camera_over_a_floor_with_walls_finds_the_normal_of_the_floor() {
        let up = -Vector3::y();
        for tilt in [-30.0, -15.0, 0.0, 25.0, 30.0] {
            let poses = cameras(f64::to_radians(tilt));
            let mut normals = surface(up, 1500);
            normals.extend(surface(-up, 500));
            normals.extend(surface(Vector3::x(), 4000));
            normals.extend(surface(Vector3::z(), 3000));
            normals.extend([[f32::NAN, 0.0, 0.0], [0.0; 3], [f32::INFINITY; 3]]);
            let found = up_direction(poses.iter(), normals.iter().copied()).unwrap();
            assert!(degrees(found, up) < 2.0, "{tilt}: {:.2}", degrees(found, up));
            let mean = up_direction(poses.iter(), std::iter::empty()).unwrap();
            assert!((degrees(mean, up) - f64::abs(tilt)).abs() < 1.0, "the mean is tilted");
        }
    }

    #[test]
    fn a_camera_that_looks_down_finds_a_large_floor_and_keeps_the_mean_over_a_small_one() {
        let up = -Vector3::y();
        let poses = cameras(f64::to_radians(-42.0));
        let walls = |count: usize| surface(Vector3::x(), count);
        let large = [surface(up, 2000), walls(4000)].concat();
        let found = up_direction(poses.iter(), large.iter().copied()).unwrap();
        assert!(degrees(found, up) < 2.0, "{:.2}", degrees(found, up));
        let small = [surface(up, 500), walls(6000)].concat();
        let found = up_direction(poses.iter(), small.iter().copied());
        assert_eq!(found, up_direction(poses.iter(), std::iter::empty()));
    }

    #[test]
    fn without_a_floor_the_mean_of_the_cameras_is_kept() {
        let poses = cameras(0.3);
        let mean = up_direction(poses.iter(), std::iter::empty()).unwrap();
        let mut normals = surface(Vector3::x(), 4000);
        normals.extend(surface(Vector3::z(), 4000));
        normals.extend(surface(-Vector3::y(), MIN_NORMALS / 2));
        assert_eq!(up_direction(poses.iter(), normals.iter().copied()), Some(mean));
        let unknown = vec![[f32::NAN; 3]; 500];
        assert_eq!(up_direction(poses.iter(), unknown.iter().copied()), Some(mean));
    }

    #[test]
    fn cameras_that_agree_on_no_direction_have_no_up() {
        let of = |i: i64| {
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(
                0.0,
                0.0,
                i as f64 * std::f64::consts::PI / 4.0,
            ));
            StampedPose { nanos: i, world_from_camera: SE3 { rotation, ..SE3::identity() } }
        };
        let turning: Vec<StampedPose> = (0..8).map(of).collect();
        let floor = surface(Vector3::z(), 1000);
        assert_eq!(up_direction(turning.iter(), floor.iter().copied()), None);
        assert_eq!(up_direction([].iter(), floor.iter().copied()), None);
    }
}
