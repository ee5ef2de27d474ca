//! Which way is up: estimated, as one camera knows nothing of gravity.
//!
//! People and robots hold cameras level more often than not: the rows of their images are level, whichever way they look and
//! however steeply. Floors, tables and walls then tell exactly: up is where the most normals point to it, from it, or are
//! level, not far from what the cameras say.

use nalgebra::{Matrix3, Vector3};

use crate::slam::fusion::SurfacePoint;
use crate::slam::trajectory::StampedPose;

/// Points that are asked: the directions of walls and floors are known from far fewer.
const MAX_POINTS: usize = 6000;
/// Fewest with a normal that say something.
const MIN_POINTS: usize = 200;
/// Farthest that planes move what the cameras say, radians (35°): beyond, a wall would be taken for the floor.
const MAX_ANGLE: f64 = 0.61;
/// Steps of the search, radians (2°).
const STEP: f64 = 0.035;
/// Angle within which a normal is level or upright, radians (7°): normals are known to 17° at worst, most of them better.
const TOLERANCE: f64 = 0.12;
/// What a level normal counts, an upright one being 1: there is much more room for directions that are level.
const LEVEL_WEIGHT: f64 = 0.4;
/// Score over that of normals that point anywhere, from which on planes are believed.
const MIN_GAIN: f64 = 1.6;
/// What the cameras' mean up counts against the level rows of their images, for cameras that all look the same way.
const MEAN_WEIGHT: f64 = 0.05;

/// What the direction was estimated from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpSource {
    /// Floors and walls of the map, near what the cameras say.
    Planes,
    /// How the cameras were held.
    Cameras,
}

/// An estimate of the direction away from the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpDirection {
    /// Unit vector in the map.
    pub up: Vector3<f64>,
    /// What it comes from.
    pub source: UpSource,
}

/// Estimates it from the cameras' poses and the map's surface; `None` without poses, and where the cameras agree on nothing.
pub fn up_direction(poses: &[StampedPose], surface: &[SurfacePoint]) -> Option<UpDirection> {
    let of_cameras = up_of_cameras(poses)?;
    let normals = surface.iter().filter(|point| point.normal != [0.0; 3]).take(MAX_POINTS);
    let normals: Vec<Vector3<f64>> =
        normals.map(|point| Vector3::from(point.normal.map(f64::from))).collect();
    let of_planes = up_of_planes(&normals, &of_cameras);
    Some(match of_planes {
        Some(up) => UpDirection { up, source: UpSource::Planes },
        None => UpDirection { up: of_cameras, source: UpSource::Cameras },
    })
}

/// The direction to which the rows of the images are most level, on the side of the cameras' upper edges.
fn up_of_cameras(poses: &[StampedPose]) -> Option<Vector3<f64>> {
    /// Length of the mean of the cameras' up vectors below which they agree on no direction.
    const SHORTEST: f64 = 0.3;
    let count = poses.len().max(1) as f64;
    let turned =
        |axis: Vector3<f64>| poses.iter().map(move |pose| pose.world_from_camera.rotation * axis);
    let mean = turned(-Vector3::y()).sum::<Vector3<f64>>() / count;
    if !(mean.norm() > SHORTEST) {
        return None;
    }
    let mean = mean.normalize();
    let rows: Matrix3<f64> = turned(Vector3::x()).map(|row| row * row.transpose() / count).sum();
    // The smaller, the more upright; the mean decides what the rows leave open.
    let least = smallest_axis(rows - mean * mean.transpose() * MEAN_WEIGHT)?;
    let up = if least.dot(&mean) < 0.0 { -least } else { least };
    (up.dot(&mean) > 0.5).then_some(up).or(Some(mean))
}

/// The best direction near `start`, if normals prefer any.
fn up_of_planes(normals: &[Vector3<f64>], start: &Vector3<f64>) -> Option<Vector3<f64>> {
    if normals.len() < MIN_POINTS {
        return None;
    }
    let [across, along] = level_axes(start);
    let steps = (MAX_ANGLE / STEP) as i32;
    let mut best = (0.0, *start);
    for i in -steps..=steps {
        for k in -steps..=steps {
            let (x, y) = (f64::from(i) * STEP, f64::from(k) * STEP);
            if x.hypot(y) > MAX_ANGLE {
                continue;
            }
            let up = (start + across * x.tan() + along * y.tan()).normalize();
            let score = score(normals, &up);
            if score > best.0 {
                best = (score, up);
            }
        }
    }
    let (score, up) = best;
    // Shares of the sphere within the tolerance of a pole, and of the equator.
    let by_chance = 1.0 - TOLERANCE.cos() + LEVEL_WEIGHT * TOLERANCE.sin();
    let is_known = score > MIN_GAIN * by_chance * normals.len() as f64;
    is_known.then(|| refined(normals, up))
}

fn score(normals: &[Vector3<f64>], up: &Vector3<f64>) -> f64 {
    let (upright, level) = (TOLERANCE.cos(), TOLERANCE.sin());
    let of = |normal: &Vector3<f64>| match normal.dot(up).abs() {
        along if along >= upright => 1.0,
        along if along <= level => LEVEL_WEIGHT,
        _ => 0.0,
    };
    normals.iter().map(of).sum()
}

/// The direction to which the upright normals are nearest and the level ones most level.
fn refined(normals: &[Vector3<f64>], mut up: Vector3<f64>) -> Vector3<f64> {
    const ROUNDS: usize = 5;
    for _ in 0..ROUNDS {
        let mut sum = Matrix3::zeros();
        for normal in normals {
            let along = normal.dot(&up).abs();
            if along >= TOLERANCE.cos() {
                sum -= normal * normal.transpose();
            } else if along <= TOLERANCE.sin() {
                sum += normal * normal.transpose() * LEVEL_WEIGHT;
            }
        }
        let Some(axis) = smallest_axis(sum) else { break };
        up = if axis.dot(&up) < 0.0 { -axis } else { axis };
    }
    up
}

/// The axis of the smallest eigenvalue.
fn smallest_axis(of: Matrix3<f64>) -> Option<Vector3<f64>> {
    if !of.iter().all(|x| x.is_finite()) {
        return None;
    }
    let eigen = of.symmetric_eigen();
    let axis: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into();
    axis.iter().all(|x| x.is_finite()).then_some(axis)
}

/// Two axes across a direction.
fn level_axes(up: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let mut axis = Vector3::zeros();
    axis[up.iamin()] = 1.0;
    let across = up.cross(&axis).normalize();
    [across, up.cross(&across)]
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::slam::geometry::se3::SE3;

    /// Cameras that turn about `up` while they look down by `pitch` and roll to and fro a little.
    fn poses(world: UnitQuaternion<f64>, pitch: f64, turn: f64) -> Vec<StampedPose> {
        let pose = |i: i32| {
            let t = f64::from(i) / 100.0;
            let yaw = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), turn * t);
            let pitch = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -pitch);
            let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.05 * (40.0 * t).sin());
            let rotation = world * yaw * pitch * roll;
            let world_from_camera = SE3 { rotation, ..SE3::identity() };
            StampedPose { nanos: i.into(), world_from_camera }
        };
        (0..100).map(pose).collect()
    }

    /// Normals of a floor and two walls, each off by some degrees, one in four anywhere.
    fn room(world: UnitQuaternion<f64>) -> Vec<SurfacePoint> {
        let number = |i: i32, k: f64| (f64::from(i) * k).sin();
        let normal = |i: i32| {
            let planes = [-Vector3::y(), Vector3::x(), -Vector3::z(), Vector3::zeros()];
            let noise = Vector3::new(number(i, 12.9898), number(i, 78.233), number(i, 37.719));
            let plane = planes[i as usize % 4];
            (plane + noise * if plane == Vector3::zeros() { 1.0 } else { 0.08 }).normalize()
        };
        let point = |i| SurfacePoint {
            normal: (world * normal(i)).map(|c| c as f32).into(),
            ..SurfacePoint::default()
        };
        (0..2000).map(point).collect()
    }

    fn off_degrees(found: UpDirection, world: &UnitQuaternion<f64>) -> f64 {
        (world * -Vector3::y()).angle(&found.up).to_degrees()
    }

    #[test]
    fn level_rows_tell_up_however_steeply_cameras_look_down() {
        let world = UnitQuaternion::from_euler_angles(0.3, -0.8, 0.5);
        for (pitch, turn) in [(0.0, 2.0), (0.7, 2.0), (0.7, 6.0)] {
            let found = up_direction(&poses(world, pitch, turn), &[]).unwrap();
            assert_eq!(found.source, UpSource::Cameras);
            let off = off_degrees(found, &world);
            assert!(off < 6.0, "pitch {pitch}, turn {turn}: {off}°");
        }
    }

    #[test]
    fn planes_tell_it_exactly_where_cameras_look_one_way() {
        let world = UnitQuaternion::from_euler_angles(-0.4, 1.1, 0.2);
        let found = up_direction(&poses(world, 0.4, 0.1), &room(world)).unwrap();
        assert_eq!(found.source, UpSource::Planes);
        let off = off_degrees(found, &world);
        assert!(off < 1.0, "{off}°");
    }

    #[test]
    fn normals_of_no_preference_and_cameras_that_agree_on_nothing_tell_nothing() {
        let world = UnitQuaternion::identity();
        let anywhere = |i: usize| {
            let (z, angle) = (2.0 * (i as f64 * 0.618).fract() - 1.0, i as f64 * 2.4);
            let r = f64::sqrt(1.0 - z * z);
            let normal = [r * angle.cos(), r * angle.sin(), z].map(|c| c as f32);
            SurfacePoint { normal, ..SurfacePoint::default() }
        };
        let surface: Vec<SurfacePoint> = (0..3000).map(anywhere).collect();
        let found = up_direction(&poses(world, 0.3, 2.0), &surface).unwrap();
        assert_eq!(found.source, UpSource::Cameras);
        assert_eq!(up_direction(&[], &surface), None);
        // Turning about the optical axis, all the way round.
        let rolling = |i: i32| {
            let rotation =
                UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.0628 * f64::from(i));
            let world_from_camera = SE3 { rotation, ..SE3::identity() };
            StampedPose { nanos: 0, world_from_camera }
        };
        assert_eq!(up_direction(&(0..100).map(rolling).collect::<Vec<_>>(), &surface), None);
    }
}
